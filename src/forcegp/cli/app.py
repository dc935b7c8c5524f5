"""The commands together, and what becomes of an error: one message on stderr, exit code 2, no traceback."""

from __future__ import annotations

import sys
import warnings

import typer

from forcegp.cli.evaluate import evaluate
from forcegp.cli.export import export
from forcegp.cli.fit import fit, sweep
from forcegp.cli.logs import check, import_, select
from forcegp.cli.predict import predict
from forcegp.cli.rollout import rollout, simulate
from forcegp.cli.view import view
from forcegp.errors import ForceGPError

USER_ERROR = 2
"""Exit code where the input is at fault, the same as for a wrong option."""

app = typer.Typer(
    name="forcegp",
    help="Learn the forward dynamics of robot arms, free or in contact, with Gaussian-process force priors.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
for command in (simulate, check, select, fit, predict, evaluate, rollout, export, sweep, view):
    app.command()(command)
app.command("import")(import_)


def _version(wanted: bool) -> bool:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"forcegp {version('forcegp')}")
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Say which version."
    ),
) -> None:
    """Options of the program as a whole."""


def main(program: typer.Typer = app) -> None:
    """Run a command line; errors that a user can cause end in one message and exit code 2."""
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            program()
        except ForceGPError as error:
            _fail(str(error))
        except OSError as error:
            name = f"{error.filename}: " if error.filename else ""
            _fail(f"{name}{error.strerror or error}")


def _fail(message: str) -> None:
    typer.secho("error: ", fg="red", bold=True, nl=False, err=True)
    typer.echo(message, err=True)
    sys.exit(USER_ERROR)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    typer.secho("warning: ", fg="yellow", nl=False, err=True)
    typer.echo(str(message), err=True)
