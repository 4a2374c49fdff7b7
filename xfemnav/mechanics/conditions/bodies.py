"""Bodies of tissue that cuts and resections leave: what holds each of them, and what becomes of one that nothing holds.

A body may lose a rigid motion that no condition and no spring of it meets. Such a loose piece is refused, removed, or
held at its mean: its free rigid motions, and only those, are zero in the mean over it, so that it can still deform.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.linalg import qr
from scipy.sparse import csr_array, vstack

from xfemnav.errors import XfemnavError, warn
from xfemnav.mechanics.conditions.constraints import SKULL, Constraints, Means, stack, vector_rows
from xfemnav.mechanics.space.enrichment import BRANCH
from xfemnav.mechanics.space.space import Space

#: A rigid motion is free when conditions and springs meet less than this of its square: held by so short a lever, a
#: piece would move a hundred times as far as what holds it.
FREE_MOTION = 1e-4
#: A body takes part in a joint motion when its share of that is larger than this.
PART = 1e-3


@dataclass(frozen=True)
class Piece:
    """A connected body of tissue: its area mm^2, in space its volume mm^3, a place in it (d,) mm, and its `fate`.

    'fixed': the skull or a retractor holds it; 'held': loose, and held at its mean; 'removed': loose, and not in the
    result.
    """

    name: str
    area_mm2: float
    place_mm: tuple[float, ...]
    fate: str


def sort_out(
    space: Space, cuts, resections, retractions, constraints: Constraints, springs, loose: str
) -> tuple[Constraints, Means | None, np.ndarray, tuple[Piece, ...]]:
    """All conditions, the means that hold what is loose and stays, the parts (p,) bool that are loose and go, and all
    pieces.

    Resected parts move nowhere. Crumbs smaller than an element go (W311). Larger loose pieces: E306, or with `loose`
    'remove' they go (W312), with 'hold' they stay (W313). E406 when nothing holds the organ.
    """
    table, split = space.enrichment, space.parts
    area = np.bincount(table.body, np.bincount(split.part, split.volumes, split.n_parts))
    bodies = np.unique(table.body[~split.removed])
    bodies = bodies[np.argsort(-area[bodies], kind="stable")]
    (motions, work), m = _rigid_work(space, constraints, springs, bodies), n_motions(space.mesh.dim)
    fates, removed, held, crumbs = ["fixed"] * len(bodies), np.zeros(split.n_parts, dtype=bool), {}, []
    while (k := _smallest_free(work, m)) is not None:
        parts, free = table.body == bodies[k], _free(work, k, m)
        is_crumb = area[bodies[k]] < np.median(space.mesh.volumes)
        if "fixed" not in fates[1:] and k == 0:
            raise XfemnavError(
                "E406",
                "nothing holds the organ: its outline is free and no blade holds it, so it could move rigidly; "
                "use ⟦skull=fixed⟧, or hold a lip.",
            )
        fates[k] = "removed" if is_crumb or (loose == "remove" and k) else "held" if loose == "hold" else "refused"
        share = 100 * area[bodies[k]] / area[bodies].sum()
        what = f"{area[bodies[k]]:.3g} mm{space.mesh.dim} ({share:.2g} % of the tissue)"
        if is_crumb:
            crumbs.append(f"{what} about {_mm(_place(split, parts))}")
        elif k not in held:
            _tell(space, cuts, resections, retractions, parts, what, fates[k], loose == "remove")
        if fates[k] == "held":  # perhaps again: a motion of several pieces may ask for more of this one
            held[k] = np.hstack([held.get(k, np.empty((m, 0))), free])
        removed |= parts & (fates[k] == "removed")
        own = slice(m * k, m * k + m)
        work[own, own] += free @ free.T if fates[k] == "held" else np.eye(m)
    pieces = []
    for k, body in enumerate(bodies):
        place = _place(split, table.body == body)
        name = f"piece about {_mm(place)}" if k else "organ"
        pieces.append(Piece(name, float(area[body]), tuple(place.tolist()), fates[k]))
    if crumbs:
        more = f", and {len(crumbs) - 1} smaller ones" if len(crumbs) > 1 else ""
        warn("W311", f"a loose piece of {crumbs[-1]}{more}, under the size of an element, was cut free and removed.")
    conditions = stack([constraints, at_rest(table, split.removed)], table.n_dof)
    rows = [
        _held_at_mean(space, table.body == bodies[k], motions[:, m * k : m * k + m] @ _span(free))
        for k, free in held.items()
    ]
    means = Means(vstack([C for C, _ in rows]), np.concatenate([pins for _, pins in rows])) if rows else None
    return conditions, means, removed, tuple(pieces)


def _tell(space, cuts, resections, retractions, parts, what, fate, removes):
    """Refuse a loose piece, or warn of what was done to it. `removes`: loose pieces go, but for the largest."""
    split = space.parts
    place = _mm(_place(split, parts))
    sides = {(split.lips.cut[lip], side) for side, column in ((1, 0), (-1, 1))
             for lip in np.flatnonzero(parts[split.lips.parts[:, column]])}
    names = [f"cut '{cuts[k].name}'" for k in sorted({cut for cut, _ in sides})]
    holes = np.unique(split.walls.source[parts[split.walls.parts]])
    names += [f"resection '{resections[k].name}'" for k in holes[holes >= 0]]
    by = " and ".join(names) or "the mesh"
    pulled = any((r.cut, r.side) in sides and not r.holds for r in retractions)
    if fate == "refused" or (fate == "removed" and pulled):
        why = "a retractor pulls on that piece, but" if pulled else "and"
        remedy = "hold the piece, or say what to do with it: ⟦loose_pieces=remove|hold⟧."
        if removes:
            largest = "the largest piece is not removed: " if fate == "refused" else ""
            remedy = f"{largest}hold it by a blade or the skull, or say ⟦loose_pieces=hold⟧."
        raise XfemnavError(
            "E306",
            f"{by} {'frees' if len(names) < 2 else 'free'} a piece of {what} about {place}, {why} nothing holds it; "
            f"let the cut end inside; {remedy}",
        )
    if fate == "removed":
        warn("W312", f"a loose piece of {what} about {place}, freed by {by}, was removed: it is not in the result.")
    else:
        warn("W313", f"a loose piece of {what} about {place}, freed by {by}, is held at its mean position: where it "
                     "lies is not computed.")


def free_motions(space: Space, constraints: Constraints, springs, body: int) -> np.ndarray:
    """The rigid motions (n_dof, m) of a body that meet no condition and no spring."""
    motions, work = _rigid_work(space, constraints, springs, [body])
    return motions @ _free(work, 0, work.shape[0])


def _rigid_work(space, constraints, springs, bodies):
    """The rigid motions of each body, (n_dof, m b) sparse, and what conditions and springs do to them (m b, m b).

    There are m = d (d + 1) / 2 to a body, d shifts and turns in each plane of two axes.
    One condition may act on several bodies, a mean over a stretch of lip that crossings have cut into pieces: it takes
    one motion from all of them together.
    """
    table, mesh, split = space.enrichment, space.mesh, space.parts
    volume = np.bincount(table.body, np.bincount(split.part, split.volumes, split.n_parts))
    row_body = np.full(table.n_rows, -1)
    row_body[table.dof] = table.body[:, None]
    row_body[table.kind >= BRANCH] = -1
    # A row's length is its unit's and its element's business; whether it is met is not.
    length = np.sqrt(np.asarray(constraints.C.multiply(constraints.C).sum(axis=1)).ravel())
    conditions = constraints.C.multiply(1 / np.maximum(length, 1e-300)[:, None]).tocsr()
    stiff = np.abs(springs.diagonal()).reshape(-1, mesh.dim).max(axis=1)
    m, d, parts, scale = n_motions(mesh.dim), mesh.dim, [], []
    for k, body in enumerate(bodies):
        own = np.flatnonzero(row_body == body)
        x = mesh.points[table.node[own]] - mesh.points[table.node[own]].mean(axis=0)
        x = x / np.sqrt((x**2).sum(axis=1).mean())
        rows, columns = np.broadcast_arrays(d * own[:, None, None] + np.arange(d)[:, None], m * k + np.arange(m))
        parts.append((rows.ravel(), columns.ravel(), rigid_motions(x).ravel()))
        # A crumb on the first, soft springs of the skull's ramp would be thrown about; a larger body meets others.
        grip = stiff.max() if volume[body] < np.median(mesh.volumes) else stiff[own].max()
        scale.append(np.full(m, np.sqrt(max(grip, 1e-300))))
    rows, columns, data = (np.concatenate(each) for each in zip(*parts))
    scale = np.concatenate(scale)
    motions = csr_array((data, (rows, columns)), (table.n_dof, m * len(bodies)))
    met = conditions @ motions
    work = (motions.T @ (springs @ motions)).toarray() / (scale[:, None] * scale)
    return motions, work + (met.T @ met).toarray()


def n_motions(d: int) -> int:
    """Number of rigid motions in d dimensions."""
    return d * (d + 1) // 2


def rigid_motions(points) -> np.ndarray:
    """Displacements (k, d, m) of points (k, d) in each infinitesimal rigid motion: shifts along the axes, and turns of
    one axis towards a later one."""
    k, d = points.shape
    turns = np.zeros((k, d, n_motions(d) - d))
    for t, (i, j) in enumerate(combinations(range(d), 2)):
        turns[:, i, t], turns[:, j, t] = -points[:, j], points[:, i]
    return np.concatenate([np.broadcast_to(np.eye(d), (k, d, d)), turns], axis=2)


def _null(work):
    value, vector = np.linalg.eigh(work)
    return vector[:, value < FREE_MOTION]


def _smallest_free(work, m):
    """The last body, of m motions each, that takes part in a rigid motion that nothing meets; None when all are met."""
    share = np.sqrt((_null(work) ** 2).sum(axis=1)).reshape(-1, m).max(axis=1)
    taking_part = np.flatnonzero(share > PART)
    return int(taking_part[-1]) if len(taking_part) else None


def _free(work, k, m):
    """Orthonormal motions (m, n) of body k that take part in what nothing meets."""
    return _span(_null(work)[m * k : m * k + m])


def _span(motions):
    """Orthonormal motions (m, r) that span those given (m, n), but for small ones."""
    u, size, _ = np.linalg.svd(motions)
    return u[:, : int((size > PART).sum())]


def _held_at_mean(space, parts, motions):
    """A body's mean displacement along its free rigid motions (n_dof, m), as rows C (m, n_dof), and m pins (m,)."""
    points, weights, owner = space.rule(parts[space.parts.part], degree=2)  # a function times a rigid motion
    B = space.basis_in(points, owner)
    along = B @ motions.reshape(B.shape[1], -1)
    C = (B.T @ (weights[:, None] * along)).reshape(motions.shape) / weights.sum()
    # Far apart, and not where there is hardly any tissue.
    firm = np.sqrt(np.maximum(np.repeat(B.T @ weights, space.mesh.dim), 0))
    _, pivot = qr((motions * firm[:, None]).T, mode="r", pivoting=True)
    return csr_array(C.T), pivot[: motions.shape[1]]


def at_rest(table, parts) -> Constraints:
    """All basis functions of some parts (p,) bool are 0."""
    rows = np.unique(table.dof[parts])
    pick = csr_array((np.ones(len(rows)), (np.arange(len(rows)), rows)), (len(rows), table.n_rows))
    return vector_rows(pick, np.zeros((len(rows), table.n_dof // table.n_rows)), SKULL)


def _place(split, parts):
    """Centre (d,) mm of the largest simplex of some parts: a place inside them."""
    own = np.flatnonzero(parts[split.part])
    return split.corners[own[np.argmax(split.volumes[own])]].mean(axis=0)


def _mm(point):
    return f"({', '.join(f'{x:.1f}' for x in point)}) mm"
