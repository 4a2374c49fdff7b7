"""Any network of cuts, and resections, beside the conforming reference, and the page docs/measured/networks.md.

    python -m benchmarks.networks [case ...] [--page]

Cases: those of benchmarks/reference/networks.py, and f2; all without a name (about seven minutes on one core). Results
are kept in benchmarks/results/networks.json, one entry a case; the page is written from all of them, with --page alone
from what is there. The conforming references are computed once, into out/reference.
"""

import json
import sys
from pathlib import Path

from benchmarks.lips import turned
from benchmarks.verification import cases
from benchmarks.verification.networks import CASES, about_reference, graded, opened
from benchmarks.verification.networks_page import write_page
from benchmarks.verification.retraction import uniform

RESULTS = Path("benchmarks/results/networks.json")
UNIFORM, GRADED = (2_600, 8_800, 35_000), (2_000, 8_000, 30_000)
#: Further graded meshes about the size of the mark, and turns of the uniform mesh under the cuts, degrees.
NEIGHBOURS, TURNS = (7_800, 7_900, 8_100, 8_200), tuple(range(18, 91, 18))


def meshes(name: str):
    """Meshes of a case and the tip enrichments to use on each: kind, mesh, enrichment."""
    both = ("topological", "geometric")
    for n in UNIFORM:
        mesh = uniform(n)
        yield from (("uniform", mesh, e) for e in (both if n == UNIFORM[1] else both[:1]))
    for n in GRADED:
        mesh = graded(CASES[name], n)
        yield from (("graded", mesh, e) for e in (both if n == GRADED[1] else both[:1]))
    for n in NEIGHBOURS:
        mesh = graded(CASES[name], n)
        yield from (("graded, neighbours", mesh, e) for e in both)
    for angle in TURNS:
        yield "uniform, turned", turned(uniform(UNIFORM[1]), angle), "topological"


def errors(name: str) -> dict:
    """All rows of a case."""
    rows = []
    for kind, mesh, enrichment in meshes(name):
        values = {value.name: value.error for value in opened(name, mesh, enrichment).values}
        rows.append({"mesh": kind, "nodes": len(mesh.points), "enrichment": enrichment, **values})
    return {"reference": about_reference(name), "rows": rows}


def fork() -> dict:
    """Problem f2, 8,000 nodes."""
    rows = []
    for enrichment in ("geometric", "topological"):
        for value in cases.branched(8_000, enrichment).values:
            rows.append({"enrichment": enrichment, "quantity": value.name, "value": value.value,
                         "reference": value.reference, "error": value.error})
    return {"rows": rows}


def main(arguments):
    """Run the cases named, keep their rows, write the page."""
    chosen = [name for name in arguments if name != "--page"] or ([] if "--page" in arguments else ["f2", *CASES])
    for name in chosen:
        found = fork() if name == "f2" else errors(name)
        for row in found["rows"]:
            print(name, *(f"{x:.4g}" if isinstance(x, float) else x for x in row.values()), flush=True)
        kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps({**kept, name: found}, indent=0, sort_keys=True) + "\n")
    write_page(json.loads(RESULTS.read_text()))


if __name__ == "__main__":
    main(sys.argv[1:])
