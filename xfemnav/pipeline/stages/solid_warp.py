"""The stage warp of a volume: deformed tetrahedra become the updated volume."""


def compute(params, inputs):
    """The volume after the cut: an Update."""
    from xfemnav.errors import warn
    from xfemnav.imaging.carrying.background import blank_of, warn_of_blank
    from xfemnav.imaging.carrying.rim import with_rim
    from xfemnav.imaging.carrying.warp import covered, enclosed, pull_back, update

    (volume, segmentation), solution = inputs.value("segment"), inputs.value("solve")
    inside = covered(inputs.value("mesh").corners, *volume.lattice)
    rim = segmentation.mask & ~inside
    organ = inside | rim
    motion = with_rim(pull_back(solution.rest, solution.moved, *volume.lattice), rim)
    blank = blank_of(volume.values, organ, params.fill)
    found = update(volume.values, organ, motion, interp=params.interp, outside=params.outside, fill=blank,
                   now=enclosed(solution.outline, *volume.lattice))
    if found.overlap.any():
        size = found.overlap.sum() * volume.spacing.prod()
        place = ", ".join(f"{x:.1f}" for x in _middle(found.overlap, volume))
        warn("W403", f"{size:.3g} mm3 of tissue lie twice, about ({place}) mm: a lip has moved through the other, or "
                     "tissue has folded.")
    warn_of_blank(blank, volume.values[organ], "the image", given=params.fill is not None, outside=params.outside)
    return found


def _middle(chosen, volume):
    import numpy as np

    return volume.voxels_to_world(np.argwhere(chosen).mean(axis=0))


def facts(value, params, inputs):
    """What run.json says of the stage, and the sidecar of the image."""
    voxel = float(inputs.value("segment")[0].spacing.prod())
    checks = {f"{name}_mm3": float(getattr(value, name).sum()) * voxel for name in ("cavity", "vacated", "overlap")}
    return {"checks": checks, "sidecars": {"updated": {"Fill": value.fill}}}


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`."""
    import numpy as np

    from xfemnav.imaging.carrying.lip_labels import lip_labels
    from xfemnav.imaging.frames.slices import to_nifti
    from xfemnav.pipeline.keeping.files import write_nifti

    volume, _ = inputs.value("segment")
    write_nifti(folder / "updated.nii.gz", to_nifti(volume, value.updated, np.float32))
    for name in ("cavity", "overlap"):
        write_nifti(folder / f"{name}.nii.gz", to_nifti(volume, getattr(value, name), np.uint8))
    solution = inputs.value("solve")
    lips = lip_labels(value.pull_back, value.cavity, solution.rest, solution.motion.cuts)
    write_nifti(folder / "lips.nii.gz", to_nifti(volume, lips, np.uint8))
