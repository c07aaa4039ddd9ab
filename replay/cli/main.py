"""The entry point: the commands, and what becomes of their errors.

Exit codes: 0 done; 1 the job ran and the answer is no; 2 bad input, with one line on stderr; 70 a fault of the
program itself; 130 interrupted.
"""

import sys
from collections.abc import Sequence

import click

from replay.cli.balance import balance
from replay.cli.bridge import bridge
from replay.cli.calibrate import calibrate
from replay.cli.check_effect import check_effect
from replay.cli.close_loop import close_loop
from replay.cli.convert import convert
from replay.cli.correlate import correlate
from replay.cli.demo import demo
from replay.cli.export import export
from replay.cli.forecast import forecast
from replay.cli.import_model import import_model
from replay.cli.keep import backup, migrate, migrate_store, restore
from replay.cli.newcomers import check, init, show
from replay.cli.play import replay
from replay.cli.printing import print_page
from replay.cli.record import record
from replay.cli.register import register
from replay.cli.serve import serve
from replay.cli.simulate import simulate
from replay.cli.worker import worker
from replay.errors import ReplayError
from twin_core import __version__
from twin_core.errors import NoSolutionError, TwinError

ANSWER_IS_NO, BAD_INPUT, INTERNAL, INTERRUPTED = 1, 2, 70, 130


@click.group(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="\b\nExample:\n  twin demo --out demo-out",
)
@click.version_option(__version__, prog_name="twin", message="%(prog)s %(version)s")
@click.option("--traceback", is_flag=True, help="Show where an error arose, for reports of faults of the program.")
def twin(traceback: bool) -> None:
    """A digital twin of a spacecraft's temperatures that finds what its model lacks.

    \b
    Exit codes:
      0    done
      1    the job ran and the answer is no: demo did not find the hidden
           effect, check found faults, the model has no solution, or a
           service refused samples
      2    bad input: one line on stderr says what is wrong and what to do
      70   a fault of the program: run twin --traceback, and report it
      130  interrupted
    """


for command in (
    *(init, check, balance, show, print_page, export),
    *(
        demo,
        serve,
        register,
        simulate,
        replay,
        record,
        import_model,
        convert,
        calibrate,
        correlate,
        forecast,
        close_loop,
        check_effect,
    ),
    *(bridge, backup, restore, migrate, migrate_store, worker),
):
    twin.add_command(command)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; ``argv`` replaces the process's own arguments."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return int(twin.main(args=arguments or ["--help"], prog_name="twin", standalone_mode=False) or 0)
    except (click.Abort, KeyboardInterrupt):
        return _say("interrupted", INTERRUPTED)
    except BrokenPipeError:  # the reader of stdout, such as head, has seen enough
        sys.stderr.close()
        return INTERRUPTED
    except Exception as error:
        if "--traceback" in arguments:
            raise
        return _explain(error)


def _explain(error: Exception) -> int:
    """Say in one line what is wrong, the first fault in front, and return the exit code."""
    if isinstance(error, click.UsageError):
        command = error.ctx.command_path if error.ctx else "twin"
        return _say(f"{error.format_message().rstrip('.')}; see {command} --help", BAD_INPUT)
    if isinstance(error, click.ClickException):
        return _say(error.format_message(), BAD_INPUT)
    if isinstance(error, NoSolutionError):
        return _say(str(error), ANSWER_IS_NO)
    if isinstance(error, TwinError | ReplayError):
        also = "; ".join(getattr(error, "problems", ())[1:])
        return _say(f"{error}; also: {also}" if also else str(error), BAD_INPUT)
    plugins = sys.modules.get("twin_core.effects.plugins")
    if plugins is not None and (line := plugins.fault_of_a_file(error)) is not None:
        return _say(line, BAD_INPUT)
    return _say(
        f"a fault of the program: {type(error).__name__}: {error}; run twin --traceback and report it", INTERNAL
    )


def _say(message: str, code: int) -> int:
    print(f"twin: {' '.join(message.split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
