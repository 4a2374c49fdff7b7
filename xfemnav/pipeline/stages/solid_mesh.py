"""The stage mesh of a volume: a mask becomes tetrahedra, small about the cuts."""

#: By so many mm the elements grow for each mm away from the corridor.
GROWTH = 0.35


def compute(params, inputs):
    """The mesh of the organ, and its distance: an Organ."""
    import numpy as np
    from scipy.spatial import cKDTree

    from xfemnav.geometry.solid.organ import Organ
    from xfemnav.geometry.solid.stuffing import stuff
    from xfemnav.imaging.frames.sheets import sheets
    from xfemnav.imaging.organ.distance import signed_distance

    volume, segmentation = inputs.value("segment")
    field = signed_distance(segmentation.mask, volume.affine)
    coarse = params.element_size_mm
    fine = min(coarse, params.corridor_element_mm) if params.sheets and params.corridor_mm > 0 else coarse
    drawn = [cKDTree(sheet.vertices) for sheet in sheets(params.sheets, field, volume)] if fine < coarse else []

    def size(points):
        away = np.min([sheet.query(points)[0] for sheet in drawn], axis=0, initial=np.inf)
        return np.clip(fine + GROWTH * (away - params.corridor_mm), fine, coarse)

    mesh = stuff(field, size, fine, coarse)
    return Organ(mesh.points, mesh.cells, field)


def facts(value, params, inputs):
    """What run.json says of the stage."""
    import numpy as np

    mesh = value
    surface = value.field(mesh.points[np.unique(mesh.boundary_facets)])
    return {"mesh": {"n_nodes": len(mesh.points), "n_cells": len(mesh.cells), "min_quality": float(mesh.quality.min()),
                     "mean_quality": float(mesh.quality.mean()), "volume_mm3": float(mesh.volumes.sum()),
                     "surface_p99_mm": float(np.percentile(np.abs(surface), 99))}}


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`."""
    from xfemnav.pipeline.keeping.files import write_vtu

    write_vtu(folder / "mesh.vtu", value.points, value.cells)
