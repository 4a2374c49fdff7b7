"""Signals: whenever SIGINT, SIGTERM or SIGHUP comes, a command ends with the signal's own status, in one line.

The status is 0 only where the result was whole already, and the same command goes on to the same bytes. A program that
uses the package as a library keeps its own handlers. `pytest -m slow tests/test_signals.py` sends 200 in one process,
and 200 to fresh ones.
"""

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
import weakref

import pytest
from faults.claims import RECORD, check_left, differ, files_in, public
from small import CUT, OPEN, QUICK, write, xfemnav
from test_batch import batch, write_slice

import xfemnav as package
from xfemnav import interruption

SIGNALS = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
BEGUN = "from xfemnav_cli.main import main, note_signals; note_signals(); print('main', flush=True); main()"


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The folder of a small head, which is the current one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XFEMNAV_CACHE", str(tmp_path / "cache"))
    write(tmp_path / "head.nii.gz")
    return tmp_path


def command(*more):
    return ["run", "head.nii.gz", *QUICK, "--cut", CUT, *OPEN, "-o", "out", *more]


def fresh(*arguments, **options):
    """A process of its own that has begun its main."""
    process = subprocess.Popen([sys.executable, "-c", BEGUN, *arguments], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True, **options)
    assert process.stdout.readline() == "main\n"
    return process


def undisturbed(home, capfd):
    """Public files of the command without a signal; they are taken away."""
    assert xfemnav(capfd, *command("--force"))[0] == 0
    made = public(files_in(home / "out"))
    for name in os.listdir(home / "out"):
        (home / "out" / name).unlink()
    return made


def ended_rightly(code, sent, home, stderr, made):
    """Ended by one of the signals `sent`, or too late for them; what is left is whole, and one line tells."""
    assert code in {SIGNALS[signum] for signum in sent} | {0}, (code, sent, stderr)
    assert not any(word in stderr for word in ("Traceback", "Exception ignored", "E900")), stderr
    assert code == 0 or sum(line.startswith("interrupted") for line in stderr.splitlines()) <= 1, stderr
    check_left(home / "out", made, made, code)


def goes_on(home, capfd, made):
    """The same command, undisturbed, leaves what it should."""
    assert xfemnav(capfd, *command())[0] == 0
    assert not differ(public(files_in(home / "out")), made) and not list((home / "out").glob(".*"))


def in_this_process(home, capfd, times, burst=1, arguments=()):
    """Runs in this process, each with `burst` signals at a random time of it; how many were ended."""
    rng, made = random.Random(2), undisturbed(home, capfd)
    start = time.perf_counter()
    xfemnav(capfd, *command("--force"))
    whole, ended = time.perf_counter() - start, 0
    for _ in range(times):
        sent, wait = rng.choices(list(SIGNALS), k=burst), rng.uniform(0, 1.2 * whole)
        thread = threading.Thread(target=send, args=(sent, wait, rng.choice((0, 0.001, 0.02))))
        handlers = [signal.signal(each, lambda *_: None) for each in SIGNALS]  # where the run has ended already
        thread.start()
        code, _, stderr = xfemnav(capfd, *command("--force"))
        thread.join()
        for each, handler in zip(SIGNALS, handlers):
            signal.signal(each, handler)
        ended_rightly(code, sent, home, stderr, made)
        ended += code != 0
    goes_on(home, capfd, made)
    return ended


def send(signals, wait, between):
    """Signals to this process, one after the other."""
    time.sleep(wait)
    for signum in signals:
        os.kill(os.getpid(), signum)
        time.sleep(between)


def in_fresh_processes(home, capfd, times, longest=2.0, burst=1, seed=3):
    """Fresh processes, each with `burst` signals at a random time after its main's first line; how many were ended."""
    rng, made, ended = random.Random(seed), undisturbed(home, capfd), 0
    for _ in range(times):
        sent, process = rng.choices(list(SIGNALS), k=burst), fresh(*command("--force"))
        time.sleep(rng.uniform(0, longest))
        for signum in sent:
            process.send_signal(signum)
            time.sleep(rng.choice((0, 0.001, 0.02)))
        _, stderr = process.communicate(timeout=120)
        ended_rightly(process.returncode, sent, home, stderr, made)
        ended += process.returncode != 0
    goes_on(home, capfd, made)
    return ended


def test_a_signal_at_any_time(home, capfd):
    assert in_this_process(home, capfd, 8)
    in_fresh_processes(home, capfd, 2)


@pytest.mark.slow
def test_200_signals_in_one_process(home, capfd):
    ended = in_this_process(home, capfd, 200)
    with capfd.disabled():
        print(f"\nof 200 runs in one process {ended} were ended, {200 - ended} were whole already")


@pytest.mark.slow
def test_200_signals_to_fresh_processes(home, capfd):
    ended = in_fresh_processes(home, capfd, 200)
    with capfd.disabled():
        print(f"\nof 200 fresh processes {ended} were ended, {200 - ended} were whole already")


def test_more_signals_while_the_first_is_dealt_with(home, capfd):
    assert in_this_process(home, capfd, 6, burst=3)
    in_fresh_processes(home, capfd, 2, burst=3)


def test_a_signal_that_is_lost_in_a_callback_is_taken_at_the_next_checkpoint(capfd):
    """Twice at once, while a weak reference is called back: the second waits for no checkpoint, and is raised there."""
    class Thing:
        """Something that goes."""

    def twice(_):
        for _ in range(2):
            signal.raise_signal(signal.SIGTERM)

    interruption.forget()
    interruption.note_signals()
    thing = Thing()
    reference = weakref.ref(thing, twice)
    del thing
    assert reference() is None
    with pytest.raises(interruption.Interrupted) as caught:
        interruption.checkpoint()
    assert caught.value.signum == signal.SIGTERM and capfd.readouterr().err == ""
    interruption.forget()


