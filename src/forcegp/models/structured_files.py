"""Reading structured Gaussian processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.mean import AnalyticalMean
from forcegp.forces.projection import Measurement
from forcegp.gp.standardization import Standardization
from forcegp.models.structured_gp import StructuredGP
from forcegp.models.structured_settings import COLUMNS, StructuredSettings
from forcegp.models.structured_training import Training
from forcegp.storage.folder import ModelHeader, settings_of


def _below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def load_structured(
    header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
) -> StructuredGP:
    """The model that `save_structured` wrote.

    Raises:
        ModelError: a tensor is missing or has another shape; names file and field.
    """
    settings = settings_of(header, StructuredSettings, source)
    priors = tuple(prior.build() for prior in settings.priors)
    model = StructuredGP(
        system, AnalyticalMean(settings.mean), priors, settings.noise_std, settings.learn_noise
    )
    try:
        measurements = tuple(
            Measurement(quantity, **{name: tensors[f"data.{i}.{name}"] for name in COLUMNS})
            for i, quantity in enumerate(settings.measured)
        )
        noise = tuple(tensors[f"data.{i}.noise_std"] for i in range(len(measurements)))
        scales = tuple(
            Standardization(
                _below(tensors, f"scale.{prior.name}.mean."),
                _below(tensors, f"scale.{prior.name}.std."),
                constant,
            )
            for prior, constant in zip(priors, settings.constant, strict=True)
        )
        hyperparameters = _below(tensors, "hyper.")
        _check(model, scales, hyperparameters, tensors)
        model.restore(Training(measurements, noise, scales), hyperparameters, tensors["alpha"])
    except (KeyError, RuntimeError, ValueError, IndexError) as cause:
        raise ModelError(f"{source}: the model's tensors do not fit its settings", got=str(cause)) from cause
    return model


def _check(
    model: StructuredGP,
    scales: Sequence[Standardization],
    hyperparameters: Mapping[str, Tensor],
    tensors: Mapping[str, Tensor],
) -> None:
    """Raise `ValueError` where a number is not finite, or hyperparameters are not those of the kernels."""
    for name, value in tensors.items():
        if not bool(torch.isfinite(value).all()):
            raise ValueError(f"tensor {name!r} holds values that are not finite")
    for prior, scale in zip(model.force_priors, scales, strict=True):
        widths = {name: x.shape[-1] for name, x in scale.mean.items()}
        for key, value in prior.kernel.initial(prior.outputs(model.system.robot), widths).items():
            found = hyperparameters[f"{prior.prefix}.{key}"]
            if found.shape != value.shape:
                raise ValueError(f"hyperparameter '{prior.prefix}.{key}' has shape {tuple(found.shape)}")
