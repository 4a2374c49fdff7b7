"""The `xfemnav` command: commands by name, errors as one line with a code, exit codes as documented."""

import atexit
import gc
import sys
import traceback

import click

from xfemnav import __version__
from xfemnav.errors import EXIT_BUG, EXIT_DATA, EXIT_USAGE, FAULTS, XfemnavError
from xfemnav_cli import batch, run, tools
from xfemnav_cli.telling import complain, printable


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="xfemnav")
def cli():
    """Update a preoperative brain slice after cuts and retractions, with the extended finite element method.

    Research software: not a medical device.
    """


for command in (run.run, *run.stage_commands, run.demo, batch.batch, tools.check, tools.schema, tools.apply,
                tools.doctor, tools.cache):
    cli.add_command(command)


def main(argv: list[str] | None = None) -> None:
    """Run the command line and leave the process with its exit code."""
    # Imports make hundreds of thousands of objects that stay: searching them for cycles again and again costs .2 s,
    # and once more when the interpreter ends as much again.
    gc.set_threshold(100_000)
    atexit.register(gc.freeze)
    argv = sys.argv[1:] if argv is None else argv
    traced = "-vv" in argv
    try:
        code = cli.main(argv, prog_name="xfemnav", standalone_mode=False) or 0
    except click.UsageError as error:
        error.show()
        code = EXIT_USAGE
    except click.ClickException as error:
        complain(error.format_message())
        code = EXIT_USAGE
    except XfemnavError as error:
        if traced:
            traceback.print_exc()
        complain(str(error))
        code = error.exit_code or EXIT_DATA
    except (KeyboardInterrupt, click.Abort):
        code = 130
    except MemoryError as error:
        complain(f"E800 not enough memory ({error}): use larger elements (--element-size-mm), a smaller image, or a "
                 "machine with more memory.")
        code = FAULTS["E800"].exit_code
    except Exception as error:  # the last resort: what gets here is a bug, and is told as one
        if traced:
            traceback.print_exc()
        complain(f"E900 this is a bug in xfemnav: {printable(f'{type(error).__name__}: {error}')}. "
                 "Run the same command with -vv and report what it prints.")
        code = EXIT_BUG
    sys.exit(code)
