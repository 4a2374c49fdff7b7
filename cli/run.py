"""`xfemnav run`, the five stage commands, and `xfemnav demo`."""

import os
import signal
import sys
from dataclasses import dataclass, fields
from pathlib import Path

import click

from xfemnav.errors import EXIT_UNTRUSTED, XfemnavError
from xfemnav.interruption import checkpoint, forget
from xfemnav.pipeline.asking.settings import INPUT, STAGES, TABLE
from xfemnav_cli.options import FILE, Grouped, Option, choice, option, options, until
from xfemnav_cli.telling import FLAGS, Teller, complain, give_up

EXAMPLES = (
    "xfemnav example phantom .",
    'xfemnav run sub-phantom_T1w.nii.gz --cut "58,50.2 25.4,22" --opening-mm 7',
    'xfemnav run sub-phantom_T1w.nii.gz --resect "62,54 68,44 25,20" --gravity 0,-1 -o sagged',
    "xfemnav run --scenario scenario.toml --model neo-hookean -o measured",
)


@dataclass(frozen=True)
class Control:
    """How a command runs and what it says; the options of these names."""

    output: Path | None = None
    cache: Path | None = None
    dry_run: bool = False
    force: bool = False
    force_from: str | None = None
    stop_after: str | None = None
    no_report: bool = False
    as_json: bool = False
    quiet: bool = False
    verbose: int = 0
    threads: int | None = None


def image() -> list[click.Parameter]:
    """What a run is made of."""
    return [click.Argument(["image"], type=FILE, required=False),
            Option(["--scenario"], type=FILE, group=INPUT, help="TOML file with the same settings; flags win over it.")]


def control() -> list[Option]:
    """The options of every command that runs stages."""
    return [
        Option(["-o", "--output"], type=FILE, metavar="DIR", help="Output folder.  [./<stem>_xfemnav]"),
        Option(["-w", "--cache"], type=FILE, metavar="DIR", help="Cache.  [$XFEMNAV_CACHE, else ~/.cache/xfemnav]"),
        Option(["--dry-run"], is_flag=True, help="Say what would run, and run nothing."),
        Option(["--force"], is_flag=True, help="Compute every stage again."),
        Option(["--force-from"], type=choice(STAGES), help="Compute this stage and the later ones again."),
        Option(["--json", "as_json"], is_flag=True, help="One JSON object on stdout, all else on stderr."),
        Option(["-q", "--quiet"], is_flag=True, help="Say nothing but errors."),
        Option(["-v", "--verbose"], count=True, help="Say more; -vv shows tracebacks."),
        Option(["--threads"], type=click.IntRange(1), metavar="N", help="Threads for the numeric libraries."),
    ]


def whole() -> list[Option]:
    """The options of commands that run all stages."""
    return [
        Option(["--stop-after"], type=choice(STAGES), help="End after this stage."),
        Option(["--no-report"], is_flag=True, help="No figure and no report."),
    ]


def _run(**given) -> int:
    """Update IMAGE after a cut: all stages, reusing finished ones."""
    return execute(given)


run = Grouped("run", params=[*image(), *control(), *whole(), *options((*STAGES, "report"))], callback=_run,
              help=_run.__doc__, examples=EXAMPLES)


def _stage_command(stage: str, text: str) -> click.Command:
    def command(**given) -> int:
        return execute(given | {"stop_after": stage, "no_report": True})

    return Grouped(stage, params=[*image(), *control(), *options(until(stage))], callback=command, help=text)


stage_commands = (
    _stage_command("segment", "Find the organ in a slice of IMAGE."),
    _stage_command("mesh", "Mesh the organ; earlier stages run through the cache."),
    _stage_command("constrain", "Embed the cuts in the mesh and pose the problem."),
    _stage_command("solve", "Solve for the motion of the tissue."),
    _stage_command("warp", "Make the updated image, without a report."),
)


def _demo(**given) -> int:
    """The paper's experiment on a real slice: MNI152 T1, axial z = +18 mm, cut and opened by +-(3.5, 1) mm.

    Options change it: `--lip-constraint pointwise --corridor-mm 0` are the paper's own choices. With `--dim 3`: an
    approach through the right frontal lobe of the whole volume, 40 mm long and 49 deep, opened by 8 mm.
    """
    from xfemnav.pipeline.running import demo

    given["output"] = given["output"] or Path("xfemnav_demo")
    return execute(demo.with_defaults(given) | {"image": demo.image()})


demo = Grouped("demo", params=[*control(), *whole(), *options((*STAGES[1:], "report")), option("nifti_frame"),
                       option("dim")],
               callback=_demo, help=_demo.__doc__)


def execute(given: dict) -> int:
    """Configure and run; the exit code. `given`: an image, a scenario, the fields of `Control`, and flags of the
    scenario, by name."""
    how = Control(**{field.name: given[field.name] for field in fields(Control) if field.name in given})
    flags = {name: value for name, value in given.items() if name in TABLE}
    if how.threads:
        for name in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
            os.environ[f"{name}_NUM_THREADS"] = str(how.threads)
    from xfemnav.pipeline.asking.config import configure
    from xfemnav.pipeline.asking.flags import keys
    from xfemnav.pipeline.running import job
    from xfemnav.pipeline.telling.bearings import told

    scenario = given.get("scenario")
    names = FLAGS if scenario is None else keys(FLAGS)
    teller = Teller(as_json=how.as_json, quiet=how.quiet, verbose=how.verbose)
    try:
        config = configure(given.get("image"), scenario, flags, until=how.stop_after or "warp")
        options = job.Options(
            output=how.output or job.default_output(config.image), cache=how.cache or job.default_cache(),
            until=how.stop_after or "warp", force_from=STAGES[0] if how.force else how.force_from,
            report=not how.no_report, argv=("xfemnav", *sys.argv[1:]), names=names,
        )
        if how.dry_run:
            return _plan(job.plan(config, options), teller)
        checkpoint()
        record = job.run(config, options, job.Listener(teller.started, teller.finished, teller.waiting,
                                                       teller.compiling, teller.failed))
        forget()  # a signal that comes now ends nothing
    except (XfemnavError, job.Interrupted) as error:
        if how.as_json:
            teller.json({"schema": job.SCHEMA} | job.failure(error, names))
        if isinstance(error, XfemnavError):
            error.names = names
            raise
        forget()
        complain("interrupted; finished stages are kept, so the same command goes on from there.")
        return 128 + error.signum
    except BrokenPipeError:
        give_up(sys.stdout)
        return 128 + signal.SIGPIPE
    finally:
        teller.stop()
    return _told(record, teller, told(record), options.output)


def _told(record: dict, teller: Teller, sentences, output: Path) -> int:
    """Say what a run has come to; its exit code."""
    for sentence in sentences:
        teller.say(f"where      {sentence}")
    teller.warnings(record)
    if teller.as_json:
        teller.json(record)
    name = record["outputs"].get("report")
    teller.say(f"report     {output / name}" if name else f"results    {output}")
    if record["exit_code"] == EXIT_UNTRUSTED:
        complain(f"{record['error']['code']} {record['error']['text']}")
    return record["exit_code"]


def _plan(rows, teller: Teller) -> int:
    if teller.as_json:
        teller.json({"stages": [{"name": name, "status": status, "key": key} for name, status, key in rows]})
    for name, status, key in rows:
        teller.say(f"{name:<10} {status:<9} {(key or 'key known later')[:15]}")
    return 0
