"""Fibre tracts (.trk, .tck) through the motion of the tissue in a slice or a volume.

Of a slice the motion is known in it alone. The parts of a streamline within the slice's slab move with the tissue and
keep their distance from its plane; of a volume the slab is all of space. Each part ends at a lip where it meets a cut,
and what ran through resected tissue is gone. All other parts, off the slab or outside of the organ, stay as they are or
are dropped, never moved by guess.
"""

from dataclasses import dataclass

import numpy as np
from nibabel.streamlines.tractogram_file import TractogramFile

from xfemnav.errors import warn
from xfemnav.geometry.locate import LIP, held
from xfemnav.geometry.motion import Motion
from xfemnav.imaging.frames.grid import Grid
from xfemnav.imaging.points.tract_files import file_like

FLAGS = ("kept", "moved", "split", "trimmed")  # their numbers are what a .trk stores
STEP = 1.0  # mm: no longer step lies within moving tissue, where a straight line becomes a bent one
SAME = 1e-9  # rounding, as a part of what is rounded
MEETS = 1e-4  # part of a step within which a crossing is at its end: files round points to 1e-5 mm
INSIDE = 1e-6  # part of a step by which an end of tissue is drawn into it: rounding must not put it outside
_STAYS, _MOVES, _GONE = range(3)


@dataclass(frozen=True, eq=False)
class MovedStreamlines:
    """A tractogram after the motion: `file`, whose `save(path)` writes the input's format; for each of its streamlines
    the `flag` and the `source` (n,), the number of the one in the input that it is or was a part of.

    "kept": where it was, for the motion there is unknown; "moved": whole; "split": it ends at a lip; "trimmed": it ends
    where tissue was resected, or where the slab or the organ ends. A .trk also has them as its property "motion", 0 to
    3 in this order; a .tck has no place for them.
    """

    file: TractogramFile
    flag: tuple[str, ...]
    source: np.ndarray



def move_streamlines(file: TractogramFile, frame: Grid, motion: Motion, organ, *,
                     half_mm: float | None = None, elsewhere: str = "keep") -> MovedStreamlines:
    """The streamlines of `file` after the `motion` of the tissue in the slice or volume `frame`.

    `organ` (t, d + 1, d) mm: simplices of the whole organ at rest, also of what was resected. What lies within
    `half_mm` of the plane (by default half the slice's thickness) moves. `elsewhere`: "keep" the parts off the slab and
    outside of the organ as streamlines of their own, or "drop" them. Streamlines of one point, too, stay.
    """
    if elsewhere not in ("keep", "drop"):
        raise ValueError(f"elsewhere is {elsewhere!r}, wanted keep or drop")
    half = frame.thickness / 2 if half_mm is None else half_mm
    owner = np.repeat(np.arange(len(file.streamlines)), [len(points) for points in file.streamlines])
    line = _Line(file.streamlines.get_data().astype(float), owner, frame, half)
    s, crossings = _stops(line, motion)
    if len(s) and not line.in_slab(s).any():
        least = np.abs(frame.from_world(line.points)[1]).min()
        warn("W132", f"no streamline comes to the slice, the nearest to {least:.2f} mm: none was moved. Check their "
                     "frame.")
    state = _states(line, s, motion, organ)
    at_lip = _lips(line, s, crossings, state, motion)
    first, last, state = _pieces(line, s, state, at_lip, elsewhere)
    at = np.concatenate([np.zeros(0, int), *(np.arange(a, b + 1) for a, b in zip(first, last))])
    points = _moved(line, s, first, last, state, at, motion)
    whole = line.is_end(s[first]) & line.is_end(s[last])
    code = np.select([state == _STAYS, at_lip[first] | at_lip[last], whole], [0, 2, 1], 3)
    source = owner[s[first].astype(int)]
    moved = file_like(file, points, last - first + 1, line.at(s[at]), source, code)
    return MovedStreamlines(moved, tuple(FLAGS[k] for k in code), source)


