"""The stage warp: deformed triangles become the updated image."""

# Contact keeps lips apart in the mean over a bit more than an element: between, they overlap by up to .05 mm. A pixel
# centre this near to a lip lies in such a sliver, not in tissue that has moved through the other.
SLIVER_MM = 0.06
# At a tip, specks and lines of tissue lie twice that no mesh resolves. A pixel that none of its neighbours joins is
# looked at more closely: of the square of twice a sliver's width about its centre a third must lie twice.
FEW, FINE, SHARE = 4, 13, 1 / 3


def compute(params, inputs):
    """The slice after the cut: an Update, without slivers in its overlap."""
    from dataclasses import replace

    from xfemnav.errors import warn
    from xfemnav.imaging.carrying.background import blank_of, warn_of_blank
    from xfemnav.imaging.carrying.warp import covered, enclosed, pull_back, update

    (slice, _), problem, solution = (inputs.value(name) for name in ("segment", "constrain", "solve"))
    grid = slice.origin, slice.spacing, slice.values.shape
    organ = covered(inputs.value("mesh").corners, *grid)  # also of what is taken out
    blank = blank_of(slice.values, organ, params.fill)
    motion = pull_back(solution.rest, solution.moved, *grid)
    updated = update(slice.values, organ, motion, interp=params.interp, outside=params.outside,
                     fill=blank, now=enclosed(solution.outline, *grid))
    twice = lying_twice(motion.overlap, slice, problem, solution)
    if twice.any():
        x, y = slice.pixel_centres()[twice].mean(axis=0)
        warn("W403", f"{twice.sum() * slice.spacing.prod():.3g} mm2 of tissue lie twice, about "
                     f"({x:.1f}, {y:.1f}) mm: a lip has moved through the other, or tissue has folded.")
    warn_of_blank(blank, slice.values[organ], "the image", given=params.fill is not None, outside=params.outside)
    return replace(updated, overlap=twice)


def lying_twice(overlap, slice, problem, solution):
    """Those pixels (n1, n2) bool of an `overlap` that hold tissue of two places, not slivers between lips that touch.
    """
    import numpy as np
    import shapely

    from xfemnav.imaging.organ.masks import components

    twice = np.array(overlap)
    if twice.any() and problem.cuts:
        found = [solution.motion.lip_now(k, side) for k in range(len(problem.cuts)) for side in (1, -1)]
        lips = shapely.MultiLineString([points for points in found if len(points) > 1])
        centres = shapely.points(slice.pixel_centres()[twice])
        twice[twice] = shapely.distance(centres, lips) > SLIVER_MM
    if twice.any():
        number = components(twice)
        alone = twice & (np.bincount(number[twice])[number] < FEW)
        twice[alone] = [_is_wide(centre, solution) for centre in slice.pixel_centres()[alone]]
    return twice


def _is_wide(centre, solution) -> bool:
    """Whether tissue lies twice not just at a point (2,) mm of the plane, but about it."""
    from xfemnav.imaging.carrying.warp import pull_back

    step = 2 * SLIVER_MM / (FINE - 1)
    found = pull_back(solution.rest, solution.moved, centre - SLIVER_MM, (step, step), (FINE, FINE))
    return bool(found.overlap.mean() > SHARE)


def facts(value, params, inputs):
    """What run.json says of the stage, and the sidecar of the image."""
    pixel = float(inputs.value("segment")[0].spacing.prod())
    checks = {f"{name}_mm2": float(getattr(value, name).sum()) * pixel for name in ("cavity", "vacated", "overlap")}
    return {"checks": checks, "sidecars": {"updated": {"Fill": value.fill}}}


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`."""
    import numpy as np

    from xfemnav.imaging.carrying.lip_labels import lip_labels
    from xfemnav.imaging.carrying.vectors import vector_nifti
    from xfemnav.imaging.frames.slices import to_nifti
    from xfemnav.pipeline.keeping.files import write_nifti

    slice, _ = inputs.value("segment")
    problem, solution = inputs.value("constrain"), inputs.value("solve")
    lips = lip_labels(value.pull_back, value.cavity, solution.rest, problem.parts.paths)
    write_nifti(folder / "updated.nii.gz", to_nifti(slice, value.updated, np.float32))
    write_nifti(folder / "cavity.nii.gz", to_nifti(slice, value.cavity, np.uint8))
    write_nifti(folder / "overlap.nii.gz", to_nifti(slice, value.overlap, np.uint8))
    write_nifti(folder / "lips.nii.gz", to_nifti(slice, lips, np.uint8))
    write_nifti(folder / "field.nii.gz", vector_nifti(slice, value.field @ slice.axes[:2]))
    _write_transforms(value.pull_back, inputs, folder, params.transforms)


def _write_transforms(motion, inputs, folder, which):
    """The motion for other programs: the ITK transform of viewers, and with "all" every other form and direction."""
    import numpy as np

    from xfemnav.imaging.carrying.transform import backward, forward, roomy, write_transform
    from xfemnav.imaging.carrying.vectors import field_nifti, write_nrrd
    from xfemnav.pipeline.keeping.files import write_nifti

    solution, mesh = inputs.value("solve"), inputs.value("mesh")
    if which == "none":
        return
    slice, _ = inputs.value("segment")
    frame = roomy(slice, np.concatenate([mesh.corners, solution.moved]))
    known = motion if frame.values.shape == slice.values.shape else None  # there was room already
    bridged = backward(frame, mesh.corners, solution.motion, "bridged", known)
    write_transform(folder / "transform.h5", frame, bridged)
    if which == "all":
        extended = backward(frame, mesh.corners, solution.motion, "extended", known)
        write_transform(folder / "transform-extended.h5", frame, extended)
        write_nrrd(folder / "field-nrrd.nrrd", frame, bridged, "resampling")
        write_nifti(folder / "field-nifti.nii.gz", field_nifti(frame, bridged))
        frame = roomy(slice, mesh.corners)
        write_nrrd(folder / "forward-nrrd.nrrd", frame, forward(frame, solution.motion), "modeling")
