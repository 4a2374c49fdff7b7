"""A brain slice with a cut whose exact motion is known.

The scene is made of closed curves, in plane mm with x to the right, y anterior and the origin in the middle, so that
every label is a formula. Its motion is a field of `fields.py`; the moved scene is the scene at the resting place of
each point, which is found on either side of the cut by Newton's method. Nothing here is meshed or interpolated.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from math import cos, pi, radians, sin, sqrt

import numpy as np
from scipy.ndimage import gaussian_filter

from .fields import Linear, Sum, Williams, frame, resting, rigid

AIR, CSF, SKULL, SCALP, GM, WM, VENTRICLE, TUMOUR = range(8)
BRAIN = (GM, WM, VENTRICLE, TUMOUR)
T1 = {AIR: 0, CSF: 150, SKULL: 60, SCALP: 900, GM: 450, WM: 700, VENTRICLE: 150}

SEMI_AXES = 68.0, 84.0                      # mm, of the brain's ellipse
ENTRY = np.array([68 * cos(radians(35)), 84 * sin(radians(35))])
LENGTH, OPENING = 40.0, 6.0                 # mm, of the cut from ENTRY to TIP, and of its gap at ENTRY
TRAVEL = -ENTRY / np.linalg.norm(ENTRY)     # from the surface inwards: the cut runs along a ray from the centre
TIP = ENTRY + LENGTH * TRAVEL
POISSON = 0.45

# Left and right lip part by (kappa + 1) K_I / mu sqrt(r / 2 pi): K_I / mu makes that OPENING at ENTRY.
OPEN = Williams(tuple(TIP), tuple(TRAVEL), K_I=OPENING / ((4 - 4 * POISSON) * sqrt(LENGTH / (2 * pi))), nu=POISSON)
# One lip stays at the mouth and the other moves by the whole opening, as when a single blade pushes.
RETRACT = Sum(OPEN, Linear(np.zeros((2, 2)), -OPEN.displacement(ENTRY[None], -1)[0]))
ROTATE = rigid(radians(5))
MOTIONS = {"open": OPEN, "retract": RETRACT, "rigid": ROTATE}
REACH = 12.0                                # mm, beyond the motion of any tissue
TUMOURS = {"beside": ((32.0, 12.0), 11.0), "crossed": ((40.0, 35.0), 10.0)}    # centre and radius, mm


def radius(angle) -> np.ndarray:
    """Distance mm of the gyrated brain outline from the centre, in the polar direction `angle` rad."""
    a, b = SEMI_AXES
    ellipse = a * b / np.hypot(b * np.cos(angle), a * np.sin(angle))
    return ellipse * (1 + 0.015 * np.cos(18 * angle))


def outline(n: int = 720) -> np.ndarray:
    """Brain outline (n, 2) mm, counter-clockwise, the cut's mouth first."""
    angle = np.arctan2(ENTRY[1], ENTRY[0]) + 2 * pi * np.arange(n) / n
    return radius(angle)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


MOUTH = outline(1)[0]


def cut_path(beyond: float = 3.0) -> np.ndarray:
    """The cut (2, 2) mm as a surgeon draws it: from `beyond` mm outside the brain to the tip."""
    return np.array([MOUTH - beyond * TRAVEL, TIP])


def landmarks() -> np.ndarray:
    """Twenty fixed places (20, 2) mm in the brain, on a sunflower's spiral, none within 2 mm of the cut."""
    k = np.arange(20)
    angle = k * pi * (3 - sqrt(5)) + 0.5
    return 0.9 * np.sqrt((k[:, None] + 0.5) / 20) * np.stack([np.cos(angle), np.sin(angle)], axis=1) * SEMI_AXES


def side_of(points) -> np.ndarray:
    """+1 for points (n, 2) left of the cut's line and -1 on its right, walking from mouth to tip."""
    return np.where(_left_of_cut(points) >= 0, 1, -1)


def _left_of_cut(points) -> np.ndarray:
    """Distance (n,) mm of points (n, 2) to the left of the cut's line."""
    return (np.asarray(points) - TIP) @ frame(TRAVEL)[1]


