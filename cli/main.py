"""The `xfemnav` command: commands by name, errors as one line with a code, exit codes as documented."""

import atexit
import errno
import gc
import io
import logging
import os
import sys
import traceback
import warnings

import click

from xfemnav import __version__
from xfemnav.errors import (
    EXIT_BUG,
    EXIT_DATA,
    EXIT_OK,
    EXIT_UNTRUSTED,
    EXIT_USAGE,
    FAULTS,
    XfemnavError,
    XfemnavWarning,
)
from xfemnav.interruption import Interrupted, checkpoint, forget, note_signals
from xfemnav_cli import batch, example, run, telling, tools
from xfemnav_cli.telling import FLAGS, complain, printable


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="xfemnav")
def cli():
    """Update a preoperative brain slice after cuts and retractions, with the extended finite element method.

    Research software: not a medical device.
    """


for command in (run.run, *run.stage_commands, run.demo, batch.batch, example.example, tools.check, tools.schema,
                tools.apply, tools.doctor, tools.cache):
    cli.add_command(command)


def main(argv: list[str] | None = None) -> None:
    """Run the command line and leave the process with its exit code."""
    note_signals()
    try:
        _settle()
        code = _outcome(sys.argv[1:] if argv is None else argv)
    except Interrupted as error:  # also a second one, while something is told
        forget()
        complain("interrupted.")
        code = 128 + error.signum
    forget()
    if telling.refused and code in (EXIT_OK, EXIT_UNTRUSTED):
        complain(f"E501 standard output cannot be written: {telling.refused[0]}. Files that were made are complete.")
        code = FAULTS["E501"].exit_code
    sys.exit(code)


def _settle() -> None:
    """Make the process one that only runs a command."""
    _open_standard_streams()
    # Imports make hundreds of thousands of objects that stay: searching them for cycles again and again costs .2 s,
    # and once more when the interpreter ends as much again.
    gc.set_threshold(100_000)
    atexit.register(gc.freeze)


def _outcome(argv: list[str]) -> int:
    """The exit code of a command; what has failed is told. Raises Interrupted."""
    traced = "-vv" in argv
    if not traced and not sys.warnoptions:
        warnings.simplefilter("ignore")  # what a library doubts is said with a code, or means nothing here
        warnings.simplefilter("default", XfemnavWarning)
        logging.disable()
    try:
        code = cli.main(argv, prog_name="xfemnav", standalone_mode=False) or 0
        checkpoint()
    except click.UsageError as error:
        text = io.StringIO()
        error.show(text)
        telling.put(text.getvalue().rstrip("\n"), on_stderr=True)
        code = EXIT_USAGE
    except click.ClickException as error:
        complain(error.format_message())
        code = EXIT_USAGE
    except XfemnavError as error:
        if traced:
            traceback.print_exc()
        complain(error.told(FLAGS))
        code = error.exit_code or EXIT_DATA
    except (KeyboardInterrupt, click.Abort):  # where the handlers are not ours
        code = 130
    except MemoryError as error:
        complain(f"E800 not enough memory ({error}): use larger elements (--element-size-mm), a smaller image, or a "
                 "machine with more memory.")
        code = FAULTS["E800"].exit_code
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            code = _bug(error, traced)
        else:  # a text of click's own, as --help; all else is translated where it is written
            telling.give_up(sys.stdout)
            telling.refused.append(error.strerror)
            code = EXIT_OK
    except Exception as error:
        code = _bug(error, traced)
    return code


def _bug(error: Exception, traced: bool) -> int:
    """The last resort: what nobody has foreseen is a bug, and is told as one."""
    if traced:
        traceback.print_exc()
    complain(f"E900 this is a bug in xfemnav: {printable(f'{type(error).__name__}: {error}')}. "
             "Run the same command with -vv and report what it prints.")
    return EXIT_BUG


def _open_standard_streams() -> None:
    """Give a stream that is closed /dev/null, or the next file to be opened would get its number, and its text."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
