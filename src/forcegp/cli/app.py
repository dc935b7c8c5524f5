"""The application with all commands. Invalid input causes one message on stderr and exit code 2."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings

import typer
from typer import Option

from forcegp.cli.command import keeping_inputs
from forcegp.cli.common import say, warn
from forcegp.cli.evaluate import evaluate
from forcegp.cli.excite import excite
from forcegp.cli.export import export
from forcegp.cli.fit import fit, sweep
from forcegp.cli.logs import check, import_, select
from forcegp.cli.predict import predict
from forcegp.cli.rollout import rollout, simulate
from forcegp.cli.view import view
from forcegp.errors import ForceGPError

USER_ERROR = 2
"""Exit code for invalid input, which is also the code for an invalid option."""
INTERRUPTED = 130
"""Exit code after an interrupt (SIGINT), as in a shell."""
GRACE = 0.6
"""Time allowed for an orderly exit after an interrupt [s]."""

app = typer.Typer(
    name="forcegp",
    help="Learn the forward dynamics of robot arms, free or in contact, with Gaussian-process force priors.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
for command in (simulate, check, select, fit, predict, evaluate, rollout, export, excite, sweep, view):
    app.command()(keeping_inputs(command))
app.command("import")(keeping_inputs(import_))


def _version(wanted: bool) -> bool:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"forcegp {version('forcegp')}")
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    version: bool = Option(
        False, "--version", callback=_version, is_eager=True, help="Show the version and exit."
    ),
) -> None:
    """Handle global options."""


def main(program: typer.Typer = app) -> None:
    """Run a command line. Exit with one message and code 2 on a user error, and with 130 on an interrupt.

    Temporary files that remain after an interrupt are removed by the next run, as after a crash.
    """
    _end_when_interrupted()
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: warn(message)
        try:
            program()
        except ForceGPError as error:
            _fail(str(error))
        except OSError as error:
            name = f"{error.filename}: " if error.filename else ""
            _fail(f"{name}{error.strerror or error}")
        except SystemExit as ended:
            if ended.code == INTERRUPTED:
                os._exit(INTERRUPTED)  # shutting down PyTorch would take longer than `GRACE`
            raise


def _end_when_interrupted() -> None:
    """Exit on an interrupt, after at most `GRACE` seconds.

    Python handles signals only between its own operations, not during long operations of other libraries. It
    also loses exceptions raised in destructors. The file descriptor receives the signal immediately.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return  # ignored, as in a background job, or handled by the caller
    wake, signals = os.pipe()
    os.set_blocking(signals, False)
    signal.set_wakeup_fd(signals, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, lambda *_: sys.exit(INTERRUPTED))

    def watch() -> None:
        while os.read(wake, 1) != bytes([signal.SIGINT]):
            pass
        time.sleep(GRACE)
        for worker in multiprocessing.active_children():
            worker.kill()
            worker.join(GRACE)
        if sys.stderr.isatty():
            os.write(2, b"\x1b[?25h")  # a progress bar hides the cursor
        os._exit(INTERRUPTED)

    threading.Thread(target=watch, daemon=True).start()


def _fail(message: str) -> None:
    say(message, "error: ", indent=4, err=True, fg="red", bold=True)
    sys.exit(USER_ERROR)
