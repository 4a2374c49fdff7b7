"""The stage constrain of a volume: mesh, cut, blades, tissues and gravity become a boundary value problem."""

from dataclasses import replace

from xfemnav.pipeline.stages.stage_constrain import tissue


def compute(params, inputs):
    """The cuts embedded in the mesh, and the conditions on lips and surface: a Problem."""
    from xfemnav.imaging.frames.sheets import sheets
    from xfemnav.imaging.frames.volume import world_points
    from xfemnav.mechanics.conditions.problem import pose

    volume, segmentation = inputs.value("segment")
    mesh = inputs.value("mesh")
    openings = params.skull.openings and world_points(volume, params.skull.openings, params.space)
    skull = replace(params.skull, border=volume.border(segmentation.mask), openings=tuple(openings))
    cuts = sheets(params.cuts, mesh.field, volume)
    return pose(mesh, cuts, tissue(params, mesh, inputs), skull, params.retractions, (),
                params.loads, params.rules)


def facts(value, params, inputs):
    """What run.json says of the stage."""
    enrichment = value.enrichment
    return {
        "enrichment": {"heaviside_nodes": len(enrichment.heaviside_nodes), "tip_nodes": 0,
                       "n_dof": int(enrichment.n_dof), "added_dof": int(enrichment.n_dof - 3 * len(value.mesh.points))},
        "cuts": [{"name": cut.name, "mouth": cut.mouth_line.tolist(), "along_mm": cut.lengths[0],
                  "depth_mm": cut.lengths[1], "area_mm2": cut.area_mm2, "left": cut.left.tolist(), "told": told(cut)}
                 for cut in value.cuts],
        "resections": [],
        "pieces": [{"name": piece.name, "volume_mm3": piece.area_mm2, "place_mm": list(piece.place_mm),
                    "fate": piece.fate} for piece in value.pieces],
    }


def told(cut):
    """In words: where a sheet enters, how far it goes, and which lip is left."""
    where = f"enters about ({', '.join(f'{x:.0f}' for x in cut.mouth_line.mean(axis=0))}) mm" if cut.mouth else "inside"
    along, depth = cut.lengths
    return f"{where}, {along:.0f} mm along and {depth:.0f} mm deep; left lip: the {bearing(cut.left)} one"


def bearing(direction) -> str:
    """The word of the patient's axis to which a direction (3,) in RAS is nearest."""
    axis = max(range(3), key=lambda k: abs(direction[k]))
    return (("left", "right"), ("posterior", "anterior"), ("inferior", "superior"))[axis][int(direction[axis] > 0)]


def publish(value, params, inputs, folder):
    """The problem is no public file."""