class _Line:
    """All streamlines one behind the other: `points` (n, 3) RAS mm, and the `owner` (n,) of each.

    A place on them is a number s: point k at s = k, and evenly from there to the next.
    """

    def __init__(self, points, owner, frame: Grid, half: float):
        self.points, self.frame, self.half = points, frame, half
        self.joined = np.append(owner[1:] == owner[:-1], False)  # whether point k goes on to k + 1

    def at(self, s):
        """The points k before the places `s` (n,), the next ones, and the part t of the way between them."""
        k = s.astype(int)
        return k, np.minimum(k + 1, len(self.points) - 1), s - k

    def is_end(self, s) -> np.ndarray:
        """Whether the places `s` are first or last points of a streamline, (n,) bool."""
        k = s.astype(int)
        return (s == k) & ~(self.joined[k] & self.joined[k - 1])

    def world(self, s) -> np.ndarray:
        """World RAS mm (n, 3) of the places `s`."""
        k, following, t = self.at(s)
        return self.points[k] + t[:, None] * (self.points[following] - self.points[k])

    def plane(self, s) -> np.ndarray:
        """Where the places `s` are on the grid, (n, d) mm."""
        return self.frame.from_world(self.world(s))[0]

    def in_slab(self, s) -> np.ndarray:
        """Whether the places `s` are within the slab, (n,) bool."""
        return abs(self.frame.from_world(self.world(s))[1]) <= self.half * (1 + SAME)

    def steps(self, s) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the steps from s[i] to s[i + 1] that are on one streamline and in the slab; and their middles."""
        i = np.flatnonzero(self.joined[s[:-1].astype(int)])
        middle = (s[i] + s[i + 1]) / 2
        inside = self.in_slab(middle)
        return i[inside], middle[inside]


def _stops(line: _Line, motion) -> tuple[np.ndarray, np.ndarray]:
    """Sorted places s: all points, where the slab's faces, cuts and ends of tissue are met, and STEP apart; and those
    on cuts."""
    s = np.arange(len(line.points), dtype=float)
    distance = line.frame.from_world(line.points)[1]
    before, after = distance[:-1], distance[1:]
    faces = [k + (face - before[k]) / (after[k] - before[k]) for face in (line.half, -line.half)
             for k in [np.flatnonzero(line.joined[:-1] & ((before - face) * (after - face) < 0))]]
    s = np.unique(np.concatenate([s, *faces]))
    i, _ = line.steps(s)
    parts = np.ceil(np.linalg.norm(line.world(s[i + 1]) - line.world(s[i]), axis=1) / STEP).astype(int)
    within = [s[i[parts == n], None] + (s[i[parts == n] + 1] - s[i[parts == n]])[:, None] * np.arange(1, n) / n
              for n in np.unique(parts[parts > 1])]
    s = np.unique(np.concatenate([s, *(w.ravel() for w in within)]))
    crossings = _crossings(line, s, motion)
    s = np.unique(np.concatenate([s, crossings]))
    return np.unique(np.concatenate([s, _ends_of_tissue(line, s, motion)])), crossings


def _crossings(line: _Line, s, motion) -> np.ndarray:
    """Places where steps in the slab meet the cuts."""
    i, _ = line.steps(s)
    k, t = motion.crossings(line.plane(s[i]), line.plane(s[i + 1]))
    t = np.where(t < MEETS, 0, np.where(t > 1 - MEETS, 1, t))
    return np.unique((1 - t) * s[i[k]] + t * s[i[k] + 1])


def _ends_of_tissue(line: _Line, s, motion) -> np.ndarray:
    """Places just within the tissue on steps that lead out of it, by bisection to a millionth of the step."""
    i, _ = line.steps(s)
    holds = [motion.holds(line.plane(s[i + k])) for k in (0, 1)]
    leaves = holds[0] != holds[1]
    start, end = s[i[leaves]], s[i[leaves] + 1]
    inner, outer = np.where(holds[0][leaves], (start, end), (end, start))
    whole = abs(end - start)
    for _ in range(20):    # 2^-20 is INSIDE
        middle = (inner + outer) / 2
        inside = motion.holds(line.plane(middle))
        inner, outer = np.where(inside, middle, inner), np.where(inside, outer, middle)
    return np.clip(inner - np.sign(outer - inner) * INSIDE * whole, start, end)


def _states(line: _Line, s, motion, organ) -> np.ndarray:
    """What becomes of each step (n - 1,): it moves where tissue holds it whole, is gone where the organ alone does."""
    state = np.full(len(s) - 1, _STAYS)
    i, middle = line.steps(s)
    at = line.plane(middle)
    tissue = motion.holds(at)
    whole = tissue & motion.holds(line.plane(s[i])) & motion.holds(line.plane(s[i + 1]))
    state[i] = np.select([whole, ~tissue & held(at, organ)], [_MOVES, _GONE], _STAYS)
    return state


def _lips(line: _Line, s, crossings, state, motion) -> np.ndarray:
    """Places (n,) bool where a streamline goes through a cut from one lip to the other."""
    at_lip = np.zeros(len(s), bool)
    p = np.flatnonzero(np.isin(s[1:-1], crossings)) + 1
    p = p[line.joined[s[p - 1].astype(int)] & line.joined[s[p].astype(int)] & (state[p - 1] == _MOVES)
          & (state[p] == _MOVES)]
    if len(p):
        before, after = (motion.beside(_towards(line.plane(s[p]), line.plane(s[p + k])))[1] for k in (-1, 1))
        at_lip[p] = before != after
    return at_lip


def _towards(points, others) -> np.ndarray:
    """Points (n, d) half a lip's width nearer to the others, at most halfway."""
    way = others - points
    length = np.linalg.norm(way, axis=1)[:, None]
    return points + way * np.minimum(0.5, LIP / 2 / np.where(length > 0, length, 1))


