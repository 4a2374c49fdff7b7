"""The stage carry: companions, landmarks and streamlines go with the image, each to a file of its own.

No later stage reads its value, so that is written as files and not kept beside them.
"""

from xfemnav.interruption import checkpoint


def compute(params, inputs):
    """The image of each companion after the motion, by its number; landmarks and streamlines are files alone."""
    return {number: _carried(item, params, inputs) for number, item in enumerate(params.companions)
            if item.kind not in ("points", "streamlines")}


def facts(value, inputs):
    """What run.json says of the stage: what became of landmarks; and the sidecars of the images."""
    landmarks = [item for item in inputs.config.carry.companions if item.kind == "points"]
    for item in landmarks:
        _warn_of_frame(item, inputs)
    tables = [_moved(item, inputs)[1] for item in landmarks]
    found = {"sidecars": {f"carry-{number}": image.extra for number, image in value.items()}}
    return found | ({"points": tables} if tables else {})


def line(found):
    """The key figure in a few words."""
    tables = found.get("points", ())
    return "; ".join(f"{table['file']}: {table['tissue']} of {table['n']} points in tissue" for table in tables)


def publish(value, inputs, folder):
    """Write the stage's public files into `folder`: carry-<number>, with what it is where there are several."""
    from xfemnav.pipeline.files import write_nifti

    for number, item in enumerate(inputs.config.carry.companions):
        checkpoint()
        if number in value:
            write_nifti(folder / f"carry-{number}.nii.gz", value[number])
        else:
            write = {"points": _write_points, "streamlines": _write_streamlines}[item.kind]
            write(item, inputs, folder, f"carry-{number}")


def _carried(item, params, inputs):
    from xfemnav.imaging.companions import carry
    from xfemnav.imaging.kinds import kind_of

    (slice, _), companion = inputs.value("segment"), inputs.image(item.role)
    return carry(companion, slice, inputs.value("warp"), kind=item.kind or kind_of(companion), interp=params.interp,
                 outside=params.outside, fill=params.fill, axes=item.axes, order=item.order)


def _write_points(item, inputs, folder, name):
    from xfemnav.imaging.markups import write_markups
    from xfemnav.imaging.point_files import write_points

    moved, _ = _moved(item, inputs)
    ending = point_ending(inputs.files[item.role])
    write_points(folder / f"{name}{ending}", moved)
    if ending != ".mrk.json":
        write_markups(folder / f"{name}-markups.mrk.json", [moved])


def point_ending(path):
    """The ending of the file that landmarks of `path` are written to: its own, .mrk.json for all markups."""
    ending = path.suffix.lower()
    return ".mrk.json" if ending == ".json" else ending


def _moved(item, inputs):
    """The landmarks of a file, those that have a place now, and what became of them."""
    from xfemnav.imaging.landmarks import moved_points
    from xfemnav.imaging.point_files import read_points

    slice, _ = inputs.value("segment")
    found = read_points(inputs.files[item.role])
    moved = moved_points(found.points, slice, _motion(inputs), inputs.value("mesh").corners)
    table = {"file": inputs.files[item.role].name, "n": len(found.points)}
    table |= {flag.replace(" ", "_"): moved.flag.count(flag) for flag in ("tissue", "on a cut", "resected", "outside")}
    return placed(found, moved), table


def placed(found, moved, one_lip=False):
    """The PointSet `found` where its points have `moved` (MovedPoints) to; those that have no place are left out.

    Points on a cut come twice, once a lip and labelled so, or with `one_lip` where `moved` has them. Those outside the
    organ stay.
    """
    from dataclasses import replace

    import numpy as np

    from xfemnav.imaging.landmarks import ON_A_CUT, OUTSIDE

    rows, labels, kept = [], [], []
    for k, (flag, label) in enumerate(zip(moved.flag, found.labels)):
        if flag == ON_A_CUT and not one_lip:
            places = [(moved.lips[k, i], f"{label} {lip} lip".strip()) for i, lip in ((0, "left"), (1, "right"))]
        else:
            places = [(found.points[k] if flag == OUTSIDE else moved.moved[k], label)]
        for place, word in places:
            if np.isfinite(place).all():
                rows.append(place)
                labels.append(word)
                kept.append(k)
    columns = {key: tuple(values[k] for k in kept) for key, values in found.columns.items()}
    return replace(found, points=np.array(rows).reshape(-1, 3), labels=tuple(labels), columns=columns)


def _warn_of_frame(item, inputs):
    """W131 where a file of landmarks seems to count in another frame, W132 where landmarks lie off the slice."""
    import numpy as np
    import shapely

    from xfemnav.errors import warn
    from xfemnav.imaging.point_files import frame_suspicion, read_points

    (slice, _), mesh, path = inputs.value("segment"), inputs.value("mesh"), inputs.files[item.role]
    points, organ = read_points(path).points, shapely.Polygon(mesh.points[mesh.boundary_loops[0]])
    suspicion = frame_suspicion(points, lambda world: shapely.contains_xy(organ, slice.from_world(world)[0]))
    if suspicion:
        warn("W131", f"{path.name}: {suspicion} Check the frame that the file states.")
    distance = np.abs(slice.from_world(points)[1])
    off = distance > slice.thickness / 2 * (1 + 1e-6)
    if off.any():
        warn("W132", f"{off.sum()} of {len(points)} points of {path.name} lie off the slice, up to "
                     f"{distance.max():.2f} mm where half its thickness is {slice.thickness / 2:.2f} mm. They were "
                     "moved as its tissue.")


def _write_streamlines(item, inputs, folder, name):
    from xfemnav.imaging.streamlines import move_streamlines
    from xfemnav.imaging.tract_files import read_streamlines

    slice, _ = inputs.value("segment")
    path = inputs.files[item.role]
    moved = move_streamlines(read_streamlines(path), slice, _motion(inputs), inputs.value("mesh").corners)
    moved.file.save(str(folder / f"{name}{path.suffix.lower()}"))


def _motion(inputs):
    from xfemnav.geometry.affine_map import PiecewiseAffineMap

    solution, problem = inputs.value("solve"), inputs.value("constrain")
    return PiecewiseAffineMap(solution.rest, solution.moved, problem.subcells.paths)
