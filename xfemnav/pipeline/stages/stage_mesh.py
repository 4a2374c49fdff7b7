"""The stage mesh: a mask becomes triangles."""

FAR_MESH_MM = 5.0  # a given mesh may end this far from the mask's outline, or two of its boundary's edges


def compute(params, inputs):
    """Mesh of the organ; it knows of the cuts no more than the corridor about them."""
    slice, segmentation = inputs.value("segment")
    if params.from_file:
        from xfemnav.pipeline.keeping.files import read_mesh

        return _about_the_organ(read_mesh(inputs.files["mesh_file"], slice), inputs)
    from xfemnav.geometry.plane.distmesh import distmesh
    from xfemnav.geometry.plane.sizing import SizeField
    from xfemnav.imaging.frames.slices import plane_points
    from xfemnav.imaging.organ.outline import outline_of

    size, focus = params.element_size_mm, ()
    outline = outline_of(segmentation.mask, slice.origin, slice.spacing)
    if params.data_ends is not None:
        from xfemnav.geometry.plane.cut import place_cut
        from xfemnav.geometry.plane.grading import data_ends

        ends = params.data_ends
        paths = [plane_points(slice, cut.points, cut.space) for cut in ends.cuts]
        cuts = tuple(place_cut(path, outline, cut.name, internal=cut.internal, craniotomy=cut.craniotomy,
                               others=[*paths[:k], *paths[k + 1:]], space=cut.space)
                     for k, (cut, path) in enumerate(zip(ends.cuts, paths)))
        focus = data_ends(outline, cuts, ends.blades, ends.grip_mm)
        size = SizeField(size, focus=focus)
    if params.corridor:
        corridor = tuple(plane_points(slice, path, space) for path, space in params.corridor)
        fine = min(params.element_size_mm, params.corridor_element_mm)
        size = SizeField(params.element_size_mm, fine, params.corridor_mm, corridor, focus)
    return distmesh(outline, size)


def _about_the_organ(mesh, inputs):
    """The user's mesh. Raises E209 when its boundary is not the mask's outline, nearly."""
    import numpy as np

    from xfemnav.errors import XfemnavError

    loop = mesh.outline
    edge = float(np.median(np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)))
    limit, distance = max(FAR_MESH_MM, 2 * edge), _hausdorff(mesh, inputs)
    if distance > limit:
        raise XfemnavError("E209", f"{inputs.files['mesh_file'].name} ends up to {distance:.1f} mm from the mask's "
                                   f"outline, over {limit:.1f} mm. Its points are world RAS mm (not LPS); give the "
                                   "mask that it was made of, or make it anew.")
    return mesh


def facts(value, params, inputs):
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

    from xfemnav.imaging.organ.outline import outline_of

    slice, segmentation = inputs.value("segment")
    one = shapely.LinearRing(outline_of(segmentation.mask, slice.origin, slice.spacing))
    other = shapely.LinearRing(mesh.outline)

    def farthest(line, other):
        """Largest distance of points on a line, half a pixel apart, from the segments of the other."""
        ends = shapely.get_coordinates(other)
        segments = shapely.STRtree(shapely.linestrings(np.stack([ends[:-1], ends[1:]], axis=1)))
        fine = shapely.segmentize(line, slice.spacing.min() / 2)
        points = shapely.points(shapely.get_coordinates(fine))
        return segments.query_nearest(points, return_distance=True, all_matches=False)[1].max()

    return float(np.maximum(farthest(one, other), farthest(other, one)))


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`."""
    from xfemnav.pipeline.keeping.files import write_vtu

    slice, _ = inputs.value("segment")
    write_vtu(folder / "mesh.vtu", slice.to_world(value.points), value.cells)
