"""The five stages of the method: for each, what it computes, the figures it reports, and the public files it leaves.

A stage is a pure function of its frozen parameters and of earlier values; it can tell neither a cached input from a
fresh one nor a test from a patient. Leaf modules are imported inside the functions, so that a run that finds
everything in the cache imports none of them.
"""

from collections.abc import Callable
from dataclasses import dataclass

# Linear strains grow as r^-1/2 at a tip, so a speck of tissue there is inverted at any opening: this much is no news.
FOLDED_NOTICE_MM2 = 0.01
FAR_MESH_MM = 5.0  # a given mesh may end this far from the mask's outline, or two of its boundary's edges
INVERTED_LIMIT_MM2 = 1.0  # more folded tissue than this and the result is not trusted (E401)


@dataclass(frozen=True)
class Stage:
    """One stage, and what its key must know: the layers and libraries that it reaches, and what it reads.

    `needs` are earlier stages; `files` are roles of input files. `compute(params, inputs)` gives the value,
    `facts(value, inputs)` its numbers for run.json, `publish(value, inputs, folder)` writes files named by role, and
    `line(facts)` says the key figure in a few words.
    """

    name: str
    layers: tuple[str, ...]
    libraries: tuple[str, ...]
    needs: tuple[str, ...]
    files: tuple[str, ...]
    compute: Callable
    facts: Callable
    publish: Callable
    line: Callable[[dict], str]


# segment: image -> slice and mask -----------------------------------------------------------------------------------

def segment(params, inputs):
    """The slice, and the organ's mask on it: (Slice, Segmentation)."""
    from xfemnav.imaging.segment import segment
    from xfemnav.imaging.slices import take_slice, values_on

    slice = take_slice(inputs.image("image"), plane=params.plane, index=params.index, position_mm=params.position_mm)
    mask = None
    if "mask" in inputs.files:
        mask = values_on(inputs.image("mask"), slice, resample="nearest" if params.resample_mask else None) != 0
    templates = {role: inputs.image(role) for role in ("template", "template_mask") if role in inputs.files}
    return slice, segment(slice, method=params.method, mask=mask, skull=params.skull, **templates)


def segment_facts(value, inputs):
    """What run.json says of the stage."""
    slice, segmentation = value
    frame = {name: getattr(slice, name).tolist() for name in ("origin", "spacing", "axes")}
    frame |= {"shape": list(slice.values.shape), "plane": slice.plane, "index": slice.index,
              "offset": slice.offset, "thickness": slice.thickness}
    area = float(segmentation.mask.sum() * slice.spacing.prod())
    return {"slice": frame, "segmentation": {"method": segmentation.method, "area_mm2": area}}


def segment_publish(value, inputs, folder):
    """Write the stage's public files into `folder`."""
    from xfemnav.imaging.slices import to_nifti
    from xfemnav.pipeline.files import write_nifti

    slice, segmentation = value
    write_nifti(folder / "mask.nii.gz", to_nifti(slice, segmentation.mask, "uint8"))


# mesh: mask -> triangles --------------------------------------------------------------------------------------------

def mesh(params, inputs):
    """Mesh of the organ; it knows of the cuts no more than the corridor about them."""
    slice, segmentation = inputs.value("segment")
    if params.from_file:
        from xfemnav.pipeline.files import read_mesh

        return _about_the_organ(read_mesh(inputs.files["mesh_file"], slice), inputs)
    from xfemnav.geometry.distmesh import distmesh
    from xfemnav.geometry.sizing import SizeField
    from xfemnav.imaging.outline import outline_of
    from xfemnav.imaging.slices import plane_points

    size, focus = params.element_size_mm, ()
    outline = outline_of(segmentation.mask, slice.origin, slice.spacing)
    if params.data_ends is not None:
        from xfemnav.geometry.grading import data_ends

        ends = params.data_ends
        focus = data_ends(outline, _placed(slice, ends.cuts, params.space, outline), ends.blades, ends.grip_mm)
        size = SizeField(size, focus=focus)
    if params.corridor:
        corridor = tuple(plane_points(slice, path, params.space) for path in params.corridor)
        fine = min(params.element_size_mm, params.corridor_element_mm)
        size = SizeField(params.element_size_mm, fine, params.corridor_mm, corridor, focus)
    return distmesh(outline, size)


