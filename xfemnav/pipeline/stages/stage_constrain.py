"""The stage constrain: mesh, cuts, blades, resections, tissues and loads become a boundary value problem."""

import math
from dataclasses import replace


def _placed(cuts, paths, outline, others=()):
    """Drawn cuts, paths (k, 2) plane mm, as they run inside an outline; `others` may bear branches too."""
    from xfemnav.geometry.plane.cut import place_cut

    return tuple(place_cut(path, outline, cut.name, internal=cut.internal, craniotomy=cut.craniotomy, space=cut.space,
                           others=[*others, *paths[:k], *paths[k + 1:]])
                 for k, (cut, path) in enumerate(zip(cuts, paths)))


def compute(params, inputs):
    """The cuts embedded in the mesh, and the conditions on lips and outline: a Problem."""
    from xfemnav.mechanics.conditions.problem import pose

    slice, segmentation = inputs.value("segment")
    mesh = inputs.value("mesh")
    outline = mesh.outline
    cuts = _placed(params.cuts, [_drawn_path(cut, inputs) for cut in params.cuts], outline)
    taken = _taken_out(params, mesh, cuts, inputs)
    number = {k: i for i, k in enumerate(taken)} | {None: None}
    loads = replace(params.loads, pressures=tuple(replace(load, resection=number[load.resection])
                                                  for load in params.loads.pressures))
    skull = replace(_in_plane(params.skull, slice, params.space), border=slice.border(segmentation.mask),
                    openings=(*_craniotomies(params, slice), *_later_mouths(params, slice, outline)))
    return pose(mesh, cuts, tissue(params, mesh, inputs), skull, params.retractions, tuple(taken.values()),
                loads, params.rules)


def _drawn_path(item, inputs):
    """Path (k, 2) plane mm of a cut at rest, however it was drawn."""
    from xfemnav.geometry.plane.at_rest import path_at_rest

    path = _plane(inputs.value("segment")[0], item.points, item.space)
    return path if item.drawn_after is None else path_at_rest(path, _motion(item, inputs), item.name)


def _motion(item, inputs):
    """The motion of the tissue up to the step in whose slice an item was drawn."""
    return inputs.value("solve", item.drawn_after).motion


def _plane(slice, points, space):
    from xfemnav.imaging.frames.slices import plane_points

    return plane_points(slice, points, space)


def _craniotomies(params, slice):
    """Places (2,) plane mm about which the skull is open without a cut."""
    return _plane(slice, params.skull.openings, params.space) if params.skull.openings else ()


def _later_mouths(params, slice, outline):
    """Where cuts of later steps will enter: the skull is open there already.

    As drawn: where tissue will lie when a cut is drawn in the deformed slice is not known yet, so such a cut's opening
    is about the outline's point next to its start.
    """
    import numpy as np
    import shapely

    from xfemnav.errors import XfemnavError

    ring, found = shapely.LinearRing(outline), []
    paths = [_plane(slice, cut.points, cut.space) for cut in (*params.later_cuts, *params.cuts)]
    for k, cut in enumerate(params.later_cuts):
        try:
            placed = _placed((cut,), (paths[k],), outline, others=[*paths[:k], *paths[k + 1:]])[0]
            found += [placed.path[0]] if placed.mouth and placed.craniotomy else []
        except XfemnavError:
            if cut.craniotomy and not cut.internal:
                near = ring.interpolate(ring.project(shapely.Point(paths[k][0])))
                found.append(np.array(near.coords[0]))
    return tuple(found)


def _taken_out(params, mesh, cuts, inputs):
    """What each resection takes out, by its number; not those of which nothing is taken.

    What images mark is united before it is outlined, so that nothing is left between the labels of one tumour; with it
    goes what could not stay beside it.
    """
    import shapely
    from shapely.ops import substring

    from xfemnav.geometry.plane.resection import refuse_all
    from xfemnav.geometry.plane.shreds import Elements, without_shreds
    from xfemnav.imaging.organ.regions import warn_of_left

    if not params.resections:
        return {}
    (slice, _), outline, least = inputs.value("segment"), mesh.outline, _least_mm2(params)
    found = {k: _marked(item, slice, inputs) for k, item in enumerate(params.resections) if item.outline is None}
    placed = _placed_regions(params, found, outline, inputs)
    held = [substring(shapely.LineString(cuts[r.cut].path), *(r.blade or (0.0, 1.0)), normalized=True)
            for r in params.retractions]
    placed = dict(zip(placed, without_shreds(tuple(placed.values()), outline, Elements.of(mesh), least_mm2=least,
                                             hold=params.rules.loose == "hold", held=held)))
    region, organ = shapely.union_all([item.region for item in placed.values()]), shapely.Polygon(outline)
    refuse_all(region, organ, " and ".join(f"resection '{item.name}'" for item in placed.values()))
    for k in found:
        if not _is_redrawn(params.resections[k]):
            warn_of_left(found[k], slice, region, organ, least)
    return placed


