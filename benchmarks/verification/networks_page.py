"""docs/measured/networks.md, from the kept results."""

from pathlib import Path

from benchmarks.reference.networks import NETWORKS, RESECTIONS
from benchmarks.verification.page import number, table

PAGE = Path("docs/measured/networks.md")
LARGEST, RMS = "max beyond 2 h, mm", "rms beyond 2 h, mm"
ELSEWHERE = "max beyond 2 h and 6 mm of the switches, mm"
ENERGY = "strain energy, Pa mm2"
# Why a mark is not met, printed where it is not.
FREE_TIP = "in some meshes, beside a free tip"

TEXT = """# Networks of cuts

Written by `python -m benchmarks.networks` (about seven minutes on one core; `--page` alone writes the page again from
`benchmarks/results/networks.json`). Branches, crossings, T-cuts and resections, beside the conforming reference of
[accuracy.md](accuracy.md): gmsh with the cuts embedded and a resection left out, nodes split, quadratic elements.

The disc is that of problem p there: radius 70 mm, cut from (0, 70) to (0, 30), its lips held from the mouth to half of
its length at ±(3.5, -1) mm, E = 3 kPa, nu = .45, plane strain. Every other lip, and the rim of a resection, is free
(`lips="free"`): nothing stops lips from passing through each other, here as in the reference. The skull is fixed beyond
15 mm of the held cut's mouth (ramp 0). Only that mouth opens it: a further cut from the outline has `craniotomy=False`,
and a resection opens nothing, so that both programs solve the same problem.

## The marks

Largest error of the displacement farther than two elements from any cut and rim, at one random point of every cell and
at all nodes. On uniform meshes with topological tip enrichment.

{marks}
Turned under the cuts by {turns} multiples of 18 degrees, the uniform mesh has its nodes elsewhere about the cuts, the
blade's end and the skull's switch. {turned}

## The references

*Change*: largest change of displacement from the next coarser refinement, more than .5 mm from cuts and rims. *Effect*:
largest difference to the disc with the held cut alone, more than 2 mm from them: the error of a program that lost the
further cuts or the resection.

{references}
## All meshes

{rows}
## f2: a forked crack

Plate of half-width 40 under unit tension, three cuts that meet in a point at 45 degrees, 8,000 nodes graded to the
crack. The mark is .5 % for every stress intensity with geometric enrichment.

{fork}
## Cuts right through

`tests/test_through_cuts.py` cuts a disc right through one to five times: straight, bent, through nodes, along edges,
and mixed. The number of pieces is exact, their areas are those of the polygons between the cuts to 1e-12, and every
piece moves rigidly on its own: displacement and jump to 1e-12 of the motion, energy within 1e-13 E d².
"""


def write_page(results: dict):
    """Write the page."""
    found = {name: results[name] for name in (NETWORKS | RESECTIONS) if name in results}
    text = TEXT.format(
        marks=_marks(results, found),
        turns=max((len(_select(case, "uniform, turned")) for case in found.values()), default=0),
        turned=_turned(found),
        references=_references(found),
        rows=_rows(found),
        fork=_fork(results.get("f2", {"rows": []})["rows"]),
    )
    PAGE.write_text(text)


def _select(case, kind, enrichment="topological"):
    return [row for row in case["rows"] if row["mesh"] == kind and row["enrichment"] == enrichment]


def _marks(results, found):
    lines = []
    if "f2" in results:
        lines.append(_line("f2: every K, geometric, relative", 8_000, 5e-3, max(
            row["error"] for row in results["f2"]["rows"] if row["enrichment"] == "geometric")))
    for name, case in found.items():
        title = (NETWORKS | RESECTIONS)[name].title
        row = _select(case, "uniform")[1]
        lines.append(_line(f"{title}: uniform", row["nodes"], 0.17, row[LARGEST]))
        for enrichment in ("topological", "geometric"):
            near = _select(case, "graded, neighbours", enrichment)
            rows = [row for row in _select(case, "graded", enrichment) if 7_000 < row["nodes"] < 9_000] + near
            sizes = f"{min(r['nodes'] for r in rows)} to {max(r['nodes'] for r in rows)}"
            text = f"{title}: graded, {enrichment}, worst of {len(rows)} meshes"
            lines.append(_line(text, sizes, 0.03, max(r[LARGEST] for r in rows), FREE_TIP))
    return table(("mark", "nodes", "limit", "measured", ""), lines)


def _line(text, nodes, limit, measured, reason=""):
    verdict = "met" if measured <= limit else f"**not met**: {reason}" if reason else "**not met**"
    return text, nodes, f"≤ {number(limit)}", number(measured), verdict


def _turned(found):
    rows = [row for case in found.values() for row in _select(case, "uniform, turned")]
    if not rows:
        return ""
    return (
        f"The largest error of all cases and turns is then {number(max(r[LARGEST] for r in rows))} mm, in the elements "
        f"at the switch, where the field is singular (the default, a ramp, is not); beyond 6 mm of the switches it is "
        f"{number(max(r[ELSEWHERE] for r in rows))} mm."
    )


def _references(found):
    lines = [
        (name, case["reference"]["n_dof"], f"{case['reference']['energy']:.1f}",
         number(case["reference"]["change"]), number(case["reference"]["effect"]))
        for name, case in found.items()
    ]
    return table(("case", "unknowns", "energy, Pa mm2", "change, mm", "effect, mm"), lines)


def _rows(found):
    lines = []
    for name, case in found.items():
        for row in case["rows"]:
            if row["mesh"] in ("uniform", "graded"):
                errors = (number(row[key]) for key in (LARGEST, ELSEWHERE, RMS, ENERGY))
                lines.append((name, row["mesh"], row["enrichment"], row["nodes"], *errors))
    return table(("case", "mesh", "tip enrichment", "nodes", LARGEST, ELSEWHERE, RMS, "energy, relative"), lines)


def _fork(rows):
    lines = [
        (row["enrichment"], row["quantity"], f"{row['value']:.4f}", f"{row['reference']:.4f}", number(row["error"]))
        for row in rows
    ]
    return table(("tip enrichment", "quantity", "value", "reference", "error"), lines)
