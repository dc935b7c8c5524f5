"""`forcegp predict`: a quantity at logged states, with its standard deviation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from forcegp.cli.common import (
    AsJson,
    DataFile,
    ModelFolder,
    check_data_destination,
    data_of_robot,
    progress_bar,
    read_data,
    show,
)

if TYPE_CHECKING:
    from torch import Tensor

    from forcegp.constraints import ConstrainedSystem
    from forcegp.data import Dataset

CHUNK = 2000
"""States predicted at once: bounds the memory, and moves the progress bar."""
PER_CONTACT = ("multiplier", "contact_force")
"""Quantities with one value or one vector per contact; the others have one component per joint."""


def predict(
    model: ModelFolder,
    data: DataFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="Where the predictions go (.parquet).")],
    quantity: Annotated[
        str,
        typer.Option(
            "--quantity",
            "-q",
            help="qdd, qdd_free, multiplier, constraint_force, contact_force, total_force, joint_force or "
            "contact_friction.",
        ),
    ] = "qdd",
    as_json: AsJson = False,
) -> None:
    """Predict a quantity at the states of a data set.

    The output is the data set with the columns predicted_<quantity> and, for models that know their
    uncertainty, predicted_<quantity>_std (without measurement noise).

    [bold]Examples[/bold]

    forcegp predict --model model/ --data test.parquet --out predicted.parquet

    forcegp predict -m model/ -d test.parquet --quantity multiplier -o force.parquet
    """
    import torch

    from forcegp.destination import write_or_keep
    from forcegp.models.load import load_model

    check_data_destination(out, data)
    regression = load_model(model)
    test = data_of_robot(read_data(data), regression.system.robot)
    active = test.active(regression.system.contact_names)
    means: list[Tensor] = []
    stds: list[Tensor] = []
    with progress_bar(f"predicting {quantity}", len(test)) as progress:
        for first in range(0, len(test), CHUNK):
            rows = slice(first, first + CHUNK)
            part = regression.predict(
                test.q[rows], test.qd[rows], test.tau[rows], quantity, active=active[rows]
            )
            means.append(part.mean)
            stds += [part.std] if part.std is not None else []
            progress(min(first + CHUNK, len(test)))
    test = _with_columns(test, regression.system, quantity, f"predicted_{quantity}", torch.cat(means))
    if stds:
        name = f"predicted_{quantity}_std"
        test = _with_columns(test, regression.system, quantity, name, torch.cat(stds))
    write_or_keep(test.with_step(f"predicted {quantity} by the model in {model}").write, out)
    show({"quantity": quantity, "samples": len(test), "uncertainty": bool(stds), "file": str(out)}, as_json)


def _with_columns(
    data: Dataset, system: ConstrainedSystem, quantity: str, name: str, values: Tensor
) -> Dataset:
    """The data set with a predicted quantity among its logged ones."""
    if quantity not in PER_CONTACT:
        return data.replace(extras={**data.extras, name: values})
    sizes = _components(system, quantity)
    named = {
        contact: part[:, 0] if part.shape[-1] == 1 else part
        for contact, part in zip(sizes, values.split(list(sizes.values()), dim=-1), strict=True)
    }
    return data.replace(contact_extras={**data.contact_extras, name: named})


def _components(system: ConstrainedSystem, quantity: str) -> dict[str, int]:
    """Number of components by contact: rows of a multiplier, or a Cartesian force where there is a
    surface."""
    from forcegp.constraints import SurfaceContact

    if quantity == "multiplier":
        return {contact.name: contact.rows for contact in system.contacts}
    return {contact.name: 3 for contact in system.contacts if isinstance(contact, SurfaceContact)}