@pytest.mark.slow
def test_more_signals_100_times(home, capfd):
    in_this_process(home, capfd, 60, burst=4)
    in_fresh_processes(home, capfd, 40, burst=4)


@pytest.mark.slow
def test_a_signal_while_kernels_are_compiled(home, capfd, monkeypatch):
    """What is compiled and kept by then is whole: the next run gets the same."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(home / "kernels"))
    in_fresh_processes(home, capfd, 6, longest=30.0)


@pytest.mark.parametrize("signum, code", SIGNALS.items())
def test_a_run_that_is_ended_says_so_and_goes_on_from_there(home, capfd, signum, code):
    process = fresh(*command())
    assert process.stdout.readline().startswith("segment")
    process.send_signal(signum)
    _, stderr = process.communicate(timeout=60)
    record = json.loads((home / "out" / "run.json").read_text())
    RECORD.validate(record)
    assert process.returncode == code == record["exit_code"] and record["status"] == "interrupted"
    assert stderr.startswith("interrupted; ") and record["outputs"] == {}
    again, stdout, _ = xfemnav(capfd, *command())
    assert again == 0 and stdout.splitlines()[0].split()[1] == "cached"


@pytest.mark.parametrize("ignored", [signal.SIGHUP, signal.SIGINT])
def test_what_is_ignored_stays_ignored(home, ignored):
    """As under nohup, and in the background of a shell that has no jobs."""
    process = fresh(*command(), preexec_fn=lambda: signal.signal(ignored, signal.SIG_IGN))
    for _ in range(3):
        process.send_signal(ignored)
    assert process.stdout.readline().startswith("segment")
    process.send_signal(ignored)
    assert process.communicate(timeout=60)[1] == "" and process.returncode == 0
    process = fresh(*command("--force"), preexec_fn=lambda: signal.signal(ignored, signal.SIG_IGN))
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) == 143
    process.communicate()


def test_a_second_signal_waits_for_no_safe_point():
    interruption.note_signals()
    os.kill(os.getpid(), signal.SIGTERM)
    with pytest.raises(interruption.Interrupted, match=str(int(signal.SIGTERM))):
        os.kill(os.getpid(), signal.SIGINT)
    interruption.checkpoint()  # nothing is left
    interruption.forget()
    for _ in range(3):
        os.kill(os.getpid(), signal.SIGINT)
    interruption.checkpoint()  # the work was done


def test_a_thread_can_run_a_command(home, capfd):
    """It has no handlers, and needs none."""
    handlers, codes = [signal.getsignal(each) for each in SIGNALS], []
    thread = threading.Thread(target=lambda: codes.append(xfemnav(capfd, "schema", "run")[0]))
    thread.start()
    thread.join()
    assert codes == [0] and handlers == [signal.getsignal(each) for each in SIGNALS]


# Other commands, and none -------------------------------------------------------------------------------------------

def batch_is_ended(folder, signum, wait):
    """A batch of two at a time that a signal ends ends its runs too; the next one goes on."""
    process = batch(folder / "in", folder / "out", folder / "cache", start_new_session=True)
    time.sleep(wait)
    process.send_signal(signum)
    text = process.communicate(timeout=120)[0]
    assert process.returncode in (SIGNALS[signum], 0) and "Traceback" not in text, text
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)  # none of its processes is left
    for record in (folder / "out").glob("*/run.json"):
        RECORD.validate(json.loads(record.read_text()))


@pytest.mark.parametrize("times", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_a_signal_ends_a_batch_and_its_runs(tmp_path, times):
    (tmp_path / "in").mkdir()
    rng, stems = random.Random(4), [f"s{n}" for n in range(4)]
    for n, stem in enumerate(stems):
        write_slice(tmp_path / "in", stem, 1.0 + n)
    for n in range(times):
        batch_is_ended(tmp_path, list(SIGNALS)[n % 3], rng.uniform(0.5, 4.0))
    process = batch(tmp_path / "in", tmp_path / "out", tmp_path / "cache")
    text = process.communicate(timeout=300)[0]
    assert process.returncode == 0 and "4 updated" in text, text


@pytest.mark.parametrize("times", [3, pytest.param(40, marks=pytest.mark.slow)])
def test_a_signal_ends_apply_with_whole_files(home, capfd, times):
    assert xfemnav(capfd, *command())[0] == 0
    files = [write(home / f"t{n}.nii.gz").name for n in range(8)]
    arguments = ["apply", "out", *files, "-o", "applied", "--force"]
    assert xfemnav(capfd, *arguments)[0] == 0
    made, rng = files_in(home / "applied"), random.Random(6)
    for n in range(times):
        signum, process = list(SIGNALS)[n % 3], fresh(*arguments)
        time.sleep(rng.uniform(0, 1.5))
        process.send_signal(signum)
        _, stderr = process.communicate(timeout=60)
        assert process.returncode in (SIGNALS[signum], 0) and "Traceback" not in stderr, stderr
        assert files_in(home / "applied") == made


def test_a_program_that_uses_the_library_keeps_its_handlers(home):
    """Ctrl-C is KeyboardInterrupt there, and nothing of ours remains."""
    def runs():
        for n in range(1000):
            package.run(home / "head.nii.gz", cut=CUT, opening_mm=4, element_size_mm=8, corridor_element_mm=4,
                        output=home / "out", report=False, force=n > 0)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    handlers = [signal.getsignal(each) for each in SIGNALS]
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            runs()
        assert handlers == [signal.getsignal(each) for each in SIGNALS]
    finally:
        signal.signal(signal.SIGINT, before)
    record = json.loads((home / "out" / "run.json").read_text())
    assert record["status"] in ("interrupted", "complete")
