"""`xfemnav example`: the files of an example, to try the program on and to see what it takes."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import click

from xfemnav.errors import XfemnavError
from xfemnav_cli.mistakes import FILE
from xfemnav_cli.telling import say

FOLDER = click.argument("folder", metavar="DIR", type=FILE)
FORCE = click.option("--force", is_flag=True, help="Replace files of these names that hold something else.")


@click.group()
def example():
    """Write the files of an example into a folder: images, label maps, cuts, landmarks, scenarios."""


@example.command()
@FOLDER
@FORCE
def phantom(folder, force):
    """A brain phantom with a tumour, and a known motion: NIfTI images, a cut, landmarks, and the truth."""
    from xfemnav_examples import files
    from xfemnav_examples.phantom import Phantom

    _deliver(lambda scratch: files.write(Phantom(), scratch), folder, force)


@example.command()
@FOLDER
@FORCE
def surgery(folder, force):
    """An operation in five steps on a slab of a real brain (MNI152, of the package nilearn), with its scenario."""
    from xfemnav.pipeline.running import demo

    demo.image()  # says what is missing
    from xfemnav_examples import surgery

    _deliver(surgery.write, folder, force)


def _deliver(write: Callable[[Path], object], folder: Path, force: bool) -> None:
    """Put the files that `write` makes in a folder into `folder`, all or none. Raises E501, E502, and E731 where one is
    there that holds something else."""
    from xfemnav.pipeline.keeping.disk import write_together, writing

    with writing(Path(tempfile.gettempdir()), "temporary files"), tempfile.TemporaryDirectory() as scratch:
        write(Path(scratch))
        files = {path.relative_to(scratch).as_posix(): path.read_bytes() for path in sorted(Path(scratch).rglob("*"))
                 if path.is_file()}
    with writing(folder, "the example"):
        foreign = [name for name, data in files.items() if not force and _holds_another(folder / name, data)]
    if foreign:
        raise XfemnavError("E731", f"{', '.join(foreign)} in {folder} would be overwritten. Give another folder, or "
                                   "--force to replace them.")
    with writing(folder, "the example"):
        for name in files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
    write_together(folder, files)
    for name in files:
        say(str(folder / name))


def _holds_another(path: Path, data: bytes) -> bool:
    """Whether there is something else at a path."""
    return os.path.lexists(path) and not (os.path.isfile(path) and path.read_bytes() == data)
