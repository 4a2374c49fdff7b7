"""All measurements of speed, one after another, and the page docs/measured/performance.md.

    python -m benchmarks.performance [name ...] [--page]

Names: mesh assembly solve accuracy_time warp live runs batch; all without a name. Each runs in a process of its own, so
that none warms another's memory; results are kept in benchmarks/results, and the page is written from all of them.
"""

import ast
import json
import subprocess
import sys
from pathlib import Path

from benchmarks.timing import RESULTS, table

PAGE = Path("docs/measured/performance.md")
TITLES = {
    "mesh": "Meshes",
    "assembly": "Assembly",
    "solve": "Solving, and what enrichment costs",
    "accuracy_time": "Accuracy against seconds for a changed cut",
    "warp": "Warping",
    "live": "A live session",
    "runs": "Whole runs",
    "batch": "A batch",
}
IMPORTS = ("most of what is beyond are imports of libraries (numba, scipy, nibabel, pydantic, SimpleITK, meshio), "
           "which are better than anything of our own that would load faster")
#: Why a mark is missed, by the beginning of its name.
REASONS = {
    "assembly: time over numpy's": "numpy's own way takes less an element than the mark reckoned with",
    "assembly: time over scikit-fem's": "scikit-fem takes less an element than the mark reckoned with",
    "solve: time over splu's default": "an order by minimum degree",
    "solve: with CHOLMOD": "its order and the check for rigid motions weigh more in small systems",
    "solve: growth": "an order by minimum degree fills ever more; CHOLMOD keeps the mark by its dense blocks",
    "warp: map and one image over SimpleITK's": "most of it is the map, which SimpleITK is given",
    "run: a mask given, no report, cold": IMPORTS,
    "run: segmentation": IMPORTS,
    "live: a moved cut": "dense algebra, the backsolve to the whole organ, and conditions of lips, contact and skull; "
    "the mark was set on cuts without tip functions, contact and mean conditions",
    "live: a moved blade over": "the forces, and whether lips touch, are worked out too",
    "reference, flat, ramp: ": "the largest lies in elements of 5 mm in the surface, where the ramp of 4 mm begins; "
    "smaller ones there take a part of it",
    "reference, ": "the largest lies 3 mm beside the cut's front, where that meets the surface; likely because, "
    "without functions of its own, a cut is up to an element short",
    "plane as a limit: max beyond 8 mm, mm, near the tip too": "it lies within two elements of the tip; the cut is "
    "short by up to an element, as in the plane without tip functions",
    "plane as a limit: rms": "of the tissue far from the cut, in elements of 2.5 mm",
    "embedding at 100k nodes": "most of it is spent on faces that no cut meets",
    "setup and solution at 100k": "to a residual of 1e-10",
    "iterations, any sliver": "to a residual of 1e-10; slivers do not add to it",
    "run: from a mask": "what a run reports of its solution is worked out too",
}
PREFACE = """# Performance

Written by `python -m benchmarks.performance` (about half an hour). One thread. Seconds are those that the process had a
processor for (`process_time`; user and system time of a child), because a clock on the wall measures the neighbours on
a shared machine. What is compared ran in turns in one process, and medians are given: trust the ratios before the
seconds. Peers that are not installed are left out.

"""


def judged(marks) -> str:
    """The table of marks."""
    rows = []
    for each in marks:
        name, limit, measured = each["name"], each["limit"], each["measured"]
        verdict = "met"
        if measured > limit:
            reason = next((text for start, text in REASONS.items() if name.startswith(start)), "")
            verdict = f"**missed** by {measured / limit - 1:.0%}" + (f": {reason}" if reason else "")
        rows.append((name, limit, measured, verdict))
    return table(("mark", "at most", "measured", ""), rows)


def write_page(page, preface, titles) -> None:
    """A page of docs/measured from what is kept of the benchmarks with `titles`."""
    found = {name: json.loads((RESULTS / f"{name}.json").read_text())
             for name in titles if (RESULTS / f"{name}.json").exists()}
    machines = dict.fromkeys(part["machine"] for part in found.values())
    marks = [mark for part in found.values() for mark in part["marks"]]
    text = preface + "\n".join(machines) + "\n\n## The marks\n\n" + judged(marks)
    for name, part in found.items():
        text += f"\n## {titles[name]}\n\n{_about(name)}\n\n"
        if name == "accuracy_time":
            text += "![Error against seconds](../figures/accuracy-time.png)\n\n"
        text += part["text"]
    page.write_text(text)


def _about(name) -> str:
    """What a benchmark says of itself: its first lines, without the command."""
    words = ast.get_docstring(ast.parse(Path(f"benchmarks/{name}.py").read_text())).split("\n\n")
    return "\n\n".join(part for part in words if not part.startswith("    "))


def main(arguments, page=PAGE, preface=PREFACE, titles=TITLES) -> None:
    """Run the benchmarks named, and write the page."""
    chosen = [name for name in arguments if name != "--page"] or ([] if "--page" in arguments else list(titles))
    for name in chosen:
        print(f"== {name}", flush=True)
        subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], check=True)
    write_page(page, preface, titles)


if __name__ == "__main__":
    main(sys.argv[1:])
