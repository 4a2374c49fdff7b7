"""The part of what the blades do at which a run is trusted, by solving it: worked out for runs that are not.

Displacements and forces of the lips are scaled, all of a run's by one number, and nothing else is: not gravity, not a
gap to the skull, not what was measured. Nothing is extrapolated, for with contact, or beside other loads, a part of the
blades' data does not move tissue by that part: the problem of every step that they act in is posed and solved again.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace

from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.mechanics.rules import BLADE

#: Parts that are tried first, downwards: more than one of them may be safe, with others between that are not.
TRIED = (0.75, 0.5, 0.25)
#: The part named is safe, and so many times as much is not: the next that was tried, and one farther on.
CLOSE, BEYOND = 1.01, 1.05
#: After so many parts that are not safe the search ends.
MOST_UNSAFE = 30
#: What a blade does, as a scenario says it: one of them.
LIP_KEYS = ("displacement_mm", "normal_mm", "force_mN_per_mm")
#: Smaller parts are not looked for.
LEAST = 1e-3


def compute(params, inputs) -> float | None:
    """The largest safe part of the blades' data; None when no part is safe. `params` are the steps of the run."""
    moved = _moved_by_blades(params)
    others = (k for k in range(len(params)) if k not in moved)
    if not moved or not all(_is_trusted(k, inputs) for k in others):
        return None
    return largest_part(lambda part: _trusted(params, moved, part, inputs))


def facts(value, params, inputs):
    """What the text of the error says."""
    return {"safe_part": value}


def publish(value, params, inputs, folder):
    """It has no files."""


def largest_part(safe: Callable[[float], bool]) -> float | None:
    """The largest part of 1, of three digits, that is `safe`, where 1 is not; None if none of 0.001 or more is.

    CLOSE times the one returned is not safe, and neither is BEYOND times it: where tissue that lies twice is counted by
    pixels, a part in a narrow gap may be unsafe, with safe ones above it. Some twenty parts are tried.
    """
    low, unsafe = None, [1.0]
    for part in TRIED:
        if safe(part):
            low = part
            break
        unsafe.append(part)
    while low is None and unsafe[-1] > LEAST:
        part = _three_digits(unsafe[-1] / 4)
        if safe(part):
            low = part
        else:
            unsafe.append(part)
    while low is not None:
        high = min(part for part in unsafe if part > low)
        middle = _three_digits((low + high) / 2)
        if high > CLOSE * low and middle > low:
            tried = middle
        elif high < BEYOND * low < 1 and len(unsafe) < MOST_UNSAFE:
            tried = _three_digits(BEYOND * low)
            if not safe(BEYOND * low):
                return low
        else:
            return low
        if safe(tried):
            low = tried
        else:
            unsafe.append(tried)
    return None


def told(part: float | None, parameters: dict) -> str:
    """The sentence on the largest safe part of what the blades do, with what to ask for; `parameters` of the record."""
    blades = parameters["retract"]
    moves, forces = (any((blade["force_mN_per_mm"] is None) == holds for blade in blades) for holds in (True, False))
    what = "opening and force" if moves and forces else "opening" if moves else "force"
    if part is None:
        return f"No part of this {what} is safe: look at what else acts, and whether something hangs on by little."
    return f"The largest safe {what} is {part:g} of this one ({_asked(part, blades, parameters)})."


def _asked(part, blades, parameters):
    """What to give for a part of the data: flags where they say it all, else keys of the scenario."""
    cuts, spans = {blade["cut"] for blade in blades}, {tuple(blade["blade"] or ()) for blade in blades}
    flags = _flags(part, blades)
    if flags is None or parameters["step"] or cuts != {parameters["cut"][0]["name"]} or len(spans) > 1:
        return "; ".join(f"'{blade['name']}' {key} = {_numbers(blade[key], part)}"
                         for blade in blades for key in LIP_KEYS if blade[key] is not None)
    held = spans.pop()
    return " ".join(flags + (["⟦blade={:g},{:g}⟧".format(*held)] if held not in ((), BLADE) else []))