def _about_the_organ(mesh, inputs):
    """The user's mesh. Raises E209 when its boundary is not the mask's outline, nearly."""
    import numpy as np

    from xfemnav.errors import XfemnavError

    loop = mesh.points[mesh.boundary_loops[0]]
    edge = float(np.median(np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)))
    limit, distance = max(FAR_MESH_MM, 2 * edge), _hausdorff(mesh, inputs)
    if distance > limit:
        raise XfemnavError("E209", f"{inputs.files['mesh_file'].name} ends up to {distance:.1f} mm from the mask's "
                                   f"outline, over {limit:.1f} mm. Its points are world RAS mm (not LPS); give the "
                                   "mask that it was made of, or make it anew.")
    return mesh


def mesh_facts(value, inputs):
    """What run.json says of the stage."""
    return {"mesh": {
        "n_nodes": len(value.points), "n_cells": len(value.cells),
        "min_quality": float(value.quality.min()), "mean_quality": float(value.quality.mean()),
        "hausdorff_mm": _hausdorff(value, inputs),
    }}


def _hausdorff(mesh, inputs) -> float:
    """Largest distance, mm, between the mesh's boundary and the mask's outline."""
    import numpy as np
    import shapely

    from xfemnav.imaging.outline import outline_of

    slice, segmentation = inputs.value("segment")
    one = shapely.LinearRing(outline_of(segmentation.mask, slice.origin, slice.spacing))
    other = shapely.LinearRing(mesh.points[mesh.boundary_loops[0]])

    def farthest(points, line):
        return shapely.distance(shapely.points(shapely.get_coordinates(points)), line).max()

    fine = shapely.segmentize((one, other), slice.spacing.min() / 2)
    return float(np.maximum(farthest(fine[0], other), farthest(fine[1], one)))


def mesh_publish(value, inputs, folder):
    """Write the stage's public files into `folder`."""
    from xfemnav.pipeline.files import write_vtu

    slice, _ = inputs.value("segment")
    write_vtu(folder / "mesh.vtu", slice.to_world(value.points), value.cells)


# constrain: mesh, cuts, blades -> boundary value problem ------------------------------------------------------------

def _placed(slice, cuts, space, outline):
    """The drawn cuts as they run inside an outline."""
    from xfemnav.geometry.cut import place_cut
    from xfemnav.imaging.slices import plane_points

    return tuple(place_cut(plane_points(slice, cut.points, space), outline, cut.name, internal=cut.internal,
                           craniotomy=cut.craniotomy) for cut in cuts)


def constrain(params, inputs):
    """The cuts embedded in the mesh, and the conditions on lips and outline: a Problem."""
    from xfemnav.mechanics.problem import Material, Retraction, Skull, pose

    slice, _ = inputs.value("segment")
    mesh = inputs.value("mesh")
    cuts = _placed(slice, params.cuts, params.space, mesh.points[mesh.boundary_loops[0]])
    blades = tuple(Retraction(cut=r.cut, side=r.side, displacement_mm=r.displacement_mm, normal_mm=r.normal_mm,
                              force_mN_per_mm=r.force_mN_per_mm, blade=r.blade) for r in params.retractions)
    return pose(
        mesh, cuts, Material(params.young_kpa, params.poisson, params.stress_state),
        Skull(params.skull, params.craniotomy_mm, params.skull_ramp_mm), blades,
        boundary_displacement=_measured(slice, params), tip_enrichment=params.tip_enrichment,
        lip_constraint=params.lip_constraint, hold_tip=params.hold_tip,
    )


def _measured(slice, params):
    """Rows x, y, ux, uy[, side] (plane mm) of the measured boundary: points and vectors are read as cuts are."""
    import numpy as np

    from xfemnav.imaging.slices import plane_points

    if params.boundary_displacement is None:
        return None
    rows = np.array(params.boundary_displacement)
    return np.hstack([plane_points(slice, rows[:, :2], params.space), plane_points(slice, rows[:, 2:4], params.space),
                      rows[:, 4:]])


