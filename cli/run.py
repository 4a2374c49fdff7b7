"""`xfemnav run`, the five stage commands, and `xfemnav demo`."""

import os
import signal
import sys
from pathlib import Path

import click

from xfemnav.errors import EXIT_UNTRUSTED, XfemnavError
from xfemnav.interruption import checkpoint, forget
from xfemnav_cli.mistakes import REAL, Command
from xfemnav_cli.telling import FLAGS, Teller, complain, give_up

STAGES = ("segment", "mesh", "constrain", "solve", "warp")
FILE = click.Path(path_type=Path)


def _choice(*names: str) -> click.Choice:
    return click.Choice(names, case_sensitive=False)


NIFTI_FRAME = click.option("--nifti-frame", type=_choice("auto", "sform", "qform"),
                           help="Which frame of a NIfTI header with two is taken.  [auto: the sform]")
INPUT = (
    click.option("--scenario", type=FILE, help="TOML file with the same settings; flags win over it."),
    click.option("--allow-outside", is_flag=True, default=None,
                 help="Paths of the scenario may lead out of its folder."),
    click.option("--slice", type=int, metavar="K", help="Voxel index of the slice in a volume."),
    click.option("--slice-mm", type=REAL, metavar="S", help="Position of the slice along its normal, mm."),
    click.option("--plane", type=_choice("axial", "coronal", "sagittal"), help="Plane of the slice."),
    click.option("--mask", type=FILE, help="Mask of the organ: a slice or volume on the image's grid."),
    click.option("--segment-method", type=_choice("auto", "otsu", "vote", "svc"), help="How to find it.  [auto]"),
    click.option("--template", type=FILE, help="Template image, for svc."),
    click.option("--template-mask", type=FILE, help="The template's mask, for svc."),
    click.option("--skull-on", type=_choice("auto", "on", "stripped"), help="Is the skull in the image?  [auto]"),
    click.option("--resample-mask", is_flag=True, default=None, help="Accept a mask on another grid."),
    click.option("--volume", type=int, metavar="N", help="Which volume of a 4-D image."),
    click.option("--nan", type=REAL, metavar="VALUE", help="Value for NaN and infinite voxels."),
    click.option("--spacing", metavar="DX,DY[,DZ]", help="Pixel sizes, mm, in place of the header's frame."),
    NIFTI_FRAME,
    click.option("--space", type=_choice("ras", "lps", "voxel"),
                 help="How points are read; vectors of lips are plane RAS in each.  [ras]"),
    click.option("--max-memory", type=REAL, metavar="GB", help="Largest image to read.  [4]"),
)
MESH = (
    click.option("--cut", multiple=True, metavar="'X,Y X,Y ...'|FILE",
                 help="Points of a cut, mouth first, 2 numbers (plane mm) or 3 (world mm), or a point file (.mrk.json, "
                      ".fcsv, .csv, .tsv, .tag); repeat for more cuts."),
    click.option("--markup", metavar="NAME", help="Which markup of a point file with several."),
    click.option("--resect", multiple=True, metavar="'X,Y X,Y ...'|FILE|label=N,N",
                 help="Closed outline of what is taken out, a point file with it, a mask, or labels of --labels."),
    click.option("--min-resection-mm", type=REAL, metavar="D",
                 help="Smaller bits of a label or mask stay, smaller holes are filled (diameter of the disc).  [4]"),
    click.option("--mesh", type=FILE, metavar="FILE.vtu", help="A mesh of yours: VTU triangles in RAS mm."),
    click.option("--element-size-mm", type=REAL, metavar="H", help="Edge length of the elements.  [3]"),
    click.option("--corridor-mm", type=REAL, metavar="W", help="Fine band on either side of the cuts; 0: none.  [12]"),
    click.option("--corridor-element-mm", type=REAL, metavar="H", help="Edge length there.  [1]"),
    click.option("--grade-at-data-ends", is_flag=True, default=None,
                 help="Finer where held lips end and where the outline begins to be held (verification)."),
)
MECHANICS = (
    click.option("--left", metavar="DX,DY|X",
                 help="Displacement of the left lip of the first cut, plane mm; or mm away from the other lip."),
    click.option("--right", metavar="DX,DY|X", help="The same of the right lip."),
    click.option("--lip-force", multiple=True, metavar="left=FX,FY", help="Force on a lip, mN per mm of thickness."),
    click.option("--opening-mm", type=REAL, metavar="X", help="Open the first cut along its normal, X mm in all."),
    click.option("--blade", metavar="FROM,TO", help="Held part of the cut: 0 at the mouth, 1 at the tip.  [0,0.8]"),
    click.option("--internal", is_flag=True, default=None, help="The cuts lie inside, with two tips."),
    click.option("--young-kpa", type=REAL, metavar="E", help="Young's modulus.  [3]"),
    click.option("--poisson", type=REAL, metavar="NU", help="Poisson's ratio.  [0.45]"),
    click.option("--stress-state", type=_choice("strain", "stress"), help="Plane strain or plane stress.  [strain]"),
    click.option("--labels", type=FILE, help="Label map, for --resect label=N,N and the tissues of a scenario."),
    click.option("--gravity", metavar="X,Y", help="Direction of gravity in the plane, plane RAS; none by default."),
    click.option("--model", type=_choice("linear", "neo-hookean"), help="Small strains or finite ones.  [linear]"),
    click.option("--skull", type=_choice("fixed", "sliding", "free", "contact"),
                 help="What holds the outline.  [fixed]"),
    click.option("--skull-gap-mm", type=REAL, metavar="G", help="Gap to the skull, for contact.  [0]"),
    click.option("--lips", type=_choice("contact", "free"),
                 help="Lips that nobody holds: they do not pass through each other, or are free.  [contact]"),
    click.option("--loose-pieces", type=_choice("refuse", "hold", "remove"),
                 help="Pieces cut free that nothing holds.  [refuse]"),
    click.option("--craniotomy-mm", type=REAL, metavar="R", help="Outline freed about a cut's mouth.  [20]"),
    click.option("--skull-ramp-mm", type=REAL, metavar="R", help="Length over which the skull's grip sets in.  [4]"),
    click.option("--boundary-displacement", type=FILE, metavar="FILE.csv",
                 help="Measured motion of the outline: x,y,ux,uy[,side], plane mm read by --space ras or lps."),
    click.option("--tip-enrichment", type=_choice("topological", "geometric", "none"),
                 help="Functions at tips.  [topological; neo-hookean: none]"),
    click.option("--lip-constraint", type=_choice("mortar", "nitsche", "pointwise"),
                 help="How lips are held.  [mortar]"),
    click.option("--hold-tip", is_flag=True, default=None, help="Hold the tip cell too (pointwise only)."),
)
WARP = (
    click.option("--interp", type=_choice("linear", "cubic", "nearest"), help="Interpolation.  [linear]"),
    click.option("--outside", type=_choice("keep", "zero"), help="Pixels outside the organ.  [keep]"),
    click.option("--fill", type=REAL, metavar="VALUE", help="Value of pixels without tissue.  [the background's]"),
    click.option("--transforms", type=_choice("none", "itk", "all"),
                 help="The motion for other programs: one ITK transform, or every form and direction.  [itk]"),
)
CARRIED = (
    click.option("--companion", multiple=True, metavar="[KIND=]FILE",
                 help="Another image to carry along: KIND continuous, label, vector, axis or tensor; repeat.  "
                      "[label or continuous, by name, header and data]"),
    click.option("--axes", type=_choice("file", "world", "image", "index"),
                 help="Axes of vectors and tensors of --companion: as the file says, RAS (LPS in formats that are), "
                      "FSL's, the array's.  [file]"),
    click.option("--tensor-order", type=_choice("fsl", "mrtrix", "nifti"),
                 help="Order of a tensor's components.  [as the file states, else fsl]"),
    click.option("--points", multiple=True, type=FILE, metavar="FILE",
                 help="Landmarks to move: .mrk.json, .fcsv, .csv, .tsv, .tag; repeat."),
    click.option("--streamlines", multiple=True, type=FILE, metavar="FILE",
                 help="Tractogram to move: .trk, .trk.gz, .tck; repeat."),
    click.option("--surfaces", multiple=True, type=FILE, metavar="FILE",
                 help="Surface to move: .stl, .vtk, .vtp, .gii, .obj, .ply; --space is that of one that does not say "
                      "its own; repeat."),
)
RUNNING = (
    click.option("-o", "--output", type=FILE, metavar="DIR", help="Output folder.  [./<stem>_xfemnav]"),
    click.option("-w", "--cache", type=FILE, metavar="DIR", help="Cache.  [$XFEMNAV_CACHE, else ~/.cache/xfemnav]"),
    click.option("--strict", is_flag=True, default=None, help="Warnings are errors."),
    click.option("--dry-run", is_flag=True, help="Say what would run, and run nothing."),
    click.option("--force", is_flag=True, help="Compute every stage again."),
    click.option("--force-from", type=_choice(*STAGES), help="Compute this stage and the later ones again."),
    click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, all else on stderr."),
    click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors."),
    click.option("-v", "--verbose", count=True, help="Say more; -vv shows tracebacks."),
    click.option("--threads", type=click.IntRange(1), metavar="N", help="Threads for the numeric libraries."),
)
WHOLE = (
    click.option("--display", type=_choice("neurological", "radiological"),
                 help="Of figure and report: the patient's left on the viewer's left, or right.  [neurological]"),
    click.option("--stop-after", type=_choice(*STAGES), help="End after this stage."),
    click.option("--no-report", is_flag=True, help="No figure and no report."),
)
IMAGE = (click.argument("image", type=FILE, required=False),)


