"""Writing and reading the models that are no structured Gaussian processes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

from pydantic import PositiveFloat
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ForceGPError, ModelError
from forcegp.gp.standardization import Standardization
from forcegp.models.analytical import AnalyticalModel, Window
from forcegp.models.base import not_fitted
from forcegp.models.independent_gp import IndependentGP, IndependentTraining
from forcegp.models.neural import NeuralNetwork
from forcegp.storage.folder import ModelHeader, Settings, settings_of, write_model
from forcegp.storage.system import take

STATES: tuple[str, ...] = ("q", "qd", "tau")


class AnalyticalSettings(Settings):
    """What is kept of an analytical model beside its tensors; the robot is the learned one."""

    learn: dict[str, tuple[str, ...]]
    relative: float
    length: float
    angle: float
    seed: int


class NetworkSettings(Settings):
    """What is kept of a neural network beside its tensors."""

    hidden: tuple[int, ...]
    seed: int
    constant: tuple[str, ...]


class IndependentSettings(Settings):
    """What is kept of independent Gaussian processes beside their tensors."""

    noise_std: PositiveFloat | tuple[PositiveFloat, ...]


def save_analytical(model: AnalyticalModel, path: str | Path) -> None:
    """Write an analytical model: the learned robot, and the one that learning starts from."""
    settings = AnalyticalSettings(
        learn=model.parameters.joints,
        relative=model.window.relative,
        length=model.window.length,
        angle=model.window.angle,
        seed=model.seed,
    )
    start = {f"start.{name}": getattr(model.parameters.start, name) for name in _robot_tensors(model.system)}
    write_model(path, model.kind, model.system, settings, dict(model.parameters.state_dict()) | start)


def load_analytical(
    header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
) -> AnalyticalModel:
    """The analytical model that `save_analytical` wrote."""
    settings = settings_of(header, AnalyticalSettings, source)
    like = {name: getattr(system.robot, name) for name in _robot_tensors(system)}
    start = {
        name: take(tensors, f"start.{name}", tuple(old.shape), old.dtype, source, finite=False)
        for name, old in like.items()
    }
    window = Window(settings.relative, settings.length, settings.angle)
    try:
        original = system.with_robot(system.robot.replace(**start))
        model = AnalyticalModel(original, settings.learn, window, settings.seed)
    except ForceGPError as cause:
        raise ModelError.at(f"{source}: field 'settings.learn'", cause) from cause
    state = {
        name: take(tensors, name, tuple(old.shape), old.dtype, source)
        for name, old in model.parameters.state_dict().items()
    }
    model.parameters.load_state_dict(state)
    model.system = system
    return model


def _robot_tensors(system: ConstrainedSystem) -> list[str]:
    """Names of the robot's fields that are tensors."""
    names = [field.name for field in dataclasses.fields(system.robot)]
    return [name for name in names if isinstance(getattr(system.robot, name), Tensor)]


def save_network(model: NeuralNetwork, path: str | Path) -> None:
    """Write a neural network.

    Raises:
        ModelError: the model has not been fitted.
    """
    if model.inputs is None or model.outputs is None:
        raise not_fitted(model)
    settings = NetworkSettings(hidden=model.hidden, seed=model.seed, constant=model.inputs.constant)
    tensors = {f"network.{name}": value for name, value in model.network.state_dict().items()}
    for part in (model.inputs, model.outputs):
        for name in part.mean:
            tensors |= {f"mean.{name}": part.mean[name], f"std.{name}": part.std[name]}
    write_model(path, model.kind, model.system, settings, tensors)


def load_network(
    header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
) -> NeuralNetwork:
    """The neural network that `save_network` wrote."""
    settings = settings_of(header, NetworkSettings, source)
    # The shapes are those of the file before a network of these widths is allocated.
    widths = (3 * system.robot.nq, *settings.hidden, system.robot.nq)
    for i, (width, following) in enumerate(pairwise(widths)):
        take(tensors, f"network.{2 * i}.weight", (following, width), system.robot.dtype, source)
    model = NeuralNetwork(system, settings.hidden, settings.seed)
    state = {
        name: take(tensors, f"network.{name}", tuple(old.shape), old.dtype, source)
        for name, old in model.network.state_dict().items()
    }
    model.network.load_state_dict(state)
    scales = []
    for names, constant in ((STATES, settings.constant), (("qdd",), ())):
        mean, std = (
            {
                name: take(tensors, f"{part}.{name}", (system.robot.nq,), system.robot.dtype, source)
                for name in names
            }
            for part in ("mean", "std")
        )
        scales.append(Standardization(mean, std, constant))
    model.adopt(model.network, *scales)
    return model


def save_independent(model: IndependentGP, path: str | Path) -> None:
    """Write independent Gaussian processes: hyperparameters and training data.

    Raises:
        ModelError: the model has not been fitted.
    """
    if model.training is None:
        raise not_fitted(model)
    noise = model.noise_std
    settings = IndependentSettings(noise_std=float(noise) if isinstance(noise, int | float) else tuple(noise))
    training = {f"training.{name}": value for name, value in model.training.features.items()}
    training |= {"training.qdd": model.training.qdd, "training.noise_std": model.training.noise_std}
    tensors = {f"hyperparameters.{name}": value for name, value in model.hyperparameters.items()}
    write_model(path, model.kind, model.system, settings, training | tensors)


def load_independent(
    header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
) -> IndependentGP:
    """The Gaussian processes that `save_independent` wrote."""
    settings = settings_of(header, IndependentSettings, source)
    nq, dtype = system.robot.nq, system.robot.dtype
    model = IndependentGP(system, settings.noise_std)
    n = len(take(tensors, "training.q", None, dtype, source))
    features = {name: take(tensors, f"training.{name}", (n, nq), dtype, source) for name in STATES}
    training = IndependentTraining(
        features,
        take(tensors, "training.qdd", (n, nq), dtype, source),
        take(tensors, "training.noise_std", (nq,), dtype, source),
        Standardization.of(features),
    )
    widths = dict.fromkeys(STATES, nq)
    hyperparameters = {
        f"{prior.name}.{name}": take(
            tensors, f"hyperparameters.{prior.name}.{name}", tuple(value.shape), dtype, source
        )
        for prior in model.priors
        for name, value in prior.kernel.initial(1, widths).items()
    }
    try:
        model.adopt(hyperparameters, training)
    except ForceGPError as cause:
        raise ModelError.at(f"{source}: the training data", cause) from cause
    return model
