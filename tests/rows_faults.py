"""Rows of faults while a run writes, of memory that is refused, and of signals."""

import contextlib
import io
import json
import os
import shlex
import signal
import subprocess
import sys
import weakref
from pathlib import Path
from unittest import mock

from rows import Row
from small import CUT, OPEN, QUICK, main, write

from xfemnav.pipeline.stages import stage_mesh


def command(folder, *more):
    """Arguments of a small run in `folder`."""
    return ["run", str(folder / "head.nii.gz"), *QUICK, "--cut", CUT, *OPEN, "-o", str(folder / "out"), "-w",
            str(folder / "cache"), *more]


def told(*arguments) -> tuple[int, str]:
    """Exit code and stderr of a command."""
    said = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
        try:
            main(list(arguments))
        except SystemExit as end:
            return end.code or 0, said.getvalue()
    raise AssertionError("the command did not end with an exit code")


def refusing(error: OSError, concerns):
    """Every file that is opened for writing, and that `concerns`, is refused with an error."""
    real = {"open": io.open, "low": os.open}

    def opened(path, mode="r", *rest, **named):
        if set(mode) & set("wxa+") and concerns(str(path)):
            raise error
        return real["open"](path, mode, *rest, **named)

    def low(path, flags, *rest, **named):
        if flags & os.O_CREAT and concerns(str(path)):
            raise error
        return real["low"](path, flags, *rest, **named)

    return mock.patch.multiple("io", open=opened), mock.patch("os.open", low)


def locks_of_another_user(folder):
    """The locks of a cache cannot be opened."""
    write(folder / "head.nii.gz")
    patches = refusing(PermissionError(13, "Permission denied"), lambda path: f"{folder}/cache/locks/" in path)
    with patches[0], patches[1]:
        code, stderr = told(*command(folder))
    assert code == 0 and stderr.startswith("W602 "), stderr
    return "exit 0, the result whole, nothing kept", "W602"


def no_temporary_folder(folder):
    """A container whose root is read-only: the program `apply` has nowhere to work."""
    write(folder / "head.nii.gz")
    assert told(*command(folder))[0] == 0
    with mock.patch("tempfile.mkdtemp", side_effect=OSError(30, "Read-only file system", "/tmp/xfemnav-x")):
        code, stderr = told("apply", str(folder / "out"), str(folder / "head.nii.gz"), "-o", str(folder / "applied"))
    assert code == 73 and "E502 cannot write temporary files" in stderr and "TMPDIR" in stderr, stderr
    return "exit 73, names TMPDIR", "E502"


def stdout_full(folder):
    """`> /dev/full`: the lines are lost, the files are not."""
    write(folder / "head.nii.gz")
    assert told(*command(folder, "-o", str(folder / "spoken")))[0] == 0
    line = shlex.join([sys.executable, "-c", "from xfemnav_cli.main import main; main()", *command(folder)])
    done = subprocess.run(["sh", "-c", f"{line} > /dev/full"], capture_output=True, text=True)
    files = [{path.name: path.read_bytes() for path in (folder / name).iterdir() if "desc" in path.name}
             for name in ("out", "spoken")]
    assert done.returncode == 74 and done.stderr.startswith("E501 ") and files[0] == files[1] and files[0]
    return f"exit 74, its {len(files[0])} files as of any run", "E501"


def memory_refused(folder):
    """The system has no memory for a file's pages."""
    write(folder / "head.nii.gz")
    patches = refusing(OSError(12, "Cannot allocate memory"), lambda path: path.endswith("value.npz"))
    with patches[0], patches[1]:
        code, stderr = told(*command(folder))
    assert code == 71 and stderr.startswith("E800 "), stderr
    return "exit 71", "E800"


def signal_in_a_callback(folder):
    """SIGTERM comes while a weak reference is called back, where an exception would be lost."""
    class Thing:
        """Something that goes."""

    def facts(value, params, inputs):
        thing = Thing()
        reference = weakref.ref(thing, lambda _: os.kill(os.getpid(), signal.SIGTERM))
        del thing
        assert reference() is None
        return real(value, params, inputs)

    real = stage_mesh.facts
    write(folder / "head.nii.gz")
    with mock.patch.object(stage_mesh, "facts", facts):
        code, stderr = told(*command(folder))
    record = json.loads((folder / "out" / "run.json").read_text())
    assert code == 143 == record["exit_code"] and record["status"] == "interrupted"
    assert stderr.startswith("interrupted; ")
    return "exit 143, run.json says interrupted", ""


def name_written_into_the_record(folder):
    """Somebody adds a file of his to the outputs of run.json, and runs again."""
    write(folder / "head.nii.gz")
    assert told(*command(folder))[0] == 0
    path = folder / "out" / "run.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"outputs": record["outputs"] | {"thesis": "thesis.pdf"}}))
    (folder / "out" / "thesis.pdf").write_text("mine")
    assert told(*command(folder, "--opening-mm", "3"))[0] == 0
    assert Path(folder / "out" / "thesis.pdf").read_text() == "mine"
    return "it stays: only names that a run gives are the run's", ""


ROWS = [
    Row("E3", "a cache whose locks belong to somebody else", "E900, exit 70", locks_of_another_user),
    Row("E3", "apply where no temporary folder can be made", "E900, exit 70", no_temporary_folder),
    Row("E4", "> /dev/full", "no outputs", stdout_full),
    Row("E5", "no memory while the cache is written", "E502 cannot write the cache ... None", memory_refused),
    Row("E6", "SIGTERM in a callback of a weak reference", "exit 0, later signals ignored", signal_in_a_callback),
    Row("E10", "a name added to the outputs of run.json", "the next run deleted the file",
        name_written_into_the_record),
]