def _with(*groups):
    """Decorator that adds groups of options, in the order of `groups`."""
    def decorate(function):
        for option in reversed([option for group in groups for option in group]):
            function = option(function)
        return function
    return decorate


@click.command(cls=Command)
@_with(IMAGE, INPUT, MESH, MECHANICS, WARP, CARRIED, RUNNING, WHOLE)
def run(**given):
    """Update IMAGE after a cut: all stages, reusing finished ones."""
    return execute(**given)


def _stage_command(stage: str, groups: tuple, text: str) -> click.Command:
    def command(**given):
        return execute(stop_after=stage, no_report=True, **given)

    command.__doc__ = text
    return click.command(name=stage, cls=Command)(_with(IMAGE, *groups, RUNNING)(command))


stage_commands = (
    _stage_command("segment", (INPUT,), "Find the organ in a slice of IMAGE."),
    _stage_command("mesh", (INPUT, MESH), "Mesh the organ; earlier stages run through the cache."),
    _stage_command("constrain", (INPUT, MESH, MECHANICS), "Embed the cuts in the mesh and pose the problem."),
    _stage_command("solve", (INPUT, MESH, MECHANICS), "Solve for the motion of the tissue."),
    _stage_command("warp", (INPUT, MESH, MECHANICS, WARP, CARRIED), "Make the updated image, without a report."),
)


