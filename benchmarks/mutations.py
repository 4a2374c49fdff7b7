"""Faults planted one at a time in a copy of the project, and the first test that notices each.

    python -m benchmarks.mutations [word ...] [--page]

Each fault is one that a colleague could make: a sign, an axis, a condition or a key left out, a value that is stale. It
is held against the tests of its own area alone, which must pass without it. With words only those are planted whose
line has one of them; what is found is kept in benchmarks/results, and the page is written from all of it. Exit status 1
if a fault goes unnoticed.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import NamedTuple

from xfemnav.pipeline.keeping.kernels import NAME, made_of
from xfemnav.pipeline.keeping.keys import source_digest

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PAGE = Path("benchmarks/results/mutations.json"), Path("docs/measured/mutations.md")
#: What is copied, and the names by which the folders of two packages are imported.
COPIED, LINKED = ("xfemnav", "tests", "data_synthetic", "cli", "benchmarks", "docs"), {"cli": "xfemnav_cli", "data_synthetic": "xfemnav_examples"}
LIMIT_S = 1800  # a fault for which tests do not end is noticed


class Fault(NamedTuple):
    """What is wrong; the file, below xfemnav/ or cli/; the right text, which stands there once; the wrong one; and the
    names of the files of tests."""

    what: str
    path: str
    right: str
    wrong: str
    tests: tuple[str, ...]


FAULTS = tuple(Fault(what, path, right, wrong, tuple(tests.split())) for what, path, right, wrong, tests in (
    # Points, cuts and parts in the plane
    ("normals of facets that point inwards", "geometry/mesh.py", "np.cross(edges[:, 0], edges[:, 1]) / 2", "np.cross(edges[:, 1], edges[:, 0]) / 2", "mesh loads laws"),
    ("element sizes in space as in the plane", "geometry/mesh.py", "(d + 1))) ** (1 / d)", "(d + 1))) ** (1 / 2)", "mesh"),
    ("a facet of the cut still joined at its end", "geometry/plane/bisection.py", "low, high = max(min(t0, t1), 0.0), min(max(t0, t1), length)", "low, high = max(min(t0, t1), 0.1), min(max(t0, t1), length)", "subcells"),
    ("the other lip's motion on a cut", "geometry/motion.py", "side[lip] > 0, self.rest", "side[lip] < 0, self.rest", "motion"),
    ("a cut's clipped path not turned to start at its mouth", "geometry/plane/cut.py", "line.project(shapely.Point(clipped[0])) > line.project", "line.project(shapely.Point(clipped[0])) < line.project", "cut"),
    ("a branch that starts on a cut has a tip there", "geometry/plane/snapping.py", "not _is_on(rim, x, h) and not any(_is_on(_stretches(other), x, h) for other in others)", "not _is_on(rim, x, h)", "subcells networks"),
    ("holes of a region filled", "geometry/plane/resection.py", "shapely.symmetric_difference(region, ", "shapely.union(region, ", "resection"),
    # Parts in space
    ("a cut goes on past all but one of its bounds", "geometry/solid/levels.py", ".min(axis=2) < 0).all(axis=0)", ".min(axis=2) < 0).any(axis=0)", "split"),
    ("what a closed level takes out is what lies outside", "geometry/solid/split.py", "within[cell], lips[:, k] < 0)", "within[cell], lips[:, k] > 0)", "split"),
    ("facets turned inwards", "geometry/solid/split.py", "facets], axis=1)) < 0", "facets], axis=1)) > 0", "split"),
    ("a contact not cut back to its second part", "geometry/solid/split.py", "if q >= 0:\n                        found, count", "if q < -1:\n                        found, count", "split"),
    ("lips without the chart of their cut", "geometry/solid/split.py", "own[:] = 0 if cut.at is None else cut.at", "own[:] = 0", "split"),
    # Mechanics
    ("a sign in the gradient of F_3", "mechanics/space/branch.py", "cos_half * sin / 2 + sin_half * cos", "cos_half * sin / 2 - sin_half * cos", "branch"),
    ("a dropped Jacobian in the collapsed rule", "mechanics/space/quadrature.py", "return s, t, w * s\n", "return s, t, w / 2\n", "quadrature"),
    ("branch functions without their shift", "mechanics/space/space.py", "branch_functions(r, theta) - table.shift", "branch_functions(r, theta) - 0 * table.shift", "space"),
    ("stress of one of the two shears alone", "mechanics/tissue/elasticity.py", "mu * (H + H.swapaxes(-1, -2))", "mu * (H + H)", "elasticity laws"),
    ("the lips of a cut exchanged", "mechanics/conditions/lips.py", "own = 0 if side == LEFT else 1", "own = 1 if side == LEFT else 0", "lips"),
    ("targets not permuted with their conditions", "mechanics/conditions/constraints.py", "(d[block_rows] / scale)[pivot]", "d[block_rows] / scale", "constraints"),
    ("Nitsche's traction into the tissue", "mechanics/conditions/nitsche.py", "_tractions(space, q, -retraction.side * q.normals", "_tractions(space, q, retraction.side * q.normals", "nitsche lips solution"),
    ("lips kept together, not apart", "mechanics/conditions/contact.py", "np.where(at < m, jump, -jump)", "np.where(at < m, -jump, jump)", "contact"),
    ("a fluid that buoys up what lies above its level", "mechanics/conditions/loads.py", "(points @ down > gravity.fluid_level_mm", "(points @ down < gravity.fluid_level_mm", "loads"),
    ("the two sides of a mouth exchanged in measured points", "mechanics/conditions/measured.py", "mouth - BESIDE_MM * sense * side[wrong]", "mouth + BESIDE_MM * sense * side[wrong]", "measured skull"),
    ("pressure that pulls as tissue is squeezed", "mechanics/tissue/neo_hookean.py", "return mu - lam * log_det, -lam", "return mu + lam * log_det, lam", "neo_hookean"),
    ("what a cut costs, with its edges once", "mechanics/solving/solution.py", "2 * len(problem.mesh.edges)", "len(problem.mesh.edges)", "solution"),
    ("rigid motions held by next to nothing", "mechanics/conditions/bodies.py", "FREE_MOTION = 1e-4", "FREE_MOTION = 1e-12", "bodies"),
    # The live session
    ("modes of blades of another length", "mechanics/live/live_cut.py", "key = sides, blade\n", "key = sides\n", "session condensation"),
    ("the image of the blades before", "pipeline/running/session.py", "_Now(live, self._now.drawn, asked)", "replace(self._now, live=live, asked=asked)", "session"),
    ("world points put into the slice's plane", "imaging/frames/slices.py", "slice.to_world(move(plane)) + distance[:, None] * slice.axes[2]", "slice.to_world(move(plane))", "session"),
    ("a window with the tissue of other cells", "mechanics/live/incision.py", "material = _restricted(organ.material, part.cells)", "material = _restricted(organ.material, np.arange(len(part.cells)))", "condensation"),
    ("a reach that forgets the skull's ramp", "mechanics/live/condensation.py", "return skull.craniotomy_mm + skull.ramp_mm", "return skull.craniotomy_mm", "condensation session"),
    ("lips pulled apart by what moves both to one side", "mechanics/live/lip_modes.py", "apart += blade.side * (self._normals @ along) + away", "apart += (self._normals @ along) + away", "session condensation"),
    # Images and points
    ("the qform of a header that states both frames", "imaging/reading/nifti_frames.py", 'wanted == "qform" or not sform_code)', 'wanted == "qform" or sform_code != 1)', "frames two_frames"),
    ("LPS points turned about one axis only", "imaging/frames/slices.py", 'points * ([-1, -1, 1] if space == "lps" else 1)', 'points * ([-1, 1, 1] if space == "lps" else 1)', "slices conventions"),
    ("distances of rows and of columns exchanged", "imaging/reading/dicom.py", "np.array(spacing[::-1])", "np.array(spacing)", "dicom"),
    ("a slice as thick as its tissue, without the gap to the next", "imaging/reading/dicom.py", '_floats(fields, "SpacingBetweenSlices", 1, name) or _floats', "_floats", "dicom"),
    ("an origin in another unit than its axes", "imaging/reading/nrrd.py", "affine[:3, 3] = origin[0] * _units(fields, name)", "affine[:3, 3] = origin[0]", "formats"),
    ("nearest pixels rounded down", "imaging/carrying/warp.py", "values[int(min(max(x + 0.5, 0.0), n1 - 1.0))", "values[int(min(max(x, 0.0), n1 - 1.0))", "warp"),
    ("a frame grown at the wrong end of a flipped axis", "imaging/frames/slices.py", "(after if self.flipped[k] else before)[k]", "before[k]", "transform"),
    ("vectors turned backwards", "imaging/carrying/companions.py", 'np.einsum("nij,nj->ni", _rotations(part), world[tissue])', 'np.einsum("nji,nj->ni", _rotations(part), world[tissue])', "companions"),
    # Stages, cache and outputs
    ("a key without the versions of libraries", "pipeline/keeping/keys.py", '        "libraries": library_versions(libraries),\n', "", "cache"),
    ("a key without the stage's own code", "pipeline/keeping/keys.py", '        "own code": own_digest(stage),\n', "", "cache"),
    ("an entry that is used as old as it was", "pipeline/keeping/cache.py", "                        os.utime(entry.folder)\n", "                        pass\n", "cache"),
    ("a key without the deformed slice that a cut was drawn in", "pipeline/stages/chain.py", '        read |= {f"after {k}": done[label].entry.content(*VALUE) for label, k in self._drawn_in(stage.name).items()}\n', "", "steps chain"),
    ("slivers between lips that touch counted as overlap", "pipeline/stages/stage_warp.py", "shapely.distance(centres, lips) > SLIVER_MM", "shapely.distance(centres, lips) > 0", "lying_twice"),
    ("files renamed before they are on the disk", "pipeline/keeping/disk.py", "                sync(temporary)\n", "                pass\n", "disk"),
    ("somebody's link removed as a file left half-written", "pipeline/keeping/disk.py", "left.is_file() and not left.is_symlink()", "left.is_file()", "disk"),
    ("a sparse matrix that comes back in another form", "pipeline/keeping/store.py", '.asformat(tree["sparse"])', "", "store"),
    ("a check that is no number passes", "pipeline/telling/verdicts.py", "not value <= within.untrusted.value", "value > within.untrusted.value", "verdicts"),
    ("the two lips of a landmark labelled the wrong way round", "pipeline/stages/stage_carry.py", '((0, "left"), (1, "right"))', '((1, "left"), (0, "right"))', "apply"),
    # The command line
    ("every error exits as one of data", "cli/main.py", "code = error.exit_code or EXIT_DATA", "code = EXIT_DATA", "cli mistakes"),
    ("an interrupted run exits as a failed one", "cli/run.py", "return 128 + error.signum", "return 1", "signals"),
    ("a batch row from the record of an earlier run", "cli/batch.py", 'return record if record.get("exit_code") == exit_code else {}', "return record", "batch"),
    ("a table that trusts all that has come", "pipeline/running/batch_table.py", 'found["trusted"] = found["status"] == "complete"', 'found["trusted"] = True', "batch"),
    ("a batch that succeeds with slices that are not trusted", "cli/batch.py", 'return EXIT_OK if counts["updated"] == len(items)', 'return EXIT_OK if not counts["failed"]', "batch"),
    ("a run that is not trusted is applied with status 0", "cli/tools.py", "FLAGS)}\")\n        return EXIT_UNTRUSTED", "FLAGS)}\")\n        return 0", "apply"),
))


def source(fault: Fault, root: Path = ROOT) -> Path:
    """The file that a fault is planted in."""
    return root / ("" if fault.path.startswith("cli/") else "xfemnav") / fault.path


@contextmanager
def planted(fault: Fault, folder: Path):
    """The copy of the project in `folder` with the fault in it, and kernels of the right code that it leaves as they are.

    What tells numba that a kernel is still good, its file's time, is put back with the text.
    """
    path, text = source(fault, folder), source(fault, folder).read_text()
    if text.count(fault.right) != 1:
        raise SystemExit(f"{fault.path} holds {fault.right!r} {text.count(fault.right)} times; mend the list of faults")
    before, kernels = path.stat(), kernel_folder(folder)
    path.write_text(text.replace(fault.right, fault.wrong))
    own = kernel_folder(folder)
    if "njit" not in text and own != kernels and kernels.exists():  # else others may hold a kernel of this file
        shutil.copytree(kernels, own)
    try:
        yield
    finally:
        path.write_text(text)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        if own != kernels:
            shutil.rmtree(own, ignore_errors=True)


def kernel_folder(folder: Path) -> Path:
    """Where the project in `folder` keeps its kernels."""
    package = folder / "xfemnav"
    return package / "__pycache__" / (NAME + source_digest(*made_of(package), root=package)[:16])


def failing(folder: Path, tests: tuple[str, ...]) -> str:
    """Name of the first test that fails, "" if none does."""
    files = [f"tests/test_{name}.py" for name in tests]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", *files]
    given = {"PYTHONPATH": str(folder), "XFEMNAV_CACHE": str(folder / "cache"), "OPENBLAS_NUM_THREADS": "1"}
    home = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=home | given, timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        return "no test ends"
    if done.returncode == 0:
        return ""
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if not failed:
        raise SystemExit(f"the tests {' '.join(tests)} cannot be run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return failed[0].split(" - ")[0].split(" ", 1)[1]


def copy_project(folder: Path) -> None:
    """Copy the project into `folder`, so that all of its packages are imported from there."""
    for name in COPIED:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name, package in LINKED.items():
        (folder / package).symlink_to(name)
    for name in ("pyproject.toml", "README.md", "Makefile", "CHANGELOG.md"):
        shutil.copy(ROOT / name, folder)


def write_page(kept: dict) -> None:
    """docs/measured/mutations.md from what is kept."""
    rows = [f"| {fault.what} | `{fault.path}` | {_told(kept.get(fault.what))} |" for fault in FAULTS]
    noticed = sum(bool(kept.get(fault.what)) for fault in FAULTS)
    PAGE.write_text(f"""# Planted faults

