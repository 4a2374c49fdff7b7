"""Every option changes what it says: a run with it is compared with one without, or with another value of it.

Each table has a row an option, (words of both runs, words of the first, words of the second, what must be true of the
two runs); an option without a row fails.
"""

import json
import os
import re
import shutil
import threading

import click
import nibabel as nib
import numpy as np
import pytest
from small import CUT

from tests.option_files import files, run
from tests.test_house import ROOT
from xfemnav.pipeline.asking.settings import TABLE
from xfemnav_cli import batch, main, tools
from xfemnav_cli.run import run as run_command
from xfemnav_cli.run import stage_commands

LIP, OPEN = ("--cut", CUT), ("--cut", CUT, "--opening-mm", "4")
COARSE = ("--element-size-mm", "8", "--corridor-element-mm", "4")
QUICK = (*COARSE, "--no-report")
HEAD = ("run", "head.nii.gz", *QUICK)
SOLVED, ORGAN = (*HEAD, *OPEN), ("segment", "head.nii.gz")
MOVED, WEIGHT = (*HEAD, *LIP), (*HEAD, *LIP, "--gravity", "0,-1")
REACH = "max_displacement_mm"
THROUGH = (*HEAD, "--cut", "-60,35 60,35", "--craniotomy-mm", "80", "--right", "0,2")


def differ(role="updated"):
    """An output that is another."""
    return lambda a, b: a.digest(role) != b.digest(role)


def grows(name, least=1.05, most=np.inf):
    """A check of the second run that is this many times that of the first."""
    return lambda a, b: least <= b.check(name) / a.check(name) <= most


def appears(role):
    """An output that only the second run has, and it is there."""
    return lambda a, b: (role not in a.record["outputs"] and role in b.record["outputs"]
                         and (b.folder / b.record["outputs"][role]).stat().st_size > 0)


def mends(code):
    """What the first run is refused for, the second is not."""
    return lambda a, b: code in a.err and a.code not in (0, 3) and b.code == 0


def statuses(found) -> list[str]:
    """How each stage came."""
    return [stage["status"] for stage in found.record["stages"]]


def told(*texts):
    """A text that each run prints, and the other does not."""
    return lambda a, b: all(text in it.out and text not in other.out for text, it, other in zip(texts, (a, b), (b, a)))


def nodes(first, second):
    """How many nodes the mesh has, in order."""
    return first.record["mesh"]["n_nodes"] < second.record["mesh"]["n_nodes"]


def energy(found):
    """Of the deformed tissue."""
    return found.record["energy_uJ_per_mm"]


def zooms(found):
    """Pixel sizes of the organ's mask."""
    return tuple(found.image("mask").header.get_zooms()[:2])


def threads(first, second):
    """As many threads as are said, and not before."""
    return os.environ.get("OPENBLAS_NUM_THREADS") == "2" and first.code == second.code == 0