@dataclass(frozen=True)
class Grid:
    """Pixels centred on the origin: `shape` (n1, n2) along x and y, `spacing` mm, and how files store them."""

    shape: tuple[int, int]
    spacing: tuple[float, float]
    order: str = "RAS"
    slope: float | None = None      # int16 with this scale factor; None for float32

    @property
    def origin(self) -> np.ndarray:
        """Centre (2,) mm of pixel (0, 0)."""
        return -(np.array(self.shape) - 1) / 2 * self.spacing

    def centres(self) -> np.ndarray:
        """Pixel centres (n1, n2, 2) mm."""
        return self.origin + np.moveaxis(np.indices(self.shape), 0, -1) * self.spacing


# int16 with a slope of .01 ends at 327.67; .05 holds the brightest pixel of the phantom, about 1300.
GRIDS = {"A": Grid((256, 256), (0.8, 0.8)), "B": Grid((200, 260), (1.0, 0.8), "LAS", slope=0.05)}


@dataclass(frozen=True)
class Phantom:
    """The scene: `tumour` beside the cut or crossed, `contrast` t1gd (bright rim) or flair (flat), and its `motion`."""

    tumour: str = "beside"
    contrast: str = "t1gd"
    motion: str = "open"
    grid: Grid = field(default=GRIDS["A"])

    def labels_at(self, points) -> np.ndarray:
        """Label (n,) uint8 at points (n, 2) mm at rest; NaN points are air."""
        x, y = np.asarray(points, float).T
        rho, edge = np.hypot(x, y), radius(np.arctan2(y, x))
        label = np.select([rho < edge - 4, rho < edge, rho < edge + 3, rho < edge + 9, rho < edge + 14],
                          [WM, GM, CSF, SKULL, SCALP], AIR).astype(np.uint8)
        for sign in (1, -1):     # the frontal horns lean outwards
            c, s = cos(radians(10)), sign * sin(radians(10))
            across, along = c * (x - 10 * sign) - s * (y - 4), s * (x - 10 * sign) + c * (y - 4)
            label[(across / 5) ** 2 + (along / 18) ** 2 < 1] = VENTRICLE
        label[self._tumour_depth(points) > 0] = TUMOUR
        return label

    def _tumour_depth(self, points) -> np.ndarray:
        centre, r = TUMOURS[self.tumour]
        return r - np.linalg.norm(np.asarray(points) - centre, axis=-1)

    def intensity_at(self, points) -> np.ndarray:
        """Signal (n,) at points (n, 2) mm at rest, before the scanner's blur and bias."""
        table = np.array([T1.get(label, 0.0) for label in range(8)], float)
        value = table[self.labels_at(points)]
        depth = self._tumour_depth(points)
        if self.contrast == "flair":
            return np.where(depth > 0, 1100.0, value)
        return np.where(depth > 0, np.where(depth < 2, 950.0, 350.0), value)

    def scan(self, signal: Callable, bias_at: np.ndarray) -> np.ndarray:
        """Image (n1, n2) of `signal(points (n, 2)) -> (n,)`: mean of 4 x 4 samples a pixel, blur of .6 mm, bias.

        The bias is 1 + .15 x / 100 at the places `bias_at` (n1, n2, 2) mm.
        """
        image = np.zeros(self.grid.shape)
        for step in np.ndindex(4, 4):
            offset = ((np.array(step) + 0.5) / 4 - 0.5) * self.grid.spacing
            image += signal((self.grid.centres() + offset).reshape(-1, 2)).reshape(self.grid.shape) / 16
        blurred = gaussian_filter(image, 0.6 / np.array(self.grid.spacing), mode="nearest")
        return blurred * (1 + 0.15 * bias_at[..., 0] / 100)

    def image(self, seed: int | None = None) -> np.ndarray:
        """Preoperative image (n1, n2); with a `seed`, Rician noise of sigma 20."""
        clean = self.scan(self.intensity_at, self.grid.centres())
        if seed is None:
            return clean
        real, imaginary = np.random.default_rng(seed).normal(0, 20, (2, *self.grid.shape))
        return np.hypot(clean + real, imaginary)

    @cached_property
    def labels(self) -> np.ndarray:
        """Label map (n1, n2) uint8 at the pixel centres."""
        return self.labels_at(self.grid.centres().reshape(-1, 2)).reshape(self.grid.shape)

    @cached_property
    def mask(self) -> np.ndarray:
        """Brain (n1, n2) bool."""
        return np.isin(self.labels, BRAIN)

    @property
    def motion_field(self):
        """The displacement field, with `displacement(points, side)`."""
        return MOTIONS[self.motion]

    @property
    def has_cut(self) -> bool:
        """Whether the motion opens the cut."""
        return self.motion != "rigid"

    def displacement(self, points) -> np.ndarray:
        """Displacement (n, 2) mm of points (n, 2) at rest, on the side of the cut where each one is."""
        return self.motion_field.displacement(points, side_of(points) if self.has_cut else 0)

    def resting_places(self, points) -> np.ndarray:
        """Where the brain tissue now at points (n, 2) mm rested, (n, 2) mm; NaN where there is none."""
        points = np.asarray(points, float)
        found = np.full(points.shape, np.nan)
        near = np.flatnonzero(np.hypot(*points.T) < radius(np.arctan2(*points.T[::-1])) + REACH)
        for side in (1, -1) if self.has_cut else (0,):
            n = near[side * _left_of_cut(points[near]) > -REACH]
            x = resting(self.motion_field, points[n], side)
            # On the line ahead of the tip either side may claim a point, and rounding must not let both refuse it.
            here = np.isin(self.labels_at(x), BRAIN) & (side * _left_of_cut(x) >= -1e-9)
            found[n[here]] = x[here]
        return found

    @cached_property
    def truth(self) -> "Truth":
        """What a perfect update of the noise-free image and of the labels looks like."""
        centres = self.grid.centres()
        places = self.resting_places(centres.reshape(-1, 2)).reshape(centres.shape)
        tissue = np.isfinite(places[..., 0])
        cavity = self.mask & ~tissue
        labels = np.where(tissue, self.labels_at(places.reshape(-1, 2)).reshape(self.grid.shape), self.labels)
        image = self.scan(self._moved_intensity_at, np.where(tissue[..., None], places, centres))
        return Truth(image, np.where(cavity, AIR, labels).astype(np.uint8), cavity, places)

    def _moved_intensity_at(self, points) -> np.ndarray:
        places = self.resting_places(points)
        empty = np.isnan(places[:, 0])
        vacated = empty & np.isin(self.labels_at(points), BRAIN)
        return np.where(vacated, 0, self.intensity_at(np.where(empty[:, None], points, places)))


