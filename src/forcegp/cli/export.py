"""`forcegp export`: a fitted model as source code of a controller."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from forcegp.cli.common import show
from forcegp.cli.options import AsJson, ModelFile


def export(
    model: ModelFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the code, its test and a README.")],
    to: Annotated[str, typer.Option("--to", help="Language: c.")] = "c",
    name: Annotated[str, typer.Option(help="Name of the files, and prefix of the functions.")] = "controller",
    functions: Annotated[
        int | None,
        typer.Option(min=1, help="Reduce the covariance to so many functions, which only widens it."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a structured Gaussian process as C99 that needs libm alone, for a control loop.

    Beside one .h and one .c file: a test program with reference values, CMakeLists.txt and a README.

    [bold]Example[/bold]

    forcegp export -m model --functions 100 --name arm -o controller/
    """
    from forcegp.errors import ModelError
    from forcegp.models.load import load_model
    from forcegp.models.structured_fit import StructuredFit

    fit = load_model(model)
    if not isinstance(fit, StructuredFit):
        raise ModelError("only a structured Gaussian process has a C form", expected="sgp", got=fit.kind)
    written = fit.export(out, language=to, name=name, functions=functions)
    lost = {"widest": written.widest, "wider": written.wider} if functions is not None else {}
    show({"folder": str(out), "functions": written.functions, **lost}, as_json)