RUN = {
    "scenario": (("run", "-o", "OUT"), (), ("--scenario", "plain.toml"), mends("E780")),
    "output": (SOLVED, (), ("-o", "elsewhere"), lambda a, b: not (b.folder / "run.json").exists()
               and (b.folder.parent / "elsewhere" / "run.json").exists()),
    "cache": (SOLVED, (), ("-w", "cache-of-its-own"), lambda a, b: (b.folder.parent / "cache-of-its-own").is_dir()),
    "dry_run": (SOLVED, (), ("--dry-run",), lambda a, b: not b.record and a.record and "warp" in b.out),
    "force": (SOLVED, (), ("--force",), lambda a, b: statuses(b) == ["ran"] * 5),
    "force_from": (SOLVED, (), ("--force-from", "solve"), lambda a, b: statuses(b) == 3 * ["cached"] + 2 * ["ran"]),
    "as_json": (SOLVED, (), ("--json",), lambda a, b: json.loads(b.out) == b.record and a.out[0] != "{"),
    "quiet": (SOLVED, (), ("-q",), lambda a, b: a.out and b.out == b.err == ""),
    "verbose": (SOLVED, (), ("-v",), lambda a, b: len(b.out) - len(a.out) == 5 * 52),
    "threads": (SOLVED, (), ("--threads", "2"), threads),
    "stop_after": (SOLVED, (), ("--stop-after", "mesh"), lambda a, b: set(b.record["outputs"]) == {
        "scenario", "mask", "mesh"} < set(a.record["outputs"])),
    "no_report": (("run", "head.nii.gz", *COARSE, *OPEN), ("--no-report",), (), appears("report")),

    "plane": (("segment", "volume.nii.gz", "--slice", "10"), (), ("--plane", "coronal"),
              lambda a, b: a.values("mask").shape != b.values("mask").shape),
    "slice": (("run", "volume.nii.gz", *QUICK, *OPEN), ("--slice", "5"), ("--slice", "15"),
              lambda a, b: b.values().mean() == pytest.approx(a.values().mean() * 0.7 / 0.9, rel=0.01)),
    "slice_mm": (("run", "volume.nii.gz", *QUICK, *OPEN), ("--slice", "15"), ("--slice-mm", "40"),
                 lambda a, b: a.digest() == b.digest()),
    "space": (HEAD, ("--cut", CUT, "--opening-mm", "4"), ("--cut", CUT, "--opening-mm", "4", "--space", "lps"),
              lambda a, b: "patient's left," in a.out and "patient's right," in b.out),
    "volume": (("run", "several.nii.gz", *QUICK, *OPEN), ("--volume", "0"), ("--volume", "1"),
               lambda a, b: np.allclose(b.values(), a.values() / 2, atol=1e-3)),
    "nan": (("run", "holed.nii.gz", *QUICK, *OPEN), (), ("--nan", "600"), mends("E103")),
    "spacing": (ORGAN, (), ("--spacing", "3,1"), lambda a, b: zooms(a) == (2, 2) and zooms(b) == (3, 1)),
    "nifti_frame": (("run", "framed.nii.gz", *QUICK, *OPEN), (), ("--nifti-frame", "qform"),
                    lambda a, b: [it.record["input"]["affine"][0][3] for it in (a, b)] == [-63, -61]),
    "max_memory": (ORGAN, ("--max-memory", "1e-6"), (), mends("E102")),
    "allow_outside": (("run", "--scenario", "inner/case.toml", *QUICK), (), ("--allow-outside",), mends("E781")),

    "mask": (ORGAN, (), ("--mask", "mask.nii.gz"), lambda a, b: a.values("mask").sum() > b.values("mask").sum() > 0),
    "resample_mask": ((*ORGAN, "--mask", "shifted.nii.gz"), (), ("--resample-mask",), mends("E204")),
    "segment_method": (ORGAN, (), ("--segment-method", "otsu"), told("by stripped", "by otsu")),
    "skull_on": (ORGAN, (), ("--skull-on", "on"), told("by stripped", "by vote")),
    "template": ((*ORGAN, "--segment-method", "svc", "--template-mask", "mask.nii.gz"), (),
                 ("--template", "head.nii.gz"), mends("E206")),
    "template_mask": ((*ORGAN, "--segment-method", "svc", "--template", "head.nii.gz"), (),
                      ("--template-mask", "mask.nii.gz"), mends("E206")),

    "cut": ((*HEAD, "--opening-mm", "4"), ("--cut", CUT), ("--cut", "-60,10 0,5"),
            lambda a, b: a.record["cuts"][0]["length_mm"] < b.record["cuts"][0]["length_mm"] and differ()(a, b)),
    "markup": ((*HEAD, "--opening-mm", "4", "--cut", "cuts.mrk.json"), (), ("--markup", "G"), mends("E309")),
    "internal": ((*HEAD, "--cut", "-25,0 25,0", "--opening-mm", "4"), (), ("--internal",), mends("E302")),
    "left": (MOVED, ("--right", "2"), ("--right", "2", "--left", "3"), grows(REACH)),
    "right": (MOVED, ("--left", "2"), ("--left", "2", "--right", "0.5,-3"), grows(REACH)),
    "lip_force": (MOVED, ("--lip-force", "left=4,8"), ("--lip-force", "left=2,4"), grows(REACH, .4, .7)),
    "opening_mm": (MOVED, ("--opening-mm", "4"), ("--opening-mm", "8"), grows(REACH, 1.8, 2.2)),
    "blade": (SOLVED, (), ("--blade", "0,0.3"), lambda a, b: energy(b) < energy(a)),
    # Of volumes: the small head is a slice, and says so (whole volumes: test_solid_run.py).
    "dim": (SOLVED, (), ("--dim", "3"), lambda a, b: a.code == 0 and "E780" in b.err),
    "towards": (SOLVED, (), ("--towards", "0,0,0"), lambda a, b: a.code == 0 and "E780" in b.err),
    "depth_mm": (SOLVED, (), ("--depth-mm", "20"), lambda a, b: a.code == 0 and "E780" in b.err),
    "blade_along": (SOLVED, (), ("--blade-along", "0,0.5"), lambda a, b: a.code == 0 and "E780" in b.err),
    "transform_spacing_mm": (SOLVED, (), ("--transform-spacing-mm", "4"), lambda a, b: a.code == 0 and "E780" in b.err),
    "lips": ((*MOVED, "--left=1,-4"), (), ("--lips", "free"),
             lambda a, b: a.check("overlap_mm2") == 0 and b.check("overlap_mm2") > 50),
    "resect": (SOLVED, (), ("--resect", "-25,0 -5,0 -5,15"), grows("cavity_mm2", 1.5)),
    "min_resection_mm": ((*SOLVED, "--labels", "labels.nii.gz", "--resect", "label=7"),
                         ("--min-resection-mm", "13"), (),
                         lambda a, b: b.check("cavity_mm2") > a.check("cavity_mm2") + 40),
    "labels": ((*SOLVED, "--resect", "label=4"), (), ("--labels", "labels.nii.gz"), mends("E780")),
    "loose_pieces": (THROUGH, (), ("--loose-pieces", "hold"), mends("E306")),

    "mesh": (SOLVED, (), ("--mesh", "own.vtu"), nodes),
    "element_size_mm": ((*MOVED, "--opening-mm", "4"), (), ("--element-size-mm", "7"), nodes),
    "corridor_mm": (SOLVED, ("--corridor-mm", "0"), (), nodes),
    "corridor_element_mm": (SOLVED, (), ("--corridor-element-mm", "3"), nodes),
    "grade_at_data_ends": (SOLVED, (), ("--grade-at-data-ends",), nodes),

    "young_kpa": (SOLVED, (), ("--young-kpa", "6"), lambda a, b: energy(b) == pytest.approx(2 * energy(a))),
    "poisson": (SOLVED, (), ("--poisson", "0.3"), differ()),
    "skull": (SOLVED, (), ("--skull", "sliding"), lambda a, b: energy(b) < energy(a)),
    "skull_gap_mm": ((*WEIGHT, "--skull", "contact"), (), ("--skull-gap-mm", "1"), grows(REACH)),
    "craniotomy_mm": (WEIGHT, (), ("--craniotomy-mm", "35"), grows(REACH)),
    "skull_ramp_mm": (WEIGHT, (), ("--skull-ramp-mm", "20"), grows(REACH)),
    "boundary_displacement": (MOVED, (), ("--boundary-displacement", "measured.csv"),
                              lambda a, b: a.check(REACH) < 1e-6 < 0.9 < b.check(REACH)),
    "gravity": (WEIGHT, (), ("--gravity", "0,-0.5"), grows(REACH, 0.4, 0.6)),

    "stress_state": (SOLVED, (), ("--stress-state", "stress"), differ()),
    "tip_enrichment": (SOLVED, (), ("--tip-enrichment", "none"), lambda a, b: a.record["enrichment"]["tip_nodes"] > 0
                       == b.record["enrichment"]["tip_nodes"]),
    "lip_constraint": (SOLVED, (), ("--lip-constraint", "pointwise"), differ("solution")),
    "hold_tip": ((*SOLVED, "--lip-constraint", "pointwise"), (), ("--hold-tip",), differ("solution")),
    "model": (SOLVED, (), ("--model", "neo-hookean"), lambda a, b: b.record["model"]["newton_iterations"] > 1
              and differ("solution")(a, b)),

    "interp": (SOLVED, (), ("--interp", "nearest"), lambda a, b: set(np.unique(b.values())) <= set(np.unique(
        nib.load(a.folder.parent / "head.nii.gz").get_fdata())) and differ()(a, b)),
    "outside": (("run", "dusty.nii.gz", "--mask", "mask.nii.gz", *QUICK, *OPEN), (), ("--outside", "zero"),
                lambda a, b: a.values()[0, 0, 0] == 7 and b.values()[0, 0, 0] == 0),
    "fill": (SOLVED, (), ("--fill", "-5"), lambda a, b: (b.values()[b.values("cavity") > 0] == -5).all()
             and a.values().min() >= 0),
    "transforms": (SOLVED, ("--transforms", "none"), (), appears("transform")),
    "display": (("run", "head.nii.gz", *COARSE, *OPEN), (), ("--display", "radiological"),
                lambda a, b: differ("figure")(a, b) and not differ()(a, b)),

    "companion": (SOLVED, (), ("--companion", "label=labels.nii.gz"), appears("companion:labels")),
    "axes": ((*SOLVED, "--companion", "vector=vectors.nii.gz"), ("--axes", "world"), ("--axes", "image"),
             differ("companion:vectors")),
    "tensor_order": ((*SOLVED, "--companion", "tensor=tensors.nii.gz", "--axes", "world"), (),
                     ("--tensor-order", "mrtrix"), differ("companion:tensors")),
    "points": (SOLVED, (), ("--points", "targets.csv"), appears("points")),
    "streamlines": (SOLVED, (), ("--streamlines", "tracts.tck"), appears("streamlines")),
    "surfaces": (SOLVED, (), ("--surfaces", "lesion.stl"), appears("surfaces")),
    "strict": (MOVED, (), ("--strict",), lambda a, b: a.code == 0 and "W409" in a.err and b.code and "W409" in b.err),
}