@click.command(cls=Command)
@_with(MESH, MECHANICS, WARP, (NIFTI_FRAME, *CARRIED), RUNNING, WHOLE)
def demo(**given):
    """The paper's experiment on a real slice: MNI152 T1, axial z = +18 mm, cut and opened by +-(3.5, 1) mm.

    Options change it: `--lip-constraint pointwise --corridor-mm 0` are the paper's own choices.
    """
    from xfemnav.pipeline import demo

    given["output"] = given["output"] or Path("xfemnav_demo")
    return execute(image=demo.image(), **demo.with_defaults(given))


def execute(*, image=None, scenario=None, output=None, cache=None, dry_run=False, force=False, force_from=None,
            stop_after=None, no_report=False, as_json=False, quiet=False, verbose=0, threads=None, **flags) -> int:
    """Configure and run; the exit code. `flags` are those of the scenario, by name."""
    if threads:
        for name in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
            os.environ[f"{name}_NUM_THREADS"] = str(threads)
    from xfemnav.pipeline import job
    from xfemnav.pipeline.bearings import told
    from xfemnav.pipeline.config import configure
    from xfemnav.pipeline.flags import keys

    names = FLAGS if scenario is None else keys(FLAGS)
    teller = Teller(as_json=as_json, quiet=quiet, verbose=verbose)
    try:
        config = configure(image, scenario, flags, until=stop_after or "warp")
        options = job.Options(
            output=output or job.default_output(config.image), cache=cache or job.default_cache(),
            until=stop_after or "warp", force_from=STAGES[0] if force else force_from, report=not no_report,
            argv=("xfemnav", *sys.argv[1:]), names=names,
        )
        if dry_run:
            return _plan(job.plan(config, options), teller)
        checkpoint()
        record = job.run(config, options, job.Listener(teller.started, teller.finished, teller.waiting,
                                                       teller.compiling, teller.failed))
        forget()  # a signal that comes now ends nothing
    except (XfemnavError, job.Interrupted) as error:
        if as_json:
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
    for sentence in told(record):
        teller.say(f"where      {sentence}")
    teller.warnings(record)
    if as_json:
        teller.json(record)
    name = record["outputs"].get("report")
    teller.say(f"report     {options.output / name}" if name else f"results    {options.output}")
    if record["exit_code"] == EXIT_UNTRUSTED:
        complain(f"{record['error']['code']} {record['error']['text']}")
    return record["exit_code"]


def _plan(rows, teller: Teller) -> int:
    if teller.as_json:
        teller.json({"stages": [{"name": name, "status": status, "key": key} for name, status, key in rows]})
    for name, status, key in rows:
        teller.say(f"{name:<10} {status:<9} {(key or 'key known later')[:15]}")
    return 0
