"""Plots of predictions: mean and band of ±2 standard deviations, beside what was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from matplotlib.axes import Axes
from torch import Tensor

from forcegp.data import Dataset
from forcegp.errors import ShapeError
from forcegp.models.measured import Predicts, component_names, measured_if_logged, predicted
from forcegp.plots import (
    MEASURED,
    PREDICTED,
    Curve,
    Panel,
    Target,
    Timeline,
    axis_label,
    chosen,
    draw_panels,
)

MOST_SAMPLES = 2000
"""Samples that are predicted and drawn: more cannot be told apart."""


def plot_model(
    model: Predicts,
    data: Dataset,
    quantity: str,
    joints: Sequence[str] | None,
    ax: Target,
    settings: Mapping[str, Any],
) -> list[Axes]:
    """Draw predictions at logged states; `Predictor.plot` documents the arguments."""
    system = settings.get("system") or model.system
    data.check_robot((settings.get("system") or getattr(model, "specified", system)).robot)
    data = data[:: max(1, -(-len(data) // MOST_SAMPLES))]
    found = predicted(model, data, quantity, **settings)
    names, kinds = component_names(system, quantity), system.robot.joint_types
    true, std = measured_if_logged(system, data, quantity), found.std
    of_joints = names == list(system.robot.joint_names)
    panels = [
        Panel(
            names[i],
            axis_label(quantity, kinds[i : i + 1] if of_joints else ()),
            _curves(
                None if true is None else true[:, i], found.mean[:, i], None if std is None else std[:, i]
            ),
        )
        for i in chosen(joints, names, f"component of {quantity}")
    ]
    time = Timeline.of(data.t, data.segment, data.header.ordered)
    return draw_panels(panels, time, [data.contact[c] for c in system.contact_names], ax)


def plot_prediction(
    mean: Tensor,
    std: Tensor | None,
    quantities: Sequence[str],
    t: Tensor | None,
    measured: Tensor | None,
    names: Sequence[str] | None,
    ax: Target,
) -> list[Axes]:
    """Draw a prediction by itself; `Prediction.plot` documents the arguments."""
    if mean.ndim != 2:
        raise ShapeError(
            "only predictions over one list of states can be drawn",
            expected="a mean of shape (n, d)",
            got=tuple(mean.shape),
        )
    n, d = mean.shape
    quantity = quantities[0] if len(quantities) == 1 else ""
    names = [f"component {i + 1}" for i in range(d)] if names is None else list(names)
    for what, value, expected in (
        ("t", None if t is None else tuple(t.shape), (n,)),
        ("measured", None if measured is None else tuple(measured.shape), (n, d)),
        ("names", (len(names),), (d,)),
    ):
        if value is not None and value != expected:
            raise ShapeError(f"{what} does not fit the prediction", expected=expected, got=value)
    panels = [
        Panel(
            names[i],
            axis_label(quantity),
            _curves(
                None if measured is None else measured[:, i], mean[:, i], None if std is None else std[:, i]
            ),
        )
        for i in range(d)
    ]
    axes = draw_panels(panels, Timeline.of(torch.arange(n) if t is None else t), (), ax)
    if t is None:
        axes[-1].set_xlabel("sample")
    return axes


def _curves(true: Tensor | None, mean: Tensor, std: Tensor | None) -> list[Curve]:
    known = [] if true is None else [Curve(true, "measured", MEASURED, width=0.7)]
    return [*known, Curve(mean, "predicted", PREDICTED, std)]
