"""The application with all commands. Invalid input causes one message on stderr and exit code 2."""

from __future__ import annotations

import sys
import warnings
from functools import cache

import typer
from typer import Option

import forcegp
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
from forcegp.interrupt import end, end_when_interrupted, was_interrupted

USER_ERROR = 2
"""Exit code for invalid input, which is also the code for an invalid option."""

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
        typer.echo(f"forcegp {forcegp.__version__}")
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
    end_when_interrupted()
    once = cache(warn)  # several steps of a command give the same warning
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: once(str(message))
        try:
            program()
        except BaseException as error:
            if was_interrupted():
                end()  # shutting down PyTorch would take longer than the time allowed
            if isinstance(error, ForceGPError):
                _fail(str(error))
            if isinstance(error, OSError):
                name = f"{error.filename}: " if error.filename else ""
                _fail(f"{name}{error.strerror or error}")
            raise


def _fail(message: str) -> None:
    say(message, "error: ", indent=4, err=True, fg="red", bold=True)
    sys.exit(USER_ERROR)
