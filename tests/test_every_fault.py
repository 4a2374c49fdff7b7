"""A fault at any call that changes a file: no bug, no crash, no wrong file, and the same command ends as if nothing had
been.

`pytest -s -m slow tests/test_every_fault.py` takes every call in turn, through a library that stands between the
program and the system, and prints how many there were.
"""

import contextlib
import errno
import importlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import pytest
from faults.battery import HALF, WRITES, Battery, Fault
from faults.claims import check_left, check_said, differ, files_in, public
from faults.commands import COMMANDS, NEW, remember, write_inputs
from faults.within import Here
from numba import config
from small import xfemnav

from xfemnav.pipeline.keeping import kernels

SCRIPT = Path(__file__).parent / "faults" / "everywhere.py"
HOW = (errno.ENOSPC, errno.EIO, errno.EACCES, HALF)


def test_faults_at_60_random_calls(tmp_path, quick_folder, monkeypatch, capsys):
    """Through what stands between Python and the system, in this process."""
    rng, battery = random.Random(60), Battery(Here(quick_folder, monkeypatch))
    monkeypatch.chdir(tmp_path)
    remember(monkeypatch.setattr)
    found = [battery.undisturbed(command) for command in COMMANDS]
    for true in rng.choices(found, [len(true.calls) for true in found], k=60):
        how = rng.choice(HOW)
        numbers = [n for n, call in enumerate(true.calls, 1) if how != HALF or call.split()[0] in WRITES]
        if numbers:
            battery.fault(true, Fault(rng.choice(numbers), how))
    with capsys.disabled():
        print(dict(battery.found), end=" ")
    assert not battery.failed, "\n".join(battery.failed)
    assert {"exit 0", "exit 73", "reruns"} <= battery.found.keys()
    # 1: a file of several failed; 65: damage that was there is found.
    assert battery.found.keys() <= {"exit 0", "exit 1", "exit 65", "exit 73", "exit 74", "reruns"}


@pytest.mark.parametrize("how", [errno.ENOSPC, errno.EIO])
def test_nothing_is_taken_away_under_a_record_that_names_it(tmp_path, quick_folder, monkeypatch, how):
    """The disk is full, or broken, from one of the last calls on, as the fsync of run.json's folder."""
    battery = Battery(Here(quick_folder, monkeypatch))
    monkeypatch.chdir(tmp_path)
    remember(monkeypatch.setattr)
    true = battery.undisturbed(COMMANDS[2])
    for n in range(len(true.calls) - 6, len(true.calls) + 1):
        battery.fault(true, Fault(n, how, 1))
    assert not battery.failed and battery.found["exit 0"] < 7, battery.failed


KERNEL = """from numba import njit
@njit(cache=True)
def twice(x):
    return 2 * x
"""


@pytest.mark.slow  # it wants a process in which no command has settled where kernels are kept
@pytest.mark.parametrize("call", ["open", "replace"])
def test_a_kernel_that_cannot_be_kept_ends_nothing(tmp_path, monkeypatch, call):
    """The disk of compiled kernels is full: they are compiled anew in the next run."""
    from numba.core import caching

    def full(path, mode="w", *_):
        if mode == "rb":
            return open(path, mode)
        raise OSError(errno.ENOSPC, "No space left on device")

    def compiled(name):
        (tmp_path / f"{name}.py").write_text(KERNEL)
        return importlib.import_module(name).twice(4)

    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "kernels"))
    plain = contextlib.contextmanager(lambda cache: (yield))
    monkeypatch.setattr(caching.Cache, "_guard_against_spurious_io_errors", plain)  # numba's own
    with monkeypatch.context() as patched:
        patched.setattr(*((caching, call) if call == "open" else (os, call)), full, raising=False)
        with pytest.raises(OSError, match="No space"):
            compiled(f"first_{call}")
        kernels.spare_the_run()
        assert compiled(f"second_{call}") == 8
    assert compiled(f"third_{call}") == 8 and list(tmp_path.glob("kernels/**/third*.nbc"))


@pytest.fixture(scope="session")
def shim(tmp_path_factory):
    """The library that stands between the program and the system; where nothing can build it, there is none."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) to build the shim with")
    built = tmp_path_factory.mktemp("shim") / "shim.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", built, SCRIPT.with_name("shim.c"), "-ldl"], check=True)
    return built


@pytest.fixture
def quick_folder(tmp_path):
    """A folder in memory where there is one: an fsync on a disk takes longer than all else."""
    memory = Path("/dev/shm")
    if not os.access(memory, os.W_OK):
        yield tmp_path / "bench"
        return
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        yield Path(folder) / "bench"


@pytest.mark.slow
@pytest.mark.parametrize("how", ["ENOSPC", "EIO", "EACCES", "half", "kill", "ENOSPC on", "EIO on"])
def test_a_fault_at_every_call(shim, how, quick_folder, capsys):
    """Each in turn: the disk is full, broken or closed, once or from then on; half is written; the process dies."""
    done = subprocess.run([sys.executable, SCRIPT, shim, how, quick_folder], capture_output=True, text=True,
                          env=os.environ | {"LD_PRELOAD": str(shim)})
    with capsys.disabled():
        print("\n" + "\n".join(line for line in done.stdout.splitlines() if " calls " in line or " faults: " in line))
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]


@contextlib.contextmanager
def small_disk(place: Path, options: str):
    """A file system in memory at `place`, as large as the `options` of mount say."""
    place.mkdir(exist_ok=True)
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", place], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"nothing can be mounted here: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", place], check=True)


#: Sizes of a file system up to one on which the command has room, and numbers of files up to those that it makes.
SIZES = [*(f"size={size}k" for size in range(8, 1024, 64)), *(f"size={size}k" for size in range(1024, 5121, 512)),
         *(f"size=16m,nr_inodes={number}" for number in range(2, 80, 6))]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("mount") is None, reason="there is no mount")
@pytest.mark.parametrize("full", ["out", "cache", "both"])
def test_a_full_file_system(tmp_path, monkeypatch, capfd, full):
    """A real one, of 8 kB up to 1 MB and more, or with room for few files: E501 or the whole result, and once there is
    room the same command leaves the right bytes."""
    remember(monkeypatch.setattr)
    monkeypatch.chdir(tmp_path)
    write_inputs(tmp_path)
    disk, found = tmp_path / "disk", Counter()
    folders = {name: (disk if full in (name, "both") else tmp_path / "room") / name for name in ("out", "cache")}
    arguments = [*NEW.arguments, "-o", folders["out"], "-w", folders["cache"]]
    with small_disk(disk, "size=64m"):
        assert xfemnav(capfd, *arguments)[0] == 0
        made = public(files_in(folders["out"]))
    for options in SIZES:
        shutil.rmtree(tmp_path / "room" / "out", ignore_errors=True)
        with small_disk(disk, options):
            code, stdout, stderr = xfemnav(capfd, *arguments)
            check_said(code, stdout, stderr, {0, 74})
            check_left(folders["out"], {}, made, code)
            found[code] += 1
            subprocess.run(["mount", "-o", "remount,size=64m,nr_inodes=10000", disk], check=True)
            assert xfemnav(capfd, *arguments)[0] == 0 and not differ(public(files_in(folders["out"])), made)
            assert not list(folders["out"].glob(".*"))
    with capfd.disabled():
        print(f"\n{full} on a full file system, {len(SIZES)} sizes: {dict(found)}")
    assert found.keys() == {0, 74}
