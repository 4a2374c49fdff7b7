"""The stage solve of a volume: as in the plane, with files of space."""

from xfemnav.pipeline.stages.stage_solve import compute, facts

__all__ = ["compute", "facts", "publish"]


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`: the moved tetrahedra, lips and surface, and the mouths now."""
    import numpy as np

    from xfemnav.imaging.points.markups import write_markups
    from xfemnav.imaging.points.point_set import PointSet
    from xfemnav.pipeline.keeping.files import write_soup, write_vtp

    volume, _ = inputs.value("segment")
    problem = inputs.value("constrain")
    write_soup(folder / "solution.vtu", volume, value.rest, value.moved,
               {"strain": value.strain, "det_F": value.det_F, "piece": value.body})
    write_markups(folder / "cuts.mrk.json", [PointSet("Curve", f"{cut.name}, mouth", cut.mouth_line, ("",) * len(
        cut.mouth_line)) for cut in problem.cuts if len(cut.mouth_line) > 1])
    write_vtp(folder / "lips-surface.vtp", np.concatenate([value.lips[:, 0], value.lips[:, 1]]),
              {"lip": np.repeat([1, 2], len(value.lips))})
    write_vtp(folder / "organ-surface.vtp", value.outline)