def constrain_facts(value, inputs):
    """What run.json says of the stage."""
    enrichment = value.enrichment
    return {
        "enrichment": {"heaviside_nodes": len(enrichment.heaviside_nodes), "tip_nodes": len(enrichment.tip_nodes),
                       "n_dof": int(enrichment.n_dof), "added_dof": int(enrichment.n_dof - 2 * len(value.mesh.points))},
        "cuts": [{"name": cut.name, "path": cut.path.tolist(), "length_mm": cut.length} for cut in value.cuts],
    }


def publish_nothing(value, inputs, folder):
    """The problem is no public file."""


# solve: boundary value problem -> deformed triangles ----------------------------------------------------------------

def solve(params, inputs):
    """The motion of the tissue: a Solution."""
    from xfemnav.errors import warn
    from xfemnav.mechanics.solution import solve

    solution = solve(inputs.value("constrain"))
    if solution.inverted_mm2 > FOLDED_NOTICE_MM2:
        worst = solution.rest[solution.det_F.argmin()].mean(axis=0)
        warn("W402", f"{solution.inverted_mm2:.3g} mm2 of tissue is turned inside out, the worst near "
                     f"({worst[0]:.1f}, {worst[1]:.1f}) mm.")
    return solution


def solve_facts(value, inputs):
    """What run.json says of the stage."""
    names = [cut.name for cut in inputs.value("constrain").cuts]
    return {
        "retractor": [{"cut": names[force.cut], "side": "left" if force.side > 0 else "right",
                       "force_mN_per_mm": list(force.force_mN_per_mm), "mean_pressure_kPa": force.mean_pressure_kPa}
                      for force in value.retractor],
        "tips": [{"cut": names[tip.cut], "point_mm": list(tip.point_mm), "K_I_Pa_sqrt_m": tip.K_I_Pa_sqrt_m,
                  "K_II_Pa_sqrt_m": tip.K_II_Pa_sqrt_m, "radius_mm": tip.radius_mm} for tip in value.tips],
        "energy_uJ_per_mm": value.energy,
        "matrix": {"nnz": value.nnz, "added_nnz": value.added_nnz, "memory_kB": value.matrix_kB},
        "safe_fraction": safe_fraction(value.rest, value.moved) if value.inverted_mm2 > INVERTED_LIMIT_MM2 else 1.0,
        "checks": {
            "residual": value.residual,
            "inverted_mm2": value.inverted_mm2,
            "det_F_p01": value.det_F_p01,
            "lip_error_mm": {"rms": value.lip_error_rms_mm, "max": value.lip_error_max_mm},
            "max_displacement_mm": value.max_displacement_mm,
        },
    }


def inverted_area(rest, moved) -> float:
    """Area at rest (mm^2) of the triangles (t, 3, 2) that are turned over when moved."""
    from xfemnav.geometry.mesh import orient

    before, after = (orient(x[:, 0], x[:, 1], x[:, 2]) / 2 for x in (rest, moved))
    return float(before[before * after < 0].sum())


def safe_fraction(rest, moved) -> float:
    """Largest part, in thousandths, of all displacements that folds no more tissue than the limit.

    The problem is linear, so a part of the data moves every corner by that part. Rounded down.
    """
    low, high = 0, 1000
    while high - low > 1:
        middle = (low + high) // 2
        folded = inverted_area(rest, rest + middle / 1000 * (moved - rest))
        low, high = (middle, high) if folded <= INVERTED_LIMIT_MM2 else (low, middle)
    return low / 1000


def solve_publish(value, inputs, folder):
    """Write the stage's public files into `folder`."""
    from xfemnav.pipeline.files import write_soup

    slice, _ = inputs.value("segment")
    write_soup(folder / "solution.vtu", slice, value.rest, value.moved,
               {"strain": value.strain, "det_F": value.det_F, "piece": value.body})


# warp: deformed triangles -> updated image --------------------------------------------------------------------------