Written by `python -m benchmarks.mutations` (`make mutations`). Each fault is planted by itself in a copy of the project
and held against the tests of its own area alone, which pass without it; the first test that fails is named. The list,
with the text that each fault changes, is `FAULTS` in that file.

{noticed} of {len(FAULTS)} faults are noticed.

| fault | file | the first test that fails |
|--|--|--|
""" + "\n".join(rows) + "\n")


def _told(test: str | None) -> str:
    return "not planted yet" if test is None else f"`{test}`" if test else "**none**"


def main(arguments: list[str]) -> int:
    """Plant the faults, one line each, keep what is found and write the page."""
    words = [word for word in arguments if word != "--page"]
    chosen = [fault for fault in FAULTS if not words or any(word in " ".join(map(str, fault)) for word in words)]
    chosen = [] if arguments == ["--page"] else chosen
    if words and not chosen:
        raise SystemExit(f"no fault has any of {', '.join(words)} in its line")
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    with tempfile.TemporaryDirectory() as place:
        if chosen:
            copy_project(folder := Path(place).resolve() / "xfemnav")
            if test := failing(folder, tuple(dict.fromkeys(name for fault in chosen for name in fault.tests))):
                raise SystemExit(f"{test} fails without a fault")
        for fault in chosen:
            begun = monotonic()
            with planted(fault, folder):
                kept[fault.what] = failing(folder, fault.tests)
            print(f"{fault.what:60s} {monotonic() - begun:4.0f} s  {kept[fault.what] or 'UNNOTICED'}", flush=True)
            known = {each.what: kept[each.what] for each in FAULTS if each.what in kept}
            RESULTS.write_text(json.dumps(known, indent=0) + "\n")
    write_page(kept)
    found = [kept[fault.what] for fault in chosen]
    if found:
        print(f"{sum(map(bool, found))} of {len(found)} faults noticed")
    return int(not all(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
