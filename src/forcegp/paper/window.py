"""Figures 4 and 5: predictions of every model over the same few seconds."""

from __future__ import annotations

import torch

from forcegp.data import Dataset
from forcegp.models.base import Model
from forcegp.report.data import WindowData, columns, series


def opening(data: Dataset, seconds: float) -> Dataset:
    """The first seconds of the first trajectory of a data set, in order of time."""
    own = (data.segment == data.segment[0]).nonzero()[:, 0]
    own = own[data.t[own].argsort()]
    return data[own[data.t[own] <= data.t[own[0]] + seconds]]


@torch.no_grad()
def predicted_window(model: Model, data: Dataset, name: str) -> WindowData:
    """Mean and standard deviation of the accelerations at the samples of a window.

    Args:
        model: a fitted model.
        data: the window, in order of time.
        name: of the model, for the figure.
    """
    active = data.active(model.system.contact_names)
    predicted = model.predict(data.q, data.qd, data.tau, active=active)
    clean = data.extras.get("qdd_clean")
    return WindowData(
        model=name,
        noise_std=data.header.noise_std,
        t=series(data.t),
        joint_names=list(data.joint_names),
        measured=columns(data.qdd),
        clean=None if clean is None else columns(clean),
        mean=columns(predicted.mean),
        std=None if predicted.std is None else columns(predicted.std),
    )
