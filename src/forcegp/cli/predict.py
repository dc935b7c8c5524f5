"""`forcegp predict`: predict a quantity at logged states, with its standard deviation."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

import forcegp
from forcegp.cli.common import (
    check_data_destination,
    numbers,
    progress_bar,
    read_data,
    save,
    show,
    warn_beyond,
    words,
)
from forcegp.cli.options import (
    ALL,
    AsJson,
    DataFile,
    Frame,
    ModelFile,
    Reference,
    WrenchAxes,
    WrenchPoint,
)
from forcegp.errors import ModelError

if TYPE_CHECKING:
    from torch import Tensor

    from forcegp.evaluation.predicted import Moments
    from forcegp.models.base import Predictor

PER_CONTACT = ("multiplier", "contact_force")
"""Quantities with one value or one vector per contact. All others have one component per joint."""
WRENCH = "external_wrench"
"""Wrench on a frame, saved as the force and moment of a contact named after the frame."""


def predict(
    model: ModelFile,
    data: DataFile,
    out: Annotated[
        Path, Option("--out", "-o", writable=True, help="Output file for the predictions (.parquet).")
    ],
    quantity: Annotated[
        str,
        Option(
            "--quantity",
            "-q",
            help="qdd, qdd_free, multiplier, constraint_force, contact_force, total_force, joint_force, "
            "joint_friction, contact_friction or external_wrench.",
        ),
    ] = "qdd",
    frame: Frame = None,
    point: WrenchPoint = "0,0,0",
    axes: WrenchAxes = ALL,
    reference: Reference = "world",
    momentum: Annotated[
        bool,
        Option(
            "--momentum", help="Estimate external_wrench with a causal filter that needs no accelerations."
        ),
    ] = False,
    noise: Annotated[
        bool,
        Option(
            "--noise/--no-noise",
            help="Whether the standard deviation is that of a measurement and includes motor-torque and "
            "sensor noise (for models with such noise).",
        ),
    ] = True,
    sensor: Annotated[
        bool,
        Option("--sensor", help="Predict λ using also the log's force sensor (fit with sensor_noise_std)."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Predict a quantity at the states of a data set.

    The output is the data set with the additional column `predicted_<quantity>` and, for models with
    uncertainty, `predicted_<quantity>_std`. The standard deviation includes the noise of the motor torque and
    of the sensor. With --no-noise (the default in Python), it excludes this noise.

    **Examples**

    forcegp predict --model model --data test.parquet --out predicted.parquet

    forcegp predict -m model -d test.parquet --quantity multiplier -o force.parquet

    forcegp predict -m model -d test.parquet -q external_wrench --frame tool -o wrench.parquet

    forcegp predict -m model -d test.parquet -q external_wrench --frame tool --point 0,0,0.1 --axes fx,fy,fz
    -o wrench.parquet
    """
    from forcegp.evaluation.predicted import in_chunks

    check_data_destination(out)
    regression = forcegp.load_model(model)
    test = read_data(data, regression.specified.robot)
    if quantity == WRENCH:
        at = {"point": numbers("point", point, 3), "axes": words(axes), "reference": reference}
        test, result = _with_wrench(regression, test, frame, at, momentum)
    elif sensor and quantity != "multiplier":
        raise ModelError("the force sensor measures the multiplier", got=quantity, hint="-q multiplier")
    else:
        with progress_bar(f"predicting {quantity}", len(test)) as progress:
            doubts: dict[str, None] = {}
            predicted = partial(_predicted, regression, doubts, quantity=quantity, noise=noise, sensor=sensor)
            mean, std = in_chunks(predicted, test, progress)
        warn_beyond(regression, test, doubts)
        test = _with_columns(test, regression.system, quantity, f"predicted_{quantity}", mean)
        if std is not None:
            test = _with_columns(test, regression.system, quantity, f"predicted_{quantity}_std", std)
        result = {"uncertainty": std is not None}
    save(test.with_step(f"predicted {quantity} by the model in {model}").write, out)
    show({"quantity": quantity, "samples": len(test), **result, "file": str(out)}, as_json)


def _predicted(
    model: Predictor, doubts: dict[str, None], part: forcegp.Dataset, quantity: str, noise: bool, sensor: bool
) -> Moments:
    """Return the mean and standard deviation of a quantity, and add warnings about it to `doubts`."""
    from forcegp.models.sensed import force_from_sensor
    from forcegp.models.structured_fit import StructuredFit

    if sensor and not isinstance(model, StructuredFit):
        raise ModelError("--sensor needs a structured Gaussian process", got=model.kind)
    if sensor:
        mean, std = force_from_sensor(model, part)  # pyright: ignore[reportArgumentType]
        return mean[:, None], std[:, None]
    states, active = (part.q, part.qd, part.tau), part.active(model.system.contact_names)
    options: dict[str, Any] = {"noise": True} if noise and isinstance(model, StructuredFit) else {}
    prediction = model.predict(*states, quantity, active=active, **options)
    doubts.update(dict.fromkeys(prediction.doubts))
    return prediction.mean, prediction.std


def _with_wrench(
    model: Predictor, test: forcegp.Dataset, frame: str | None, at: dict[str, Any], momentum: bool
) -> tuple[forcegp.Dataset, dict[str, object]]:
    """Add the wrench on a frame and the detected contact, named after the frame, and return a summary too."""
    import torch

    from forcegp.forces.external_wrench import AXES
    from forcegp.models.structured_fit import StructuredFit

    if not isinstance(model, StructuredFit):
        raise ModelError("an external wrench needs a structured Gaussian process", got=model.kind)
    if frame is None:
        names = ", ".join(model.system.robot.frame_names)
        raise ModelError("an external wrench acts on a frame", expected=f"--frame, one of {names}")
    method = "momentum" if momentum else "acceleration"
    wrench = model.external_wrench(test, frame, method=method, **at)
    assert wrench.std is not None
    places = [AXES.index(axis) for axis in at["axes"]]
    detected, columns = wrench.detect(), {}
    for ending, values in (("", wrench.mean), ("_std", wrench.std)):
        whole = values.new_zeros(len(values), len(AXES)).index_copy(1, torch.tensor(places), values)
        for part, component in zip(("force", "moment"), whole.split(3, dim=1), strict=True):
            columns[f"predicted_external_{part}{ending}"] = {frame: component}
    contact = {**test.contact, frame: test.contact.get(frame, detected)}
    test = test.replace(contact=contact, contact_extras={**test.contact_extras, **columns})
    return test, {"frame": frame, "detected": float(detected.double().mean())}


def _with_columns(
    data: forcegp.Dataset, system: forcegp.ConstrainedSystem, quantity: str, name: str, values: Tensor
) -> forcegp.Dataset:
    """Add a predicted quantity to the logged quantities."""
    if quantity not in PER_CONTACT:
        return data.replace(extras={**data.extras, name: values})
    if quantity == "multiplier":
        sizes = {contact.name: contact.rows for contact in system.contacts}
    else:
        sizes = {c.name: 3 for c in system.contacts if isinstance(c, forcegp.SurfaceContact)}
    parts = zip(sizes, values.split(list(sizes.values()), dim=-1), strict=True)
    named = {contact: part[:, 0] if part.shape[-1] == 1 else part for contact, part in parts}
    return data.replace(contact_extras={**data.contact_extras, name: named})