#: The same of `xfemnav apply`, with names of its files; the run has two steps, and no reports of surfaces' frames.
APPLY = {
    "output": ("head.nii.gz", (), ("-o", "elsewhere"), lambda a, b: made(a, "") and made(b, "elsewhere")),
    "kind": ("labels.nii.gz", ("--kind", "label"), ("--kind", "continuous"), lambda a, b: len(np.unique(values(a))) <= 3
             < len(np.unique(values(b)))),
    "interp": ("head.nii.gz", (), ("--interp", "nearest"), lambda a, b: (values(a) != values(b)).any()),
    "axes": ("vectors.nii.gz", ("--axes", "world"), ("--axes", "image"), lambda a, b: (values(a) != values(b)).any()),
    "order": ("tensors.nii.gz", ("--tensor-order", "fsl"), ("--tensor-order", "mrtrix"),
              lambda a, b: (values(a) != values(b)).any()),
    "outside": ("dusty.nii.gz", (), ("--outside", "zero"), lambda a, b: (values(a)[0, 0], values(b)[0, 0]) == (7, 0)),
    "fill": ("head.nii.gz", (), ("--fill", "-5"), lambda a, b: values(a).min() == 0 and values(b).min() == -5),
    "nifti_frame": ("framed.nii.gz", (), ("--nifti-frame", "qform"), lambda a, b: (values(a) != values(b)).any()),
    "side": ("targets.csv", ("--side", "left"), ("--side", "right"), lambda a, b: places(a) != places(b)),
    "inverse": ("targets.csv", (), ("--inverse",), lambda a, b: made(a, "", "updated") and made(b, "", "preoperative")),
    "space": ("lesion.stl", ("--space", "lps"), ("--space", "ras"), lambda a, b: places(a) != places(b)),
    "step": ("targets.csv", ("--step", "first"), ("--step", "then"), lambda a, b: len(made(a, "", "step-first")) == 1
             and made(b, "", "step-then")),
    "force": ("head.nii.gz", (), ("--force",), lambda a, b: "E731" in a.err and a.code == 73 and b.code == 0),
}
STEPS = """xfemnav = 1
image = "head.nii.gz"
mesh.element_size_mm = 8
mesh.corridor_element_mm = 4
load.gravity = [0, -1]
cut = [{points = [[-60, 10], [-15, 5]]}]
retract = [{side = "left", normal_mm = 4}]
step = [{name = "first", acts = ["cut", "cut left"]}, {name = "then", acts = ["gravity"]}]
"""