def warp(params, inputs):
    """The slice after the cut: an Update."""
    from xfemnav.errors import warn
    from xfemnav.imaging.warp import covered, enclosed, pull_back, update

    slice, _ = inputs.value("segment")
    solution, mesh = inputs.value("solve"), inputs.value("mesh")
    grid = slice.origin, slice.spacing, slice.values.shape
    motion = pull_back(solution.rest, solution.moved, *grid)
    updated = update(slice.values, *grid[:2], covered(mesh.corners, *grid), motion,
                     interp=params.interp, outside=params.outside, fill=params.fill,
                     now=enclosed(solution.outline, *grid))
    if updated.overlap.any():
        x, y = slice.pixel_centres()[updated.overlap].mean(axis=0)
        warn("W403", f"{updated.overlap.sum() * slice.spacing.prod():.3g} mm2 of tissue lie twice, about "
                     f"({x:.1f}, {y:.1f}) mm: a lip has moved through the other, or tissue has folded.")
    return updated


def warp_facts(value, inputs):
    """What run.json says of the stage."""
    slice, _ = inputs.value("segment")
    pixel = float(slice.spacing.prod())
    return {"checks": {"cavity_mm2": float(value.cavity.sum()) * pixel,
                       "vacated_mm2": float(value.vacated.sum()) * pixel,
                       "overlap_mm2": float(value.overlap.sum()) * pixel}}


def warp_publish(value, inputs, folder):
    """Write the stage's public files into `folder`."""
    import numpy as np

    from xfemnav.imaging.slices import to_nifti
    from xfemnav.imaging.transform import bridged, write_transform
    from xfemnav.imaging.vectors import vector_nifti
    from xfemnav.pipeline.files import write_nifti

    slice, _ = inputs.value("segment")
    write_nifti(folder / "updated.nii.gz", to_nifti(slice, value.updated, np.float32))
    write_nifti(folder / "cavity.nii.gz", to_nifti(slice, value.cavity, np.uint8))
    write_nifti(folder / "overlap.nii.gz", to_nifti(slice, value.overlap, np.uint8))
    write_nifti(folder / "field.nii.gz", vector_nifti(slice, value.field @ slice.axes[:2]))
    write_transform(folder / "transform.h5", slice, bridged(value.pull_back, value.cavity | value.vacated))


# the picture and the page -------------------------------------------------------------------------------------------

def figure(params, inputs):
    """The picture is a file, not a value."""


def no_facts(value, inputs):
    """What run.json says of the stage."""
    return {}


def figure_publish(value, inputs, folder):
    """Write the stage's public files into `folder`."""
    from xfemnav.pipeline.figure import draw_figure

    slice, segmentation = inputs.value("segment")
    draw_figure(folder / "figure.png", slice, segmentation.mask, inputs.value("constrain"), inputs.value("solve"),
                inputs.value("warp"))


IMAGING = ("numpy", "scipy", "scikit-image", "SimpleITK", "nibabel", "shapely", "numba")
ALL = (*IMAGING, "meshio")

STAGES: dict[str, Stage] = {stage.name: stage for stage in (
    Stage("segment", ("imaging",), IMAGING, (), ("image", "mask", "template", "template_mask"),
          segment, segment_facts, segment_publish,
          lambda f: f"{f['segmentation']['area_mm2']:.0f} mm2 by {f['segmentation']['method']}"),
    Stage("mesh", ("imaging",), ALL, ("segment",), ("mesh_file",), mesh, mesh_facts, mesh_publish,
          lambda f: f"{f['mesh']['n_nodes']} nodes, quality {f['mesh']['min_quality']:.2f}"),
    Stage("constrain", ("imaging", "mechanics"), IMAGING, ("segment", "mesh"), (),
          constrain, constrain_facts, publish_nothing,
          lambda f: "{n_dof} unknowns, {added_dof} for the cut".format(**f["enrichment"])),
    Stage("solve", ("imaging", "mechanics"), ALL, ("segment", "constrain"), (), solve, solve_facts, solve_publish,
          lambda f: "moves up to {max_displacement_mm:.2f} mm; {nnz} matrix entries, {added_nnz} for the cut, "
                    "{memory_kB:.0f} kB".format(**f["checks"], **f["matrix"])),
    Stage("warp", ("imaging",), IMAGING, ("segment", "mesh", "solve"), (), warp, warp_facts, warp_publish,
          lambda f: f"cavity {f['checks']['cavity_mm2']:.0f} mm2"),
)}
FIGURE = Stage("figure", ("pipeline",), (*IMAGING, "matplotlib"), ("segment", "constrain", "solve", "warp"), (),
               figure, no_facts, figure_publish, lambda f: "")
