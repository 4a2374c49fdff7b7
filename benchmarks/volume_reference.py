"""Displacements of cut balls beside a conforming reference, and the plane as a limit.

    python -m benchmarks.volume_reference

A ball of 36 mm with a cut 22 mm deep and 32 mm long, flat or a part of a cylinder of 20 mm; half of its length is held
down to 12 mm, its left lip moved by 3.1 mm, its right one by 2; the surface is fixed beyond 24 mm from the top, at once
or over a ramp of 4 mm. The reference is `benchmarks/reference/solid.py`: gmsh with the cut embedded, the blades' edges
and the switch lines of the mesh, nodes split by the connected parts of their fan of tetrahedra, quadratic elements of
scikit-fem. xfemnav imports nothing of it. Its own error, which is a part of what is measured, is told by a coarser one
(*reference*, the distance of the two).
xfemnav's meshes are graded to the cut as a run's are: 5 mm far from it. Errors are at 50,000 points spread evenly
over the tissue that is farther than 3 mm from the cut, and, but for *cut alone*, from the edges of the blades and the
switch. Lip errors are those of Nitsche's condition. Rates are powers of the corridor's element.

The plane: a cylinder of 35 mm and 210 mm length, cut along all of it, in a skull that slides (with its ramp), beside
its section in plane strain with elements of .25 mm, at 20,000 points of the middle 6 mm that are farther than 8 mm from
switch, blade's end, and, but for *tip too*, tip.
"""

from benchmarks.timing import keep, mark, table  # isort: skip (sets the number of threads)

import numpy as np

from benchmarks.reference.solid import Case
from benchmarks.verification import opened_ball, slab

CASES = (Case("flat"), Case("curved", bend_mm=20.0), Case("flat, ramp", ramp_mm=4.0))
FINE = (2.5, 1.75, 1.25)
#: Reference meshes: largest edge, edge at the singular lines, growth; the coarser tells of the finer one's error.
GRADED, COARSER = (4.0, 1.0, 0.3), (5.0, 1.6, 0.4)
BEYOND = 3.0
#: Cylinder: element at the cut, elsewhere, and how far from the middle it is as fine.
CYLINDERS = ((4.0, 4.0, 200.0), (2.5, 5.0, 20.0), (1.25, 2.5, 12.0))


def of_case(case: Case) -> tuple[list, list[dict]]:
    """Rows of a case, coarse to fine, and its marks."""
    (field, n_dof), (other, _) = (opened_ball.reference(case, *sizes) for sizes in (GRADED, COARSER))
    rows, before = [], ()
    for fine in FINE:
        problem, found = opened_ball.solved(case, fine)
        near = opened_ball.compare(case, found, field)
        far = np.minimum(near.from_cut, near.from_data) > BEYOND
        some = near.points[far][:10_000]
        between = np.linalg.norm(field(some) - other(some), axis=1)
        worst, rms = near.beyond(BEYOND)
        rates = [f"{np.log(b / a) / np.log(before[0] / fine):.2f}" for a, b in zip((worst, rms), before[1:])]
        rows.append((case.name, fine, len(problem.mesh.points), worst, rms, *(rates or ["", ""]),
                     near.beyond(BEYOND, cut_alone=True)[0], found.lip_error_rms_mm, found.lip_error_max_mm,
                     float(np.sqrt((between**2).mean())), n_dof))
        before = fine, worst, rms
    return rows, [mark(f"reference, {case.name}: max beyond 3 mm, mm, corridor 1.25 mm", 0.1, worst),
                  mark(f"reference, {case.name}: rms beyond 3 mm, mm, corridor 1.25 mm", 0.01, rms)]


def of_plane() -> tuple[list, list[dict]]:
    """Rows of the cylinder, coarse to fine, and its marks."""
    plane, rows = slab.section(0.25), []
    for fine, coarse, about in CYLINDERS:
        found = slab.beside(slab.extruded(slab.cylinder(fine, coarse, about)), plane)
        rows.append((fine, coarse, found.nodes, found.worst, found.rms, found.with_tip, found.out))
    return rows, [mark("plane as a limit: max beyond 8 mm, mm", 0.05, found.worst),
                  mark("plane as a limit: max beyond 8 mm, mm, near the tip too", 0.05, found.with_tip),
                  mark("plane as a limit: rms beyond 8 mm, mm", 0.01, found.rms)]


def main() -> None:
    """Both tables, kept as they grow."""
    flat, marks = of_plane()
    plane = table(("element at the cut mm", "elsewhere", "nodes", "max mm", "rms mm", "max, tip too",
                   "out of the plane mm"), flat)
    rows = []
    for case in CASES:
        more, of = of_case(case)
        rows, marks = rows + more, marks + of
        text = table(("case", "corridor mm", "nodes", "max mm", "rms mm", "rate", "rate", "max, cut alone",
                      "lip rms mm", "lip max mm", "reference, rms mm", "its unknowns"), rows)
        keep("volume_reference", text + "\n" + plane, marks)


if __name__ == "__main__":
    main()