def made(found, folder, word="updated"):
    """Files that a command has made in a folder beside or in its own."""
    return [path for path in (found.folder.parent / folder if folder else found.folder).iterdir() if word in path.name]


def values(found):
    """Values of the one image that a command has made."""
    path, = made(found, "", "updated.nii.gz")
    return np.squeeze(nib.load(path).get_fdata())


def places(found):
    """The one file of points, or surface, that a command has made."""
    path, = made(found, "")
    return path.read_bytes()


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The folder of the files, with a mesh and two scenarios."""
    folder = tmp_path_factory.mktemp("options")
    files(folder)
    plain = "xfemnav = 1\nimage = 'head.nii.gz'\n[[cut]]\npoints = [[-60, 10], [-15, 5]]\n[mesh]\ncorridor_mm = 0\n"
    (folder / "plain.toml").write_text(plain + "element_size_mm = 8\n")
    (folder / "inner").mkdir()
    (folder / "inner" / "case.toml").write_text(plain.replace("head", "../head"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XFEMNAV_CACHE", str(folder / "cache"))
        made = run(folder / "own", "mesh", "head.nii.gz", "--element-size-mm", "6", *LIP, "-o", "own")
        shutil.copy(folder / "own" / made.record["outputs"]["mesh"], folder / "own.vtu")
        yield folder


def both(home, monkeypatch, common, *more):
    """The two runs of a row, from the folder of the files, each into its own."""
    monkeypatch.chdir(home)
    monkeypatch.setenv("XFEMNAV_CACHE", str(home / "cache"))
    return [run(home / f"out-{k}", *common, "-o", f"out-{k}", *words) for k, words in enumerate(more)]


def own_options(*commands) -> set[str]:
    """The names of all options of these commands."""
    return {option.name for command in commands for option in command.params if isinstance(option, click.Option)}


def test_every_option_has_a_row():
    assert set(RUN) == own_options(run_command, *stage_commands)


@pytest.fixture
def apart(home, monkeypatch):
    """Nothing left of other rows' runs."""
    for name in ("out-0", "out-1", "elsewhere"):
        shutil.rmtree(home / name, ignore_errors=True)
    for name in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        monkeypatch.setenv(f"{name}_NUM_THREADS", os.environ.get(f"{name}_NUM_THREADS", "1"))
    return home