def _flags(part, blades):
    """Flags for a part of the data of blades on the first cut; None where there are none."""
    normals = [blade["normal_mm"] for blade in blades]
    default = all(blade["relative_to"] is None for blade in blades)
    if len(normals) == 2 and normals[0] == normals[1] and normals[0] is not None and default:
        return [f"⟦opening_mm={_numbers(2 * normals[0], part)}⟧"]
    if any(normal is not None for normal in normals) or not default:
        return None
    return [f"⟦{blade['side']}={_numbers(blade['displacement_mm'], part)}⟧" if blade["force_mN_per_mm"] is None else
            f"⟦lip_force={blade['side']}={_numbers(blade['force_mN_per_mm'], part)}⟧" for blade in blades]


def _numbers(value, part):
    """A part of one number or of two, to six digits."""
    return ",".join(f"{part * x:.6g}" for x in (value if isinstance(value, list | tuple) else (value,)))


def _three_digits(part):
    """A part, rounded down."""
    unit = 10.0 ** (math.floor(math.log10(part)) - 2)
    return round(math.floor(part / unit + 1e-9) * unit, 12)


def scaled(steps, part: float):
    """Steps in which all blades do a part of what they do."""
    return tuple(replace(step, constrain=replace(step.constrain, retractions=tuple(
        replace(blade, displacement_mm=_times(blade.displacement_mm, part), normal_mm=_times(blade.normal_mm, part),
                force_mN_per_mm=_times(blade.force_mN_per_mm, part)) for blade in step.constrain.retractions)))
        for step in steps)


def _times(value, part):
    if value is None:
        return None
    return tuple(part * x for x in value) if isinstance(value, tuple) else part * value


def _moved_by_blades(steps) -> list[int]:
    """The steps in which a blade acts, or for which something is drawn where a blade has moved the tissue."""
    from xfemnav.pipeline.stages.inputs import drawn_after

    moved = []
    for k, step in enumerate(steps):
        if step.constrain.retractions or drawn_after(step.constrain) & set(moved):
            moved.append(k)
    return moved


def _trusted(steps, moved, part, inputs) -> bool:
    """Whether the steps `moved` by blades are trusted with a part of what these do."""
    from xfemnav.pipeline.stages import stage_constrain, stage_solve
    from xfemnav.pipeline.stages.inputs import Inputs

    config = replace(inputs.config, steps=scaled(steps, part))
    values = {name: inputs.value(name) for name in ("segment", "mesh")}
    trial = Inputs(config, done=inputs.done, values=values, images=inputs.images)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", XfemnavWarning)
        for k in moved:
            trial.step = k
            try:
                values[trial.label("constrain")] = stage_constrain.compute(config.steps[k].constrain, trial)
                values[trial.label("solve")] = stage_solve.compute(config.solve, trial)
            except XfemnavError:  # no equilibrium, a lip through the other, ...
                return False
            if not _is_trusted(k, trial):
                return False
    return True


def _is_trusted(k, inputs) -> bool:
    """Whether a step's solution is trusted, tissue that lies twice included."""
    from xfemnav.imaging.carrying.warp import pull_back
    from xfemnav.pipeline.stages import stage_solve, stage_warp
    from xfemnav.pipeline.telling.verdicts import is_trusted

    inputs.step = k
    (slice, _), problem, solution = (inputs.value(name) for name in ("segment", "constrain", "solve"))
    pixel, found = float(slice.spacing.prod()), stage_solve.facts(solution, inputs.config.solve, inputs)
    if not is_trusted(found, pixel):
        return False
    motion = pull_back(solution.rest, solution.moved, slice.origin, slice.spacing, slice.values.shape)
    twice = stage_warp.lying_twice(motion.overlap, slice, problem, solution)
    found["checks"]["overlap_mm2"] = float(twice.sum()) * pixel
    return is_trusted(found, pixel)