@dataclass(frozen=True, eq=False)
class Truth:
    """The moved scene: `image`, `labels`, `cavity` (n1, n2), and `places` (n1, n2, 2) mm at rest, NaN without brain.

    As in an updated image, the head outside the brain stays, and what the brain has left is 0.
    """

    image: np.ndarray
    labels: np.ndarray
    cavity: np.ndarray
    places: np.ndarray


def boundary_displacement(phantom: Phantom, n: int = 720) -> np.ndarray:
    """Motion of the outline, (n + 1, 5): x, y, ux, uy mm and the side of the cut's line, +1 left or -1 right.

    The mouth comes twice, first as the right lip's end and last as the left lip's.
    """
    points = outline(n)[np.r_[0:n, 0]]
    side = side_of(points)
    side[0], side[-1] = -1, 1
    return np.column_stack([points, phantom.motion_field.displacement(points, side), side])


def perfect_solution(phantom: Phantom, rays: int = 720, rings: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of the brain at rest and moved, both (t, 3, 2) mm, as a solver without error would return them.

    They fan out from the tip to the outline along `rays`, the cut being the first ray and the last. The rings' distance
    from the tip grows with the square of their number, so that the field's sqrt(r) is resolved.
    """
    rim = outline(rays)[np.r_[0:rays, 0]]
    s = (np.arange(rings + 1) / rings) ** 2
    side = side_of(rim)
    side[0], side[-1] = -1, 1
    points = TIP + s[:, None, None] * (rim - TIP)
    u = phantom.motion_field.displacement(points.reshape(-1, 2), np.tile(side, rings + 1)).reshape(points.shape)

    def triangles(x):
        near, far = x[:-1], x[1:]
        halves = (near[:, :-1], far[:, :-1], far[:, 1:]), (near[:, :-1], far[:, 1:], near[:, 1:])
        return np.concatenate([np.stack(corners, axis=-2).reshape(-1, 3, 2) for corners in halves])

    at_tip = slice(rings * rays, (rings + 1) * rays)    # second halves of the first ring, which have no area
    return np.delete(triangles(points), at_tip, axis=0), np.delete(triangles(points + u), at_tip, axis=0)
