"""What nothing holds in its place: tissue that only touches the skull, or flies farther than the organ is large."""

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.motion import Motion
from xfemnav.limits import SWAY
from xfemnav.mechanics.conditions.problem import Problem
from xfemnav.mechanics.space.enrichment import BRANCH

#: The part of the load that weak springs may bear in the place of the skull.
DRIFT = 0.05
#: Less than this part of all forces is rounding.
ROUNDING = 1e-9


def refuse_drift(problem: Problem, U, lips, reaction) -> None:
    """What only touches the skull, and hangs on weak springs, must be pressed onto it by what acts on it: each body.

    That is its load, the lips (n_dof,) that press on it, and the forces (n_dof,) of what holds it, in mN. Raises
    XfemnavError E406.
    """
    acting = np.abs(problem.load) + np.abs(lips) + np.abs(reaction)
    for body, own in _hung_bodies(problem):
        carried, load = np.abs(problem.hung @ U)[own].sum(), acting[own].sum()
        if carried > max(DRIFT * load, ROUNDING * acting.sum()):
            raise XfemnavError(
                "E406",
                f"nothing holds {_named(problem, body)}: the skull that it only touches does not bear "
                f"{carried / load:.0%} of what acts on it; hold an arc of the outline or a lip, or turn the load "
                "towards the skull.",
            )


def _hung_bodies(problem):
    """The bodies that hang on weak springs: number, and degrees of freedom (n_dof,) bool."""
    if problem.hung is None:
        return
    table = problem.enrichment
    on = (problem.hung.diagonal() != 0).reshape(-1, problem.mesh.dim).any(axis=1)
    for body in np.unique(table.body[on[table.dof].any(axis=1)]):
        own = np.zeros((table.n_rows, problem.mesh.dim), dtype=bool)
        own[table.dof[table.body == body]] = True
        yield body, own.ravel()


def _named(problem, body):
    """'the organ', or the piece that a body is, with its area and a place in it."""
    split, own = problem.parts, problem.enrichment.body == body
    area = np.bincount(problem.enrichment.body, np.bincount(split.part, split.volumes, split.n_parts))
    if area[body] >= area[np.unique(problem.enrichment.body[~split.removed])].max():
        return "the organ"
    place = split.corners[own[split.part]][split.volumes[own[split.part]].argmax()].mean(axis=0)
    return f"the piece of {area[body]:.3g} mm{len(place)} about ({', '.join(f'{x:.1f}' for x in place)}) mm"


def refuse_flight(problem: Problem, motion: Motion, body) -> None:
    """No equilibrium moves tissue farther than the organ is large, beyond what is prescribed; no blade does either.

    body (t,): which body each triangle of the motion belongs to. Raises XfemnavError E406.
    """
    size = np.ptp(problem.mesh.points, axis=0).max()
    far = np.linalg.norm(motion.moved - motion.rest, axis=2).max(axis=1)
    k = far.argmax()
    if far[k] > size + min(size, np.abs(problem.constraints.d).max(initial=0.0)):
        why = ("nothing keeps it in its place, a blade is asked for too much, or the load is too large for so soft a "
               "tissue")
        if problem.hung is not None and problem.rules.model != "linear":
            why = "it has turned out of the skull that it only touches, whose contact is that of the shape at rest"
        raise XfemnavError(
            "E406",
            f"{_named(problem, body[k])} moves by {far[k]:.0f} mm, farther than the organ is large "
            f"({size:.0f} mm): {why}; hold an arc of the outline or a lip, and check the units of loads and of Young's "
            "modulus (kPa).",
        )


def warn_of_sway(problem: Problem, sway) -> None:
    """W410 where what only touches the skull lies where the springs that keep it from drifting let it.

    sway (n_dof,) mm: that of the `Minimum`, None when nothing hangs on them.
    """
    if sway is None:
        return
    plain = np.repeat(problem.enrichment.kind < BRANCH, problem.mesh.dim)
    for body, own in _hung_bodies(problem):
        far = np.linalg.norm((sway * (own & plain)).reshape(-1, problem.mesh.dim), axis=1).max()
        if far > SWAY.value:
            warn(
                "W410",
                f"{_named(problem, body)} is held by contact alone, and {far:.2g} mm of its motion hang on artificial "
                f"springs (over {SWAY.value:g} mm): it could slide or turn along the skull. Do not trust where it "
                "lies; hold an arc of the outline or a lip.",
            )
