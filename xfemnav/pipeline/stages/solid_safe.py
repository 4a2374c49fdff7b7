"""The part of what the blades do at which a run of a volume is trusted: its answer is linear in that.

Lips do not touch and strains are small, so the motion for a part of the blades' data lies on the line between that
without blades, which is solved for where anything else acts, and the run's own.
"""

from dataclasses import replace

from xfemnav.pipeline.stages.stage_safe import facts, largest_part, publish

__all__ = ["compute", "facts", "publish"]


def compute(params, inputs) -> float | None:
    """The largest safe part of the blades' data; None when no part is safe."""
    solution = inputs.value("solve")
    still = _without_blades(inputs)
    return largest_part(lambda part: _trusted(solution, still, part, inputs))


def _without_blades(inputs):
    """The tetrahedra (t, 4, 3) mm as they are without blades; at rest where nothing else acts."""
    import warnings

    from xfemnav.errors import XfemnavWarning
    from xfemnav.pipeline.stages import solid_constrain, stage_solve
    from xfemnav.pipeline.stages.inputs import Inputs

    asked, solution = inputs.config.constrain, inputs.value("solve")
    if asked.loads.gravity is None:
        return solution.rest
    values = {name: inputs.value(name) for name in ("segment", "mesh")}
    trial = Inputs(inputs.config, done=inputs.done, values=values, images=inputs.images)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", XfemnavWarning)
        values["constrain"] = solid_constrain.compute(replace(asked, retractions=()), trial)
        return stage_solve.compute(inputs.config.solve, trial).moved


def _trusted(solution, still, part, inputs) -> bool:
    """Whether the motion for a part of the blades' data is trusted, tissue that lies twice included."""
    import numpy as np

    from xfemnav.imaging.carrying.warp import pull_back
    from xfemnav.mechanics.solving.measures import displacement_gradient, strains
    from xfemnav.pipeline.stages import stage_solve
    from xfemnav.pipeline.telling.verdicts import is_trusted

    moved = still + part * (solution.moved - still)
    H = displacement_gradient(solution.rest, moved)
    scaled = replace(solution, motion=replace(solution.motion, moved=moved), strain=strains(H, False),
                     det_F=np.linalg.det(H + np.eye(3)))
    volume, _ = inputs.value("segment")
    voxel, found = float(volume.spacing.prod()), stage_solve.facts(scaled, inputs.config.solve, inputs)
    if not is_trusted(found, voxel):
        return False
    found["checks"]["overlap_mm3"] = float(pull_back(solution.rest, moved, *volume.lattice).overlap.sum()) * voxel
    return is_trusted(found, voxel)
