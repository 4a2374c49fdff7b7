"""The plane as a limit of space: a long cylinder whose ends slide, cut along its whole length, beside its section.

The section is a disc in plane strain with a cut from its top down, blades from the mouth, and a skull that slides.
About the craniotomy the cylinder's ends are free, which its middle does not feel.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.probes import basis_at
from benchmarks.verification.sheets import woven
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.cut import place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.geometry.solid.field import Field
from xfemnav.geometry.solid.sheet import Sheet
from xfemnav.geometry.solid.stuffing import stuff
from xfemnav.mechanics.conditions.problem import Problem, pose
from xfemnav.mechanics.rules import Basis, LipRules, Retraction, Rules, Skull
from xfemnav.mechanics.solving.solution import Solution, solve
from xfemnav.mechanics.tissue.elasticity import Material

RADIUS, HALF_LENGTH, TIP = 35.0, 105.0, 15.0
FREE, RAMP, HELD = 15.0, 4.0, 0.4
LEFT, RIGHT = (3.0, -0.6), (-1.5, 0.2)
BRAIN = Material(3.0, 0.45)
RULES = Rules(Basis("none"), LipRules("free", "nitsche"))
#: Half thickness of the middle slice, mm; how far the cut goes on beyond the ends and the top.
MIDDLE, BEYOND = 3.0, 10.0
GROWTH, STEP = 0.35, 1.5
#: So far (mm) from where data end or the cut ends the slice is compared.
AWAY = 8.0


def section(fine: float) -> tuple[Problem, Solution]:
    """The plane's own answer, with elements of `fine` mm at the cut and 2.5 times that elsewhere."""
    t = np.deg2rad(np.arange(360))
    disc = RADIUS * np.stack([np.cos(t), np.sin(t)], axis=1)
    path = np.array([[0.0, RADIUS], [0.0, TIP]])
    mesh = distmesh(disc, SizeField(2.5 * fine, fine, 8.0, (path,)))
    cut = place_cut(path + np.array([[0, 2.0], [0, 0]]), mesh.outline)
    problem = pose(mesh, (cut,), BRAIN, Skull("sliding", FREE, RAMP), blades(LEFT, RIGHT), rules=RULES)
    return problem, solve(problem)


def blades(left, right) -> tuple[Retraction, ...]:
    """Both lips held from the mouth to the fraction HELD of the cut's depth."""
    return tuple(Retraction(0, side, displacement_mm=given, blade=(0.0, HELD))
                 for side, given in ((1, left), (-1, right)))


def sheet(half: float) -> Sheet:
    """The section's cut along a whole cylinder from -half to half mm: along z, so that its left is the section's."""
    z = np.arange(-half - BEYOND, half + BEYOND + STEP, STEP)
    y = np.linspace(RADIUS + BEYOND, TIP, int((RADIUS + BEYOND - TIP) / STEP) + 1)[:, None]
    vertices = np.stack(np.broadcast_arrays(0.0, y, z), axis=-1)
    chart = np.stack(np.broadcast_arrays((z - z[0]) / (z[-1] - z[0]), (RADIUS - y) / (RADIUS - TIP)), axis=-1)
    z = z[np.abs(z) < half]
    return woven(vertices, chart, np.stack([0 * z, 0 * z + RADIUS, z], axis=1))


def cylinder(fine: float, coarse: float, about: float, half: float = HALF_LENGTH) -> Mesh:
    """A cylinder from -half to half mm, with elements of `fine` mm about the cut nearer than `about` mm to the middle.
    """
    step = 1.25
    x, z = np.arange(-RADIUS - 4, RADIUS + 4, step) + 0.137, np.arange(-half - 4, half + 4, step) + 0.1
    around = RADIUS - np.hypot(x[:, None], x)[..., None]
    values = np.minimum(around, half - np.abs(z))
    out = (around < 0) & (np.abs(z) > half)
    values[out] = -np.hypot(np.minimum(around, 0), np.maximum(np.abs(z) - half, 0))[out]
    field = Field(values, np.array([x[0], x[0], z[0]]), step * np.eye(3))
    lines = cKDTree([(0.0, y) for y in np.arange(TIP, RADIUS, 0.5)])

    def size(points):
        away = np.maximum(lines.query(points[:, :2])[0] - 4.0, np.abs(points[:, 2]) - about)
        return np.clip(fine + GROWTH * away, fine, coarse)

    return stuff(field, size, fine, coarse)


def extruded(mesh: Mesh) -> tuple[Problem, Solution]:
    """The section's problem on a mesh of the cylinder."""
    pulled = blades((*LEFT, 0.0), (*RIGHT, 0.0))
    problem = pose(mesh, (sheet(mesh.points[:, 2].max()),), BRAIN, Skull("sliding", FREE, RAMP), pulled, rules=RULES)
    return problem, solve(problem)


@dataclass(frozen=True)
class Slice:
    """Where the middle slice differs from the plane farther than 8 mm from switch, blades' ends and tip: largest and
    root mean square difference, mm, the largest near the tip too, largest motion out of the slice, mm, and the nodes of
    the cylinder."""

    worst: float
    rms: float
    with_tip: float
    out: float
    nodes: int


def beside(solid: tuple[Problem, Solution], plane: tuple[Problem, Solution], n: int = 20_000) -> Slice:
    """The middle slice of the cylinder beside the section."""
    (problem, found), (flat, answer) = solid, plane
    rng = np.random.default_rng(0)
    near = np.flatnonzero((np.abs(found.rest[..., 2]) < MIDDLE).all(axis=1))
    volumes = found.rest_areas[near]
    chosen = near[rng.choice(len(near), n, p=volumes / volumes.sum())]
    at = rng.dirichlet(np.ones(4), n)
    points = np.einsum("ka,kai->ki", at, found.rest[chosen])
    u = np.einsum("ka,kai->ki", at, found.moved[chosen]) - points
    data = np.array([(0.0, RADIUS - HELD * (RADIUS - TIP)), *switches()])
    far = np.linalg.norm(points[:, None, :2] - data, axis=2).min(axis=1) > AWAY
    far &= (np.hypot(*points[:, :2].T) < RADIUS - 0.05) & (np.abs(points[:, 0]) > 1e-3)
    points, u = points[far], u[far]
    off = np.linalg.norm(u[:, :2] - basis_at(flat.space, points[:, :2]) @ answer.U, axis=1)
    apart = off[np.linalg.norm(points[:, :2] - (0, TIP), axis=1) > AWAY]
    return Slice(float(apart.max()), float(np.sqrt((apart**2).mean())), float(off.max()), float(np.abs(u[:, 2]).max()),
                 len(problem.mesh.points))


def switches() -> np.ndarray:
    """Where the skull's grip begins (2, 2) mm."""
    turn = 2 * np.arcsin(FREE / 2 / RADIUS) * np.array([1, -1])
    return RADIUS * np.stack([np.sin(turn), np.cos(turn)], axis=1)