def _pieces(line: _Line, s, state, at_lip, elsewhere: str):
    """First and last number in `s` and the state, each (m,), of the longest runs of steps with one fate."""
    on = line.joined[s[:-1].astype(int)]
    again = np.zeros(len(s), bool)    # places where a run goes on
    again[1:-1] = on[:-1] & on[1:] & (state[1:] == state[:-1]) & ~at_lip[1:-1]
    starts, stops = np.flatnonzero(on & ~again[:-1]), np.flatnonzero(on & ~again[1:]) + 1
    alone = np.flatnonzero(~np.append(on, False) & ~np.append(False, on))    # streamlines of one point
    first, last = np.append(starts, alone), np.append(stops, alone)
    fate = np.append(state[starts], np.full(len(alone), _STAYS))
    wanted = (fate == _MOVES) | ((fate == _STAYS) & (elsewhere == "keep"))
    order = np.argsort(first[wanted], kind="stable")
    return first[wanted][order], last[wanted][order], fate[wanted][order]


def _moved(line: _Line, s, first, last, state, at, motion) -> np.ndarray:
    """World RAS mm (n, 3) of the places s[at] of the pieces one behind the other, those that move where they are now.

    Beside a cut, each point is on the lip of the side on which its piece goes on: the point itself may lie on the cut,
    or beyond it by what a file rounds.
    """
    world, count = line.world(s[at]), last - first + 1
    moves, stop = np.repeat(state == _MOVES, count), np.cumsum(count)
    on = np.ones(len(at), int)    # the way on in its piece from each point; from the last one, back
    on[stop - 1] = -1
    plane, distance = line.frame.from_world(world[moves])
    neighbour = s[(at + on)[moves]]
    side = np.zeros(len(plane), int)
    if motion.cuts:
        near = motion.near(plane)
        side[near] = motion.beside(_towards(plane[near], line.plane(neighbour[near])))[1]
    now, beside = motion.to_current(plane), side != 0
    lip = motion.to_current(plane[beside], side[beside])
    now[beside] = np.where(np.isfinite(lip), lip, now[beside])    # where a resection ends a lip the tissue beside it
    world[moves] = line.frame.to_world(now) + distance[:, None] * line.frame.axes[2]
    return world
