"""Reading independent Gaussian processes."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ForceGPError, ModelError
from forcegp.models.independent_gp import (
    IndependentFit,
    IndependentSettings,
    IndependentTraining,
    announce,
    fitted,
    joint_processes,
    scale_of,
)
from forcegp.storage.model_file import ModelHeader, settings_of
from forcegp.storage.system import take


def load_independent(
    header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
) -> IndependentFit:
    """The model that `IndependentFit.save` wrote."""
    settings = settings_of(header, IndependentSettings, source)
    nq, dtype = system.robot.nq, system.robot.dtype
    n = next(iter(take(tensors, "training.q", None, dtype, source).shape), 0)
    features = {
        name: take(tensors, f"training.{name}", (n, nq), dtype, source) for name in ("q", "qd", "tau")
    }
    noise = take(tensors, "training.noise_std", None, dtype, source)
    if noise.shape not in ((nq,), (n, nq)) or not bool((noise > 0.0).all()):
        raise ModelError(f"{source}: tensor 'training.noise_std' is not valid", expected="positive numbers")
    qdd = take(tensors, "training.qdd", (n, nq), dtype, source)
    training = IndependentTraining(features, qdd, noise, scale_of(features, settings.standardize))
    hyperparameters = {
        f"{prior.name}.{name}": take(
            tensors, f"hyperparameters.{prior.name}.{name}", tuple(value.shape), torch.float64, source
        )
        for prior in joint_processes(nq)
        for name, value in prior.kernel.initial(1, dict.fromkeys(features, nq)).items()
    }
    announce(training, 0)
    try:
        return fitted(system, settings.noise_std, training, hyperparameters, standardize=settings.standardize)
    except ForceGPError as cause:
        raise ModelError.at(f"{source}: the training data", cause) from cause
