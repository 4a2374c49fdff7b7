"""A finished run applied to a file that comes later: an image, landmarks, streamlines or a surface."""

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.pipeline.keeping.disk import OTHER_TMPDIR, remove_temporaries, scratch, write_together, writing
from xfemnav.pipeline.keeping.locks import locked
from xfemnav.pipeline.keeping.names import BIDS, public_name, sidecar_name, slug, stem
from xfemnav.pipeline.running.reopening import refuse_a_volume
from xfemnav.pipeline.running.result import Result
from xfemnav.pipeline.running.runfile import DESCRIBED, json_text
from xfemnav.pipeline.stages.inputs import Warned, recorded
from xfemnav.pipeline.stages.stage_carry import ending, placed, point_ending

#: What is carried, in words, and what other files of patients may be turned into.
CARRIED = ("images (NIfTI, NRRD, MetaImage, MGH, a folder of DICOM), landmarks ({points}), streamlines ({tracts}) and "
           "surfaces ({surfaces})")
INSTEAD = {".trx": "Convert it to .trk or .tck.", ".vtu": "Write its surface as .vtp (ParaView: Extract Surface).",
           ".pial": "Convert it: mris_convert.", ".white": "Convert it: mris_convert."}


@dataclass(frozen=True)
class Choices:
    """How files are carried: `kind`, `interp`, `axes`, `order`, `outside`, `fill` of images as in `Result.warp`; of
    points the `side` of a cut, and `inverse`, from now to the preoperative image. `nifti_frame` of images: None for the
    run's. `space` of surfaces as in `Result.surface`."""

    kind: str | None = None
    interp: str = "linear"
    axes: str = "file"
    order: str | None = None
    outside: str = "keep"
    fill: float | None = None
    side: str | None = None
    inverse: bool = False
    nifti_frame: str | None = None
    space: str | None = None


@dataclass(frozen=True)
class Applied:
    """What came of a file: where it is written, what is in it in a few words, and what was warned of."""

    target: Path
    text: str
    warnings: tuple[Warned, ...]


def apply(result: Result, path: Path, folder: Path, choices: Choices = Choices(), *, step: str | None = None,
          force: bool = False, kept: frozenset[Path] = frozenset()) -> Applied:
    """Write the file at `path` as it is after the motion of `result` into `folder`, whole or not at all.

    What it is, its ending says: that of a reader of landmarks, streamlines or surfaces, or else it is an image. Only
    with `force` an existing file is replaced, and never `path` itself, nor one of `kept` or of the run. `step` is the
    one that `result` is of, for the name. Raises E731, E780 (`inverse` for what are no points), what reading raises,
    E501 to E503.
    """
    path, folder = Path(path), Path(folder)
    refuse_a_volume(result, path.name)
    carry = _kind_of(path)
    if choices.inverse and carry is not _points:
        raise XfemnavError("E780", f"{path.name} holds no points, and ⟦inverse⟧ is for points alone. Leave it out.")
    target = folder / output_name(path, step, inverse=choices.inverse)
    targets = [target, *([folder / sidecar_name(target.name)] if carry is _image else [])]
    _refuse(targets, {path, *kept, *_own(result)}, force)
    with recorded() as caught, scratch() as aside, writing(aside, target.name, OTHER_TMPDIR):
        text = carry(result, path, aside / target.name, choices)
        files = {made.name: made.read_bytes() for made in sorted(aside.iterdir())}
    with writing(folder, "the output folder"):
        folder.mkdir(parents=True, exist_ok=True)
    with _held(folder):
        write_together(folder, files)
    return Applied(target, text, tuple(caught))


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Hold a folder while files are put there, and remove what a killed run has left half-written; on a disk without
    locks that stays, for it may be another's who is writing it now."""
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(folder))
            with writing(folder, "the output folder"):
                remove_temporaries(folder)
        except XfemnavError as error:
            if error.code != "E502":
                raise
        yield


def output_name(path: Path, step: str | None = None, *, inverse: bool = False) -> str:
    """The name of what is made of the file at `path`: as a run names what it carries along."""
    carry, name = _kind_of(path), stem(path)
    if step:
        match = BIDS.match(name)
        name = f"{match[1]}_step-{slug(step)}_{match[2]}" if match else f"{name}_step-{slug(step)}"
    if carry is _image:
        return public_name(path, f"companion:{name}")
    if carry in (_tracts, _surface):
        kind = "streamlines" if carry is _tracts else "surfaces"
        return public_name(path, f"{kind}:{name}", ending(kind, path))
    before, _, after = public_name(path, f"points:{name}", point_ending(path)).rpartition("_desc-updated")
    return f"{before}_desc-{'preoperative' if inverse else 'updated'}{after}"


