"""Commands that write, the states that they begin in, and what is remembered so that writing is what takes time."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jinja2
from small import CUT, QUICK, write


@dataclass(frozen=True)
class Command:
    """A command that writes: its arguments, the folder that it writes into, commands before it, and what is done then.

    `code` is its exit, `also` what it may be beside those of what cannot be written, `recorded` whether there is a
    run.json.
    """

    name: str
    arguments: tuple[str, ...]
    out: str = "out"
    after: tuple["Command", ...] = ()
    spoil: Callable[[Path], None] = lambda root: None
    code: int = 0
    also: tuple[int, ...] = ()
    recorded: bool = True


def run_of(*more: str) -> tuple[str, ...]:
    """Arguments of a small run."""
    return ("run", "head.nii.gz", *QUICK[:4], "--cut", CUT, "-o", "out", *more)


def damage(root: Path) -> None:
    """Flip a bit of each entry's manifest."""
    for path in sorted((root / "cache" / "entries").rglob("manifest.json"))[::2]:
        data = path.read_bytes()
        path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))


NEW = Command("a run into a new folder", run_of("--opening-mm", "4"))
CARRY = ("--companion", "other.nii.gz", "--points", "points.fcsv", "--points", "points.tsv", "--surfaces", "ball.stl",
         "--transforms", "all", "--opening-mm", "4")
COMMANDS = [
    NEW,
    Command("another run over an old result", run_of("--opening-mm", "3"), after=(NEW,)),
    Command("the same run over its own result", NEW.arguments, after=(NEW,)),
    Command("a run that carries files along", run_of(*CARRY, "--no-report"), after=(NEW,)),
    Command("apply", ("apply", "out", "other.nii.gz", "points.fcsv", "ball.stl", "-o", "applied", "--force"), "applied",
            (NEW,), also=(1,), recorded=False),  # 1: some of several files failed
    Command("a run on a damaged cache", NEW.arguments, after=(NEW,), spoil=damage),
    Command("cache verify", ("cache", "verify"), after=(NEW,), spoil=damage, code=65, recorded=False),
    Command("cache prune", ("cache", "prune", "--days", "0"), after=(NEW,), spoil=damage, recorded=False),
]


def write_inputs(folder: Path) -> None:
    """A small head, another image of it, landmarks in two formats, and a surface."""
    import meshio

    write(folder / "head.nii.gz")
    write(folder / "other.nii.gz")
    (folder / "points.fcsv").write_text("# CoordinateSystem = LPS\n# columns = id,x,y,z,label\na,20,5,10,one\n")
    (folder / "points.tsv").write_text("x\ty\tz\n-20\t5\t10\n20\t5\t10\n")
    corners = [[-20, 0, 10], [-10, 0, 10], [-20, 9, 10], [-20, 0, 12.0]]
    meshio.Mesh(corners, [("triangle", [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])]).write(folder / "ball.stl")


def remember(put=setattr) -> None:
    """Let stages, the figure and the template of the report be what they were before, when asked the same again."""
    from xfemnav.pipeline.keeping.disk import write_atomic
    from xfemnav.pipeline.stages.table import CARRY as CARRIED
    from xfemnav.pipeline.stages.table import SAFE, STAGES
    from xfemnav.pipeline.telling import figure, report

    known: dict[tuple, object] = {}

    def remembering(name, compute):
        def recall(params, inputs):
            key = name, inputs.step, repr(params), repr(inputs.config)
            if key not in known:
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    known[key] = compute(params, inputs), [item.message for item in caught]
            value, told = known[key]
            for message in told:
                warnings.warn(message)  # noqa: B028
            return value
        return recall

    for stage in (*STAGES.values(), CARRIED, SAFE):
        put(stage.code, "compute", remembering(stage.name, stage.code.compute))
    draw = figure.draw_figure

    def draw_once(path, slice, mask, problem, solution, *more):
        key = "figure", solution.moved.tobytes()
        if key not in known:
            known[key] = draw(path, slice, mask, problem, solution, *more).read_bytes()
        return write_atomic(path, known[key])

    put(figure, "draw_figure", draw_once)
    templates = []

    def environment(**given):
        templates.extend([] if templates else [jinja2.Environment(**given)])
        return templates[0]

    put(report, "Environment", environment)
