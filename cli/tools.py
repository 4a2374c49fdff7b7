"""`xfemnav check`, `schema`, `apply`, `doctor` and `cache`."""

import json
import os
from pathlib import Path

import click

from xfemnav.errors import EXIT_CONFIG, EXIT_DATA, EXIT_SOME_FAILED, EXIT_UNTRUSTED, XfemnavError
from xfemnav.interruption import checkpoint
from xfemnav.naming import said, told
from xfemnav_cli.mistakes import FILE, REAL, Command
from xfemnav_cli.telling import FLAGS, complain, put, say

FOLDER = click.option("-w", "--cache", "root", type=FILE, metavar="DIR",
                      help="Cache.  [$XFEMNAV_CACHE, else ~/.cache/xfemnav]")


@click.command()
@click.argument("scenario", metavar="SCENARIO|RUN", type=FILE)
def check(scenario):
    """List every problem of a SCENARIO file, without running it; or of a finished RUN, given by its folder: outputs and
    inputs that are gone, inputs that have changed since."""
    from xfemnav.pipeline.asking.flags import keys

    names = keys(FLAGS)
    if os.path.isdir(scenario):
        from xfemnav.pipeline.running.reopening import run_problems

        faults = run_problems(scenario)
        found = [fault.told(names) for fault in faults]
        code = faults[0].exit_code if faults else 0
    else:
        from xfemnav.pipeline.asking.config import scenario_problems

        found = [said(text, names) for text in scenario_problems(scenario)]
        code = EXIT_CONFIG if found else 0
    for line in found:
        say(line)
    if not found:
        say(f"{scenario}: no problem found")
    return code


@click.command()
@click.argument("which", type=click.Choice(["scenario", "run"]), default="scenario")
def schema(which):
    """Print the JSON Schema of a scenario, or of run.json (`xfemnav schema run`)."""
    if which == "run":
        from xfemnav.pipeline.running.runfile import run_schema

        found = run_schema()
    else:
        from xfemnav.pipeline.asking.scenario import Scenario

        found = Scenario.model_json_schema()
    put(json.dumps(found, indent=2))


@click.command(cls=Command)
@click.argument("folder", metavar="RUN", type=FILE)
@click.argument("files", metavar="FILE...", type=FILE, nargs=-1, required=True)
@click.option("-o", "--output", type=FILE, metavar="DIR", default=Path(), help="Where to write.  [the current folder]")
@click.option("--kind", type=click.Choice(["continuous", "label", "vector", "axis", "tensor"]),
              help="What the values of images are.  [label or continuous, by name, header and data]")
@click.option("--interp", type=click.Choice(["linear", "cubic", "nearest"]), default="linear", show_default=True,
              help="Interpolation of images; labels are always nearest.")
@click.option("--axes", type=click.Choice(["file", "world", "image", "index"]), default="file", show_default=True,
              help="Axes of vectors and tensors: as the file says, RAS (LPS in formats that are), FSL's, the array's.")
@click.option("--tensor-order", "order", type=click.Choice(["fsl", "mrtrix", "nifti"]),
              help="Order of a tensor's components.  [as the file states, else fsl]")
@click.option("--outside", type=click.Choice(["keep", "zero"]), default="keep", show_default=True,
              help="Pixels outside the organ.")
@click.option("--fill", type=REAL, metavar="VALUE", help="Value of pixels without tissue.  [the background's]")
@click.option("--nifti-frame", type=click.Choice(["auto", "sform", "qform"]),
              help="Which frame of a NIfTI header with two is taken.  [that of the run]")
@click.option("--side", type=click.Choice(["left", "right"]), help="The lip for points on a cut.  [both]")
@click.option("--inverse", is_flag=True, help="Points of now back to the preoperative image.")
@click.option("--space", type=click.Choice(["ras", "lps"]),
              help="Frame of surfaces that do not say their own.  [the run's]")