def _kind_of(path: Path):
    """The function that carries a file of this name: the readers know their endings."""
    return next((carry for carry, endings in _endings().items() if path.name.lower().endswith(endings)), _image)


def _endings() -> dict:
    from xfemnav.imaging.points.endings import SURFACES, TRACTS
    from xfemnav.imaging.points.point_files import SUFFIXES

    return {_points: SUFFIXES, _tracts: TRACTS, _surface: SURFACES}


def _image(result: Result, path: Path, target: Path, choices: Choices) -> str:
    from xfemnav import __version__
    from xfemnav.pipeline.keeping.files import write_nifti

    try:
        image = result.warp(path, kind=choices.kind, interp=choices.interp, outside=choices.outside, fill=choices.fill,
                            axes=choices.axes, order=choices.order, nifti_frame=choices.nifti_frame)
    except XfemnavError as error:
        if error.code != "E106" or os.path.isdir(path):
            raise
        raise XfemnavError("E106", _not_carried(path)) from None
    write_nifti(target, image)
    about = DESCRIBED["companion"] | image.extra | {"Sources": [path.name, result.record["outputs"]["solution"]],
                                      "GeneratedBy": [{"Name": "xfemnav", "Version": __version__}]}
    if not result.trusted:
        about["Untrusted"] = f"{result.record['error']['code']} {result.record['error']['text']}"
    (target.parent / sidecar_name(target.name)).write_text(json_text(about))
    return f"{image.extra['Kind']} image"


def _points(result: Result, path: Path, target: Path, choices: Choices) -> str:
    from xfemnav.imaging.carrying.landmarks import warn_of_points
    from xfemnav.imaging.points.point_files import read_points, write_points

    found, organ = read_points(path), result.organ
    outline = result.outline if choices.inverse else organ.outline
    warn_of_points(found, path.name, result.frame, outline)
    moved = result.landmarks(found.points, choices.side, inverse=choices.inverse)
    write_points(target, placed(found, moved, one_lip=choices.side is not None))
    return _counted(moved.flag, "points")


def _tracts(result: Result, path: Path, target: Path, choices: Choices) -> str:
    from xfemnav.imaging.points.tract_files import tract_bytes

    moved = result.streamlines(path)
    target.write_bytes(tract_bytes(moved.file, ending("streamlines", path)))
    return _counted(moved.flag, "streamlines")


def _surface(result: Result, path: Path, target: Path, choices: Choices) -> str:
    moved, organ = result.surface(path, space=choices.space), result.organ
    moved.warn_of_frame(path.name, result.frame, organ.outline)
    target.write_bytes(moved.content)
    return moved.words


def _not_carried(path: Path) -> str:
    """What to say of a file that is none of what is carried."""
    points, tracts, surfaces = (", ".join(endings) for endings in _endings().values())
    carried = CARRIED.format(points=points, tracts=tracts, surfaces=surfaces)
    instead = INSTEAD.get(path.suffix.lower(), "Give one of these.")
    return f"{path.name} is none of what is carried: {carried}. {instead}"


def _counted(flags: tuple[str, ...], what: str) -> str:
    parts = ", ".join(f"{n} {flag}" for flag, n in Counter(flags).most_common())
    return f"{len(flags)} {what if len(flags) != 1 else what[:-1]}" + (f": {parts}" if parts else "")


def _own(result: Result) -> set[Path]:
    """The files of the run."""
    names = {"run.json", *result.record["outputs"].values()}
    return {result.folder / name for name in names | {sidecar_name(name) for name in names}}


def _refuse(targets: list[Path], kept: set[Path], force: bool) -> None:
    """Raise E731 when a target is one of the files that are `kept`, or exists and `force` is not given."""
    own = set(map(os.path.realpath, kept))
    for target in targets:
        if os.path.realpath(target) in own:
            raise XfemnavError("E731", f"the output would overwrite {target}, which is an input or was made just now. "
                                       "Give another folder with ⟦output⟧.")
        if os.path.lexists(target) and not force:
            raise XfemnavError("E731", f"{target} exists. Give another folder with ⟦output⟧, or ⟦force=True⟧ to "
                                       "replace it.")
