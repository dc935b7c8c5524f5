"""Figures 4 and 5: predictions of every model over the same few seconds."""

from __future__ import annotations

import torch

from forcegp.data import Dataset
from forcegp.models.base import Model
from forcegp.report.data import WindowData, columns, series


@torch.no_grad()
def predicted_window(
    model: Model, data: Dataset, *, name: str, training_points: int, noise_std: float, held_out: bool
) -> WindowData:
    """Mean and standard deviation of the accelerations at the samples of a window.

    Args:
        model: a fitted model.
        data: the window, in order of time.
        name: of the model, for the figure.
        training_points: what it learned from.
        noise_std: of the measured accelerations [rad/s²].
        held_out: whether no training point comes from the window.
    """
    active = data.active(model.system.contact_names)
    predicted = model.predict(data.q, data.qd, data.tau, active=active)
    clean = data.extras.get("qdd_clean")
    return WindowData(
        model=name,
        training_points=training_points,
        held_out=held_out,
        noise_std=noise_std,
        t=series(data.t),
        joint_names=list(data.joint_names),
        measured=columns(data.qdd),
        clean=None if clean is None else columns(clean),
        mean=columns(predicted.mean),
        std=None if predicted.std is None else columns(predicted.std),
    )
