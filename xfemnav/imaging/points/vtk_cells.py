"""The cells of VTK's PolyData: vertices, lines, polygons and triangle strips, which are triangles here."""

from dataclasses import dataclass

import numpy as np

from xfemnav.imaging.points.surface_form import kept_corners, starts, strips_as_triangles

KINDS = ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS")  # in the order in which cells have their data


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of all kinds one behind the other: `corners` (k,), `count` (m,) of them each, the `kind` (m,) as a number
    of KINDS, and the `row` (m,) of what the file says of them; it has `n_rows`.

    The triangles of a strip are polygons, and share its row.
    """

    corners: np.ndarray
    count: np.ndarray
    kind: np.ndarray
    row: np.ndarray
    n_rows: int

    @classmethod
    def of(cls, groups: dict[str, tuple[np.ndarray, np.ndarray]]) -> "Cells":
        """The cells of `groups`, the corners (k,) and their number (m,) for each of KINDS that there is."""
        parts, n_rows, none = [], 0, np.zeros(0, int)
        for number, name in enumerate(KINDS):
            corners, count = groups.get(name, (none, none))
            if starts(count)[-1] != len(corners):
                raise ValueError(f"{name} have {len(corners)} corners, not {starts(count)[-1]}")
            rows, after = np.arange(len(count)), n_rows + len(count)
            if name == "TRIANGLE_STRIPS":
                triangles, rows = strips_as_triangles(corners, count)
                corners, count, number = triangles.reshape(-1), np.full(len(rows), 3), KINDS.index("POLYGONS")
            parts.append((corners, count, np.full(len(count), number), n_rows + rows))
            n_rows = after
        corners, count, kind, row = (np.concatenate(part).astype(int) for part in zip(*parts))
        return cls(corners, count, kind, row, n_rows)

    def of_kind(self, name: str, kept) -> tuple[np.ndarray, np.ndarray]:
        """Corners and their number of the cells of one of KINDS that are `kept` (m,) bool."""
        chosen = kept & (self.kind == KINDS.index(name))
        return kept_corners(self.corners, self.count, chosen), self.count[chosen]