@pytest.mark.parametrize("name", RUN)
def test_an_option_of_a_run_changes_what_it_says(apart, monkeypatch, name):
    common, first, second, law = RUN[name]
    a, b = both(apart, monkeypatch, common, first, second)
    assert law(a, b), (a.out + a.err, b.out + b.err)


def test_every_option_of_apply_has_a_row():
    assert set(APPLY) == own_options(tools.apply)


@pytest.fixture(scope="module")
def finished(home):
    """The run that is applied."""
    (home / "steps.toml").write_text(STEPS)
    assert run(home / "steps", "run", "--scenario", "steps.toml", "--no-report", "-o", "steps").code == 0


@pytest.mark.parametrize("name", APPLY)
def test_an_option_of_apply_changes_what_it_says(apart, finished, monkeypatch, name):
    file, first, second, law = APPLY[name]
    more = {"axes": ("--kind", "vector"), "order": ("--kind", "tensor", "--axes", "world")}.get(name, ())
    if name == "force":
        (apart / "out-0").mkdir()
        (apart / "out-1").mkdir()
        for folder in ("out-0", "out-1"):
            (apart / folder / "head_desc-updated.nii.gz").write_bytes(b"")
    a, b = both(apart, monkeypatch, ("apply", "steps", file, *more), first, second)
    assert law(a, b), (a.out + a.err, b.out + b.err)


def test_every_option_is_at_home_on_one_page():
    """A setting in the generated page of keys, or in its words; what else a command takes, on the page of its topic."""
    keys, outputs, apply, many = ((ROOT / "docs" / page).read_text() for page in (
        "reference/scenario.md", "reference/outputs.md", "use/apply.md", "use/batch.md"))
    for option in run_command.params:
        if isinstance(option, click.Option):
            called = rf"`{option.opts[-1]}(?![\w-])"
            rows = re.findall(rf"^\|[^|]*{called}", outputs, re.MULTILINE)
            assert (re.search(called, keys) and not rows) if option.name in TABLE else len(rows) == 1, option.name
    assert all(re.search(rf"{option.opts[-1]}\b|(?<=[ `]){option.opts[0]}\b", apply) for option in tools.apply.params
               if isinstance(option, click.Option))
    assert re.search(r" -j \d", many)


@pytest.mark.parametrize("jobs", [1, 2])
def test_jobs_of_a_batch_run_at_a_time(tmp_path, monkeypatch, jobs):
    """Two items meet, or wait in vain for one another."""
    meeting, met = threading.Barrier(2), []

    def item(each, running):
        try:
            meeting.wait(0.2)
            met.append(each)
        except threading.BrokenBarrierError:
            pass
        return batch.Outcome(each, 0, {}, "", 0.0)

    monkeypatch.setattr(batch, "run_item", item)
    (tmp_path / "list.csv").write_text("image,name,cut\na.nii,a,0 1\nb.nii,b,0 1\n")
    monkeypatch.setattr(batch, "read_manifest", lambda source, target: [
        batch.Item(name, None, (), tmp_path, target / name) for name in "ab"])
    run(tmp_path, "batch", tmp_path / "list.csv", tmp_path / "out", "-j", jobs)
    assert len(met) == (2 if jobs == 2 else 0)


def test_every_other_option_is_known_here():
    """Of the commands that run nothing; tests of their own try these."""
    def leaves(command):
        return [leaf for each in command.commands.values() for leaf in leaves(each)] if isinstance(
            command, click.Group) else [command]

    tried = {"batch": {"jobs"}, "doctor": {"root"}, "ls": {"root"}, "verify": {"root"}, "prune": {"root", "days"},
             "phantom": {"force"}, "surgery": {"force"}, "check": set(), "schema": set()}
    runs = {run_command, tools.apply, *stage_commands}
    found = {each.name: own_options(each) for each in leaves(main.cli) if each not in runs}
    assert found.pop("demo") <= set(RUN) and found == tried
