"""The reference problems on a conforming mesh: retraction disc (p), cracked plates (a, b, c), arc (f1) and branch (f2).

`refinement` 1 is the usual one; 2 halves the size everywhere.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks.reference.elasticity import Field, Model, Tissue
from benchmarks.reference.mesh import Grading, conforming_mesh
from benchmarks.reference.stress_intensity import stress_intensity

#: Problem p: disc's radius, cut's mouth and tip, distance of the fixed outline from the mouth, mm.
RADIUS, MOUTH, TIP, FREE = 70.0, (0.0, 70.0), (0.0, 30.0), 15.0
LIFT = np.array([3.5, -1.0])
FRACTIONS = (0.25, 0.5, 0.75, 0.9)
BRAIN = Tissue(3000.0, 0.45)


@dataclass(frozen=True, eq=False)
class Retracted:
    """Problem p's reference: the displacement, its strain energy Pa mm^2 and the number of unknowns."""

    field: Field
    energy: float
    n_dof: int


def disc() -> np.ndarray:
    """The 360-gon (360, 2) mm of problem p."""
    t = np.deg2rad(np.arange(360))
    return RADIUS * np.stack([np.cos(t), np.sin(t)], axis=1)


def switches(free_mm: float = FREE) -> np.ndarray:
    """The two points (2, 2) mm of the 360-gon at `free_mm` from the mouth, right (x > 0) first."""
    corners = disc()[:91]
    k = int(np.flatnonzero(np.linalg.norm(corners - MOUTH, axis=1) >= free_mm)[-1])
    a, along = corners[k], corners[k + 1] - corners[k]
    start = a - MOUTH
    s = np.roots([along @ along, 2 * start @ along, start @ start - free_mm**2])
    point = a + s[(s >= 0) & (s <= 1)][0].real * along
    return np.array([point, point * (-1, 1)])


def retraction(
    held: float, tissue: Tissue = BRAIN, refinement: float = 1.0, lift=LIFT, free_mm: float = FREE
) -> Retracted:
    """Problem p with both lips held from the mouth to the fraction `held` of the cut; the left lip moves by `lift`."""
    end = np.array([0.0, MOUTH[1] - held * (MOUTH[1] - TIP[1])])
    switch = switches(free_mm)
    focus = (*map(tuple, switch), tuple(end), MOUTH, TIP)
    grading = Grading(4.0 / refinement, 1e-3 / refinement**2, 0.14 / refinement, focus)
    mesh = conforming_mesh(disc(), [np.array([MOUTH, TIP])], grading, [*switch, end])
    model = Model(mesh, tissue)
    reach = np.linalg.norm(switch[0] - MOUTH)

    def on_lip(x):
        return (np.abs(x[:, 0]) < 1e-9) & (x[:, 1] < MOUTH[1] - 1e-9)

    fixed = model.facets(lambda x, _: ~on_lip(x) & (np.linalg.norm(x - MOUTH, axis=1) > reach))
    model.prescribe(fixed, np.zeros(2))
    for side in (1, -1):
        held_lip = model.facets(lambda x, i, side=side: on_lip(x) & (x[:, 1] > end[1]) & (np.sign(i[:, 0]) == side))
        model.prescribe(held_lip, side * np.asarray(lift, float))
    u = model.solve()
    return Retracted(model.field(u), model.energy(u), model.basis.N)


def edge_crack(width, length, crack, refinement: float = 1.0, shear: bool = False, tissue=None):
    """K_I, K_II and strain energy of a plate with an edge crack at half its length.

    Problem a: unit tension on both ends; problem b (`shear`): bottom clamped, unit shear traction on top.
    """
    tissue = tissue or Tissue(1.0, 0.3)
    outline = np.array([[0, 0], [width, 0], [width, length], [0, length]], float)
    path = np.array([[0, length / 2], [crack, length / 2]])
    corners = ((0, 0), (width, 0)) if shear else ()
    grading = _plate_grading(width, crack, refinement, (tuple(path[1]), *corners))
    model = Model(conforming_mesh(outline, [path], grading), tissue)
    top, bottom = (model.facets(lambda x, _, y=y: np.abs(x[:, 1] - y) < 1e-9) for y in (length, 0.0))
    if shear:
        model.prescribe(bottom, np.zeros(2))
        model.pull(top, (1, 0))
    else:
        model.pull(top, (0, 1))
        model.pull(bottom, (0, -1))
        model.pin((width, 0), (0, 1))
        model.pin((width, length), (0,))
    u = model.solve()
    return (*stress_intensity(model, u, path[1], (1, 0), 0.2 * crack, 0.6 * crack), model.energy(u))


def arc_crack(radius=4.25, half_angle_deg=28.0725, half_width=200.0, segments=120, refinement: float = 1.0):
    """K_I, K_II at the right tip of an arc of straight segments in a large plate, unit tension along its axis."""
    t = np.pi / 2 + np.deg2rad(half_angle_deg) * np.linspace(1, -1, segments + 1)
    path = radius * np.stack([np.cos(t), np.sin(t)], axis=1) - (0, radius)
    w = half_width
    outline = np.array([[-w, -w], [w, -w], [w, w], [-w, w]])
    step = float(np.linalg.norm(path[-1] - path[-2]))
    grading = Grading(w / 4 / refinement, 0.01 * step / refinement, 0.15 / refinement, tuple(map(tuple, path[[0, -1]])))
    model = Model(conforming_mesh(outline, [path], grading), Tissue(1.0, 0.3))
    for y, sign in ((w, 1), (-w, -1)):
        model.pull(model.facets(lambda x, _, y=y: np.abs(x[:, 1] - y) < 1e-9), (0, sign))
    model.pin((w, -w), (0, 1))
    model.pin((w, w), (0,))
    return stress_intensity(model, model.solve(), path[-1], path[-1] - path[-2], 0.3 * step, 0.95 * step)


def branched_crack(stem=1.0, branch=1.0, angle=np.pi / 4, half_width=40.0, refinement: float = 1.0):
    """(K_I, K_II) at the stem's tip and at the upper branch's, unit tension normal to the stem (problem f2)."""
    w = half_width
    outline = np.array([[-w, -w], [w, -w], [w, w], [-w, w]])
    arm = branch * np.array([np.cos(angle), np.sin(angle)])
    paths = [np.array([[-stem, 0.0], [0.0, 0.0]]), np.array([[0.0, 0.0], arm]), np.array([[0.0, 0.0], arm * (1, -1)])]
    focus = tuple(map(tuple, (paths[0][0], paths[0][1], paths[1][1], paths[2][1])))
    grading = Grading(w / 8 / refinement, 2e-3 / refinement, 0.15 / refinement, focus)
    model = Model(conforming_mesh(outline, paths, grading), Tissue(1.0, 0.3))
    for y, sign in ((w, 1), (-w, -1)):
        model.pull(model.facets(lambda x, _, y=y: np.abs(x[:, 1] - y) < 1e-9), (0, sign))
    model.pin((w, -w), (0, 1))
    model.pin((w, w), (0,))
    u = model.solve()
    reach = 0.5 * min(stem, branch)
    return (
        stress_intensity(model, u, paths[0][0], (-1, 0), 0.2 * reach, reach),
        stress_intensity(model, u, paths[1][1], arm, 0.2 * reach, reach),
    )


def _plate_grading(width, crack, refinement, focus):
    return Grading(width / 12 / refinement, 1e-4 * crack / refinement, 0.15 / refinement, focus)
