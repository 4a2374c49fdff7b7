"""How far tissue is strained, turned and blown up: numbers by which an answer is believed or not.

Strains at tips, blades' ends and edges of the bone have no bound, and a finer mesh shows more of them. So a measure is
never a maximum, but what an area of tissue exceeds. Tissue much softer than the most part (ventricles, cavities) may be
strained and turned as it likes, and is left out where a measure is one of the main tissue.
"""

from dataclasses import dataclass

import numpy as np

from xfemnav.geometry.mesh import gradients
from xfemnav.limits import RESIZED_TIMES, TRIPLED_TIMES

#: Tissue of less than this part of the main tissue's Young's modulus is soft.
SOFT = 0.5
#: The part of the tissue that exceeds its largest strain.
SHARE = 0.01
#: Places this far apart, mm, are two.
NEAR_MM = 5.0


@dataclass(frozen=True)
class Turning:
    """Main tissue that a linear model turns: `area_mm2`, in space mm^3, of it by more than `degrees`, most of it at
    `place_mm`.

    error_mm: how far small rotations misplace it.
    """

    error_mm: float
    degrees: float
    area_mm2: float
    place_mm: tuple[float, ...]


@dataclass(frozen=True)
class Measures:
    """Of the main tissue: its Young's modulus kPa, and the largest absolute principal strain that 1 % of it exceeds;
    how it turns (None with a model of finite strains, which has that right); the areas at rest mm^2, in space volumes
    mm^3, that more than double or halve, and that more than treble. `places`: where each of these is the most, mm, by
    its name."""

    main_young_kpa: float
    main_strain: float
    turning: Turning | None
    resized_mm2: float
    tripled_mm2: float
    places: dict[str, tuple[float, ...]]


def measure(problem, solution) -> Measures:
    """The measures of a problem's solution."""
    young = problem.material.young_in(problem.parts.cell[solution.part])
    areas, size = solution.rest_areas, principal_size(solution.strain)
    typical = exceeded(young, areas, 0.5 * areas.sum())
    main = young >= SOFT * typical
    centres, det_F = solution.rest.mean(axis=1), solution.det_F
    strain = exceeded(size[main], areas[main], SHARE * areas[main].sum())
    resized = main & ((det_F > RESIZED_TIMES) | (det_F < 1 / RESIZED_TIMES))
    tripled = main & (det_F > TRIPLED_TIMES)
    where = {"main_strain": main & (size >= strain), "resized_mm2": resized, "tripled_mm2": tripled}
    turning = _turning(solution, main) if solution.model == "linear" else None
    places = {name: densest(centres[some], areas[some]) for name, some in where.items() if some.any()}
    return Measures(
        main_young_kpa=typical,
        main_strain=strain,
        turning=turning,
        resized_mm2=float(areas[resized].sum()),
        tripled_mm2=float(areas[tripled].sum()),
        places=places if turning is None else places | {"turning_mm": turning.place_mm},
    )


def displacement_gradient(rest, moved) -> np.ndarray:
    """H (t, d, d) = du_i/dx_j of simplices (t, d + 1, d) mm at rest and moved."""
    return np.einsum("tai,taj->tij", moved - rest, gradients(rest))


def strains(H, finite: bool) -> np.ndarray:
    """Strain (t, k) of displacement gradients H (t, d, d): xx, yy, xy, in space xx, yy, zz, xy, yz, zx; with `finite`
    Green and Lagrange's."""
    E = (H + H.swapaxes(1, 2)) / 2
    if finite:
        E += np.einsum("tki,tkj->tij", H, H) / 2
    return E[:, *_components(H.shape[1])]


def _components(d):
    """Rows and columns of a tensor's components as they are listed: the diagonal, then each axis with the next."""
    axes = np.arange(d)
    rows = np.concatenate([axes, axes[: d * (d - 1) // 2]])
    return rows, np.concatenate([axes, (axes[: d * (d - 1) // 2] + 1) % d])


def principal_size(strain) -> np.ndarray:
    """The largest absolute principal strain (t,) of strains (t, k), see `strains`."""
    d = int(np.sqrt(2 * strain.shape[1]))
    E = np.empty((len(strain), d, d))
    for k, (i, j) in enumerate(zip(*_components(d))):
        E[:, i, j] = E[:, j, i] = strain[:, k]
    return np.abs(np.linalg.eigvalsh(E)).max(axis=1, initial=0.0)


def exceeded(values, areas, area: float) -> float:
    """The largest of the values (t,), of tissue with areas (t,) mm^2, that an `area` mm^2 of tissue reaches."""
    order = np.argsort(-values)
    return float(values[order][np.searchsorted(np.cumsum(areas[order]), area)])


def densest(points, areas) -> tuple[float, ...]:
    """The mean of those points (k, d) mm, each standing for an area (k,), that lie where the most area is together."""
    _, cell = np.unique(np.floor(points / NEAR_MM).astype(int), axis=0, return_inverse=True)
    heaviest = cell == np.bincount(cell, areas).argmax()
    return tuple(np.average(points[heaviest], axis=0, weights=areas[heaviest]).tolist())


def _turning(solution, main):
    """Of all angles the one beyond which the tissue turned is misplaced the most."""
    H = displacement_gradient(solution.rest[main], solution.moved[main])
    U, _, V = np.linalg.svd(H + np.eye(H.shape[1]))
    R = U @ V
    R[np.linalg.det(R) < 0] = np.eye(H.shape[1])  # turned inside out: its rotation says nothing
    angle = 2 * np.arcsin(np.minimum(np.linalg.norm(R - np.eye(H.shape[1]), axis=(1, 2)) / np.sqrt(8), 1.0))
    order = np.argsort(-angle)
    area = np.cumsum(solution.rest_areas[main][order])
    error = angle[order] ** 2 / 2 * area ** (1 / H.shape[1])
    k = int(error.argmax())
    turned = np.flatnonzero(main)[order[: k + 1]]
    place = densest(solution.rest[turned].mean(axis=1), solution.rest_areas[turned])
    return Turning(float(error[k]), float(np.rad2deg(angle[order[k]])), float(area[k]), place)