def _placed_regions(params, found, outline, inputs):
    """The resections inside an outline, by number, before anything else goes with them: those drawn, and those `found`
    in images. Raises E311 when nothing of these is as large as a resection."""
    from xfemnav.errors import XfemnavError
    from xfemnav.geometry.plane.at_rest import ring_at_rest
    from xfemnav.geometry.plane.resection import place_resection, place_united
    from xfemnav.imaging.organ.regions import outlined

    (slice, _), items, least = inputs.value("segment"), params.resections, _least_mm2(params)

    def at_rest(item, rings):
        redrawn = _is_redrawn(item)
        return tuple(ring_at_rest(ring, _motion(item, inputs), item.name) if redrawn else ring for ring in rings)

    placed = {k: place_resection(at_rest(item, (_plane(slice, item.outline, item.space),)), outline, item.name,
                                 space=item.space)
              for k, item in enumerate(items) if item.outline is not None}
    groups = [[k for k in found if not _is_redrawn(items[k])], *([k] for k in found if _is_redrawn(items[k]))]
    for group in filter(None, groups):
        own, united = outlined([found[k] for k in group], slice, least)
        own, united = [at_rest(items[k], rings) for k, rings in zip(group, own)], at_rest(items[group[0]], united)
        smooth = least - math.pi * slice.spacing.prod()  # each outline loses pi pixels
        placed |= zip(group, place_united(own, united, outline, [items[k].name for k in group],
                                          [found[k].name for k in group], smooth))
    placed = {k: placed[k] for k in sorted(placed) if placed[k]}
    needed = [load.resection for load in params.loads.pressures if load.resection is not None]
    for k in found:
        if k not in placed and (k in needed or not placed):
            raise XfemnavError("E311", f"resection '{items[k].name}' takes nothing: {found[k].area_mm2:.3g} mm2 of "
                                       f"{found[k].name} on this slice are in bits under {least:.3g} mm2 (a disc of "
                                       f"{params.min_resection_mm:g} mm). Take its labels together, label = [1, 3, 4], "
                                       "or give a smaller ⟦min_resection_mm⟧.")
    return placed


def _is_redrawn(item):
    """Whether a resection was drawn in a deformed slice: label maps never are."""
    return item.drawn_after is not None and item.label is None


def _marked(item, slice, inputs):
    from xfemnav.imaging.organ.regions import marked

    return marked(inputs.image("labels" if item.label is not None else f"resection:{item.mask}"), slice, item.label)


def _least_mm2(params):
    """Area of the smallest resection: of the disc that has its size across."""
    return math.pi / 4 * params.min_resection_mm**2


def tissue(params, mesh, inputs):
    """One material, or a mixture in each cell where a label map tells tissues apart."""
    import numpy as np

    from xfemnav.errors import warn
    from xfemnav.imaging.organ.labels import label_shares
    from xfemnav.mechanics.tissue.elasticity import Material, mixed

    rest = Material.of(params.solid)
    if not params.labels:
        return rest
    slice, _ = inputs.value("segment")
    shares = label_shares(inputs.image("labels"), slice, mesh.corners, [item.label for item in params.labels])
    for item, share in zip(params.labels, shares.T):
        if not share.any():
            warn("W314", f"label {item.label} of {inputs.files['labels'].name} is nowhere in the organ on this slice, "
                         "so no tissue has its constants.")
    materials = (rest, *(Material.of(item.solid) for item in params.labels))
    return mixed(materials, np.column_stack([1 - shares.sum(axis=1), shares]))


def _in_plane(skull, slice, space):
    """A skull whose arcs and measured motion are plane mm: points and vectors are read as cuts are."""
    import numpy as np

    arcs = tuple(replace(arc, start=start, end=end) for arc in skull.arcs
                 for start, end in [_plane(slice, (arc.start, arc.end), space).tolist()])
    motion = skull.measured
    if motion is not None:
        rows = np.array(motion.rows)
        motion = replace(motion, rows=np.hstack([_plane(slice, rows[:, :2], space), _plane(slice, rows[:, 2:4], space),
                                                 rows[:, 4:]]))
    return replace(skull, arcs=arcs, measured=motion)


def facts(value, params, inputs):
    """What run.json says of the stage."""
    from xfemnav.pipeline.telling.bearings import Bearings

    enrichment, (slice, segmentation) = value.enrichment, inputs.value("segment")
    bearings = Bearings(slice, segmentation.mask)
    return {
        "enrichment": {"heaviside_nodes": len(enrichment.heaviside_nodes), "tip_nodes": len(enrichment.tip_nodes),
                       "n_dof": int(enrichment.n_dof), "added_dof": int(enrichment.n_dof - 2 * len(value.mesh.points))},
        "cuts": [{"name": cut.name, "path": path.tolist(), "length_mm": cut.length, "told": bearings.of_cut(cut)}
                 for cut, path in zip(value.cuts, value.parts.paths)],
        "resections": [{"name": item.name, "area_mm2": item.area_mm2, "told": bearings.of_resection(item)}
                       for item in value.resections],
        "pieces": [{"name": piece.name, "area_mm2": piece.area_mm2, "place_mm": list(piece.place_mm),
                    "fate": piece.fate} for piece in value.pieces],
    }


def publish(value, params, inputs, folder):
    """The problem is no public file."""