@click.option("--step", metavar="NAME", help="After this step of the run.  [the last]")
@click.option("--force", is_flag=True, help="Replace existing files; never inputs, nor the run's.")
def apply(folder, files, output, step, force, **choices):
    """Apply the finished run in the folder RUN to what else there is of the preoperative patient.

    Images (any format and grid), landmarks (.mrk.json, .fcsv, .csv, .tsv, .tag), streamlines (.trk, .trk.gz, .tck) and
    surfaces (.stl, .vtk, .vtp, .gii, .obj, .ply). Each file is written whole or not at all,
    and one that fails stops no other. Exit status 1 if some of several failed.
    """
    from xfemnav.pipeline.running.apply import Choices
    from xfemnav.pipeline.running.apply import apply as apply_to
    from xfemnav.pipeline.running.result import Result

    if words := swapped(folder, files):
        raise XfemnavError("E100", words)
    result = Result.load(folder, step)
    kept, failed = set(files), []
    for path in files:
        checkpoint()
        try:
            done = apply_to(result, path, output, Choices(**choices), step=step, force=force, kept=frozenset(kept))
        except XfemnavError as error:
            complain(f"{path}: {error.told(FLAGS)}")
            failed.append(error.exit_code or EXIT_DATA)
            continue
        kept.add(done.target)
        say(f"{path} -> {done.target}  {done.text}")
        for item in done.warnings:
            complain(f"{path}: {item.code} {said(item.text, FLAGS)}")
    if failed:
        return failed[0] if len(files) == 1 else EXIT_SOME_FAILED
    if not result.trusted:
        complain(f"{result.record['error']['code']} {told(result.record['error'], FLAGS)}")
        return EXIT_UNTRUSTED
    return 0


def swapped(folder: Path, files: tuple[Path, ...]) -> str | None:
    """Told of a run that is named after the files, not before them."""
    runs = [path for path in files if os.path.isfile(path / "run.json")]
    if not runs or os.path.exists(folder / "run.json"):
        return None
    return f"no run.json in {folder}; the run's folder comes first: xfemnav apply {runs[0]} {folder}"


@click.command()
@FOLDER
def doctor(root):
    """Check this installation: a small known motion through every format and frame, the cache, the libraries."""
    from xfemnav.pipeline.running.doctor import examine
    from xfemnav.pipeline.running.job import default_cache

    code = 0
    for found in examine(root or default_cache()):
        say(said(found.line, FLAGS))
        checkpoint()
        code = code or found.exit_code
    return code


@click.group()
def cache():
    """Look at the cache, verify it, or remove what is old."""


def _opened(root):
    from xfemnav.pipeline.keeping.cache import Cache
    from xfemnav.pipeline.running.job import default_cache

    return Cache(root or default_cache())


@cache.command()
@FOLDER
def ls(root):
    """List the entries: key and size."""
    found = _opened(root)
    keys = found.keys()
    sizes = dict(zip(keys, map(found.size, keys)))
    for key, size in sizes.items():
        say(f"{key[:12]}  {size / 1e6:9.3f} MB")
    say(f"{len(sizes)} entries, {sum(sizes.values()) / 1e6:.1f} MB in {found.root}")


@cache.command()
@FOLDER
def verify(root):
    """Check every byte of every entry; damaged ones are set aside and will be computed again."""
    found = _opened(root)
    damaged = found.set_aside_damaged()
    for key in damaged:
        say(f"{key[:12]}  damaged, set aside")
    say(f"{len(found.keys())} entries are whole, {len(damaged)} were damaged")
    return EXIT_DATA if damaged else 0


@cache.command()
@FOLDER
@click.option("--days", type=click.FloatRange(0), default=30.0, show_default=True, help="Keep what was used in them.")
def prune(root, days):
    """Remove entries that were not used for some days, and all debris; nothing that the cache has not made."""
    done = _opened(root).prune(days * 86400)
    for name, reason in done.kept.items():
        complain(f"{name} is kept: {reason}")
    say(f"{done.entries} entries removed, {done.freed / 1e6:.1f} MB freed, {len(done.kept)} kept")
