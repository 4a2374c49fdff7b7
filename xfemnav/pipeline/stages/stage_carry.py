"""The stage carry: companions, landmarks, streamlines and surfaces go with the image, each to a file of its own.

No later stage reads its value, so that is written as files and not kept beside them.
"""

from typing import NamedTuple

from xfemnav.interruption import checkpoint


def compute(params, inputs):
    """What comes of each file after the motion, in their order: an image, landmarks, streamlines or a surface."""
    make, found = {"points": _landmarks, "streamlines": _streamlines, "surfaces": _surface}, []
    for item in params.companions:
        checkpoint()
        found.append(make.get(item.kind, _carried)(item, params, inputs))
    return found


def facts(value, params, inputs):
    """What run.json says of the stage: what became of landmarks and surfaces; and the sidecars of the images."""
    tables = {kind: [{"file": inputs.files[item.role].name} | made.table
                     for item, made in zip(params.companions, value) if item.kind == kind]
              for kind in ("points", "surfaces")}
    sidecars = {f"carry-{number}": made.extra for number, (item, made) in enumerate(zip(params.companions, value))
                if item.kind not in FILES}
    return {"sidecars": sidecars} | {what: rows for what, rows in tables.items() if rows}


def line(found):
    """The key figure in a few words."""
    told = [f"{table['file']}: {table['tissue']} of {table['n']} points in tissue" for table in found.get("points", ())]
    for table in found.get("surfaces", ()):
        gone = sum(n for name, n in table.items() if name.startswith("left_out"))
        told.append(f"{table['file']}: {table['tissue']} of {table['n']} points in tissue, {gone} of {table['faces']} "
                    "faces left out")
    return "; ".join(told)


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`: carry-<number>, with what it is where there are several."""
    from xfemnav.pipeline.keeping.files import write_nifti

    for number, (item, made) in enumerate(zip(params.companions, value)):
        checkpoint()
        if item.kind in FILES:
            FILES[item.kind](item, inputs, folder, f"carry-{number}", made)
        else:
            write_nifti(folder / f"carry-{number}.nii.gz", made)


def _carried(item, params, inputs):
    from xfemnav.imaging.carrying.companions import carry
    from xfemnav.imaging.carrying.kinds import kind_of

    (slice, _), companion = inputs.value("segment"), inputs.image(item.role)
    return carry(companion, slice, inputs.value("warp"), kind=item.kind or kind_of(companion), interp=params.interp,
                 outside=params.outside, fill=params.fill, axes=item.axes, order=item.order)


def _write_points(item, inputs, folder, name, moved):
    from xfemnav.imaging.points.markups import write_markups
    from xfemnav.imaging.points.point_files import write_points

    ending = point_ending(inputs.files[item.role])
    write_points(folder / f"{name}{ending}", moved.points)
    if ending != ".mrk.json":
        write_markups(folder / f"{name}-markups.mrk.json", [moved.points])


def ending(kind, path):
    """The ending of the file that one of a kind is written to, "" where that does not depend on its own name."""
    from xfemnav.imaging.points.endings import SURFACES, TRACTS, ending_of

    if kind == "points":
        return point_ending(path)
    known = {"streamlines": TRACTS, "surfaces": SURFACES}.get(kind)
    return (ending_of(path, known) or path.suffix.lower()) if known else ""


def point_ending(path):
    """The ending of the file that landmarks of `path` are written to: its own, .mrk.json for all markups."""
    ending = path.suffix.lower()
    return ".mrk.json" if ending == ".json" else ending


class Landmarks(NamedTuple):
    """The `points` of a file of landmarks that have a place now, a PointSet, and what became of them all, in numbers.
    """

    points: object
    table: dict


def _landmarks(item, params, inputs):
    from xfemnav.imaging.carrying.landmarks import moved_points, warn_of_points
    from xfemnav.imaging.points.point_files import read_points

    (slice, _), mesh, path = inputs.value("segment"), inputs.value("mesh"), inputs.files[item.role]
    found = read_points(path)
    warn_of_points(found, path.name, slice, mesh.outline)
    moved = moved_points(found.points, slice, inputs.value("solve").motion, mesh.corners)
    flags = ("tissue", "on a cut", "resected", "outside")
    table = {"n": len(found.points)} | {flag.replace(" ", "_"): moved.flag.count(flag) for flag in flags}
    return Landmarks(placed(found, moved), table)


def placed(found, moved, one_lip=False):
    """The PointSet `found` where its points have `moved` (MovedPoints) to; those that have no place are left out.

    Points on a cut come twice, once a lip and labelled so, or with `one_lip` where `moved` has them. Those outside the
    organ stay.
    """
    from dataclasses import replace

    import numpy as np

    from xfemnav.imaging.carrying.landmarks import ON_A_CUT, OUTSIDE

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


def _streamlines(item, params, inputs):
    from xfemnav.imaging.carrying.streamlines import move_streamlines
    from xfemnav.imaging.points.tract_files import decoded_streamlines

    slice, _ = inputs.value("segment")
    read = decoded_streamlines(inputs.content(item.role), inputs.files[item.role].name, inputs.config.limit)
    return move_streamlines(read, slice, inputs.value("solve").motion, inputs.value("mesh").corners)


def _write_streamlines(item, inputs, folder, name, moved):
    from xfemnav.imaging.points.tract_files import tract_bytes

    own = ending(item.kind, inputs.files[item.role])
    (folder / f"{name}{own}").write_bytes(tract_bytes(moved.file, own))


def _surface(item, params, inputs):
    from xfemnav.imaging.carrying.surfaces import move_surface
    from xfemnav.imaging.points.surface_files import decoded_surface

    (slice, _), mesh, name = inputs.value("segment"), inputs.value("mesh"), inputs.files[item.role].name
    read = decoded_surface(inputs.content(item.role), name, params.space, inputs.config.limit)
    moved = move_surface(read, slice, inputs.value("solve").motion, mesh.corners)
    moved.warn_of_frame(name, slice, mesh.outline)
    return moved


def _write_surface(item, inputs, folder, name, moved):
    (folder / f"{name}{ending(item.kind, inputs.files[item.role])}").write_bytes(moved.content)


#: Kinds that are no images, and what writes the file of one.
FILES = {"points": _write_points, "streamlines": _write_streamlines, "surfaces": _write_surface}
