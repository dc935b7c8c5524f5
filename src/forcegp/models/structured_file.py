"""Structured Gaussian processes in saved files.

An exact posterior is saved with its data, and a sparse posterior with its sums over the data. Priors
are saved field by field.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, field_serializer
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.files import Record
from forcegp.forces.measurements import Measurement, Training, plain
from forcegp.forces.noise import Noise
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import ANALYTICAL, ForcePrior
from forcegp.forces.problem import Problem, analytical_parameters, kernel_parameters
from forcegp.forces.quantities import states
from forcegp.gp import kernels
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.features import Standardization
from forcegp.gp.sparse import SparsePosterior
from forcegp.learning.specification import Specification, constant_inputs
from forcegp.models.fit_result import FitResult
from forcegp.options import Inference
from forcegp.priors import (
    AnalyticalMean,
    ContactForcePrior,
    DrivePrior,
    InertialPrior,
    JointForcePrior,
    JointTerm,
    NormalForcePrior,
    OffsetPrior,
    PayloadPrior,
    PerRecording,
    ResidualPrior,
    SlidingFrictionPrior,
)
from forcegp.robot.parameters import AnalyticalParameters
from forcegp.storage.descriptions import decode, encode
from forcegp.storage.model_file import ModelHeader
from forcegp.storage.system import take_robot

Stated = NonNegativeFloat | tuple[NonNegativeFloat, ...]
"""Noise, which may be zero, as one number or one per joint."""
CLASSES: dict[str, type] = {
    "squared_exponential": kernels.SquaredExponential,
    "matern32": kernels.Matern32,
    "matern52": kernels.Matern52,
    "linear": kernels.Linear,
    "columns": kernels.Columns,
    "sum": kernels.Sum,
    "product": kernels.Product,
    "constant": kernels.Constant,
    "joint": JointForcePrior,
    "residual": ResidualPrior,
    "inertial": InertialPrior,
    "normal": NormalForcePrior,
    "payload": PayloadPrior,
    "drives": DrivePrior,
    "per_recording": PerRecording,
    "contact": ContactForcePrior,
    "sliding_friction": SlidingFrictionPrior,
}
"""Classes that can be saved, by their names in the file, besides the laws in `JointTerm.laws`, which contains
those of the library because `forcegp.priors` imports them."""


def classes() -> dict[str, type]:
    """Return the classes that can be saved, by their names in the file."""
    laws = {f"law:{name}" if name in CLASSES else name: law for name, law in JointTerm.laws.items()}
    return {**CLASSES, **laws}


COLUMNS = ("q", "qd", "tau", "active", "values")
"""Saved parts of each measurement."""
NOT_REAL = (
    (re.compile(r"data\.\d+\.active"), torch.bool),
    (re.compile(r"added|data\.\d+\.recording|sparse\..*\.(components|dropped)"), torch.int64),
)
"""Name patterns and types of the tensors that do not contain real numbers."""
Parts = tuple[
    Specification, Problem, dict[str, Tensor], ForcePosterior, FitResult, ConstrainedSystem, dict[str, Tensor]
]
"""The fields of a `StructuredFit`."""


class NoiseSettings(Record):
    """Fields of `Noise`."""

    acceleration: PositiveFloat | tuple[PositiveFloat, ...] | None
    learn: bool
    torque: PositiveFloat | tuple[PositiveFloat, ...] | Literal["learn"] | None
    state: tuple[Stated, Stated] | None
    degrees_of_freedom: float | None = Field(gt=2.0)
    external: dict[str, PositiveFloat] | None = None


class StructuredSettings(Record):
    """Saved settings of a structured Gaussian process."""

    inference: Inference
    inertia: Annotated[str, Field(pattern="^(file|auto)$")] | None
    mean: tuple[str, ...]
    noise: NoiseSettings
    power: float = Field(gt=0.0, le=1.0)
    priors: tuple[dict[str, Any], ...]
    measured: tuple[str, ...]
    constant: tuple[tuple[str, ...], ...]
    analytical_parameters: dict[str, tuple[str, ...]] | None
    result: FitResult

    @field_serializer("result")
    def _saved(self, result: FitResult) -> dict[str, Any]:
        """Return the result without its history and without constant inputs, which the scales contain."""
        left_out = ("history", "constant_inputs")
        return {name: x for name, x in dataclasses.asdict(result).items() if name not in left_out}


def pack(
    spec: Specification,
    problem: Problem,
    hyperparameters: Mapping[str, Tensor],
    posterior: ForcePosterior,
    result: FitResult,
) -> tuple[StructuredSettings, dict[str, Tensor]]:
    """Convert a fit to settings and tensors.

    Args:
        problem: the problem with the data on which the posterior is conditioned.

    Raises:
        ModelError: a prior or kernel is defined in Python.
    """
    theta = (
        spec.analytical_parameters if isinstance(spec.analytical_parameters, AnalyticalParameters) else None
    )
    tensors = {f"hyper.{key}": value for key, value in _kept(hyperparameters, theta).items()}
    if problem.torque_std is not None:
        tensors["torque_std"] = problem.torque_std
    if problem.correlation is not None:
        tensors["torque_correlation"] = problem.correlation
    tensors |= _conditioned_on(spec, problem.training, posterior)
    start = theta.start if theta is not None else spec.system.robot
    tensors |= {f"start.{name}": value for name, value in start.tensors.items()}
    for prior, scale in zip(spec.priors, problem.training.scales, strict=True):
        tensors |= {f"scale.{prior.name}.mean.{key}": value for key, value in scale.mean.items()}
        tensors |= {f"scale.{prior.name}.std.{key}": value for key, value in scale.std.items()}
    stated = spec.noise
    noise = {**vars(stated), "acceleration": plain(stated.acceleration), "torque": plain(stated.torque)}
    noise["state"] = None if stated.state is None else tuple(map(plain, stated.state))
    tensors |= {f"law.{law.name}": law.probe(spec.system) for law in _laws(problem.priors)}
    settings = StructuredSettings(
        inference=spec.inference,
        inertia=spec.inertia,
        mean=spec.mean.terms,
        noise=NoiseSettings(**noise),
        power=problem.power,
        priors=tuple(encode(prior, classes()) for prior in problem.priors),
        measured=problem.training.quantities if isinstance(posterior.latent, ExactPosterior) else (),
        constant=tuple(scale.constant for scale in problem.training.scales),
        analytical_parameters=None if theta is None else theta.joints,
        result=result,
    )
    return settings, tensors


def _conditioned_on(spec: Specification, training: Training, posterior: ForcePosterior) -> dict[str, Tensor]:
    """Return the data of an exact posterior, or the sums of a sparse posterior over the data."""
    latent = posterior.latent
    if not isinstance(latent, ExactPosterior):
        return {f"sparse.{name}": value for name, value in latent.tensors().items()}
    tensors = {"alpha": latent.alpha}
    for i, (m, std) in enumerate(zip(training.measurements, training.noise_std, strict=True)):
        tensors |= {f"data.{i}.{name}": getattr(m, name) for name in _columns(spec)}
        tensors[f"data.{i}.noise_std"] = std
        if training.weights is not None:
            tensors[f"data.{i}.weight"] = training.weights[i]
        if training.slopes is not None and (G := training.slopes[i]) is not None:
            tensors[f"data.{i}.slope"] = G
    return tensors


def _laws(priors: Sequence[ForcePrior]) -> list[JointTerm]:
    """Return the laws that do not belong to the library."""
    return [x for x in priors if isinstance(x, JointTerm) and not type(x).__module__.startswith("forcegp.")]


def _columns(spec: Specification) -> tuple[str, ...]:
    """Return the saved parts of each measurement."""
    several = any(isinstance(prior, PerRecording | OffsetPrior) for prior in spec.priors)
    return (*COLUMNS, "recording") if several else COLUMNS


def _kept(hyper: Mapping[str, Tensor], theta: AnalyticalParameters | None) -> dict[str, Tensor]:
    """Return the hyperparameters. Omit θ_A if its module cannot be saved, since the robot contains it."""
    left_out = analytical_parameters(hyper) if theta is None else {}
    return {k: v for k, v in hyper.items() if k.removeprefix(f"{ANALYTICAL}.") not in left_out}


def _below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def unpack(
    header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
) -> Parts:
    """Restore the fields of a fit from the output of `pack`.

    Raises:
        ModelError: a tensor or setting is missing or invalid. The message names the file and the field.
    """
    settings = header.settings_as(StructuredSettings, source)
    spec = _specification(settings, tensors, system, source)
    for law in _laws(spec.priors):
        saved, now = tensors.get(f"law.{law.name}"), law.probe(system)
        if saved is not None and not (saved.shape == now.shape and torch.allclose(saved, now, rtol=1e-9)):
            raise ModelError(
                f"{source}: the columns of {law.name!r} are not those that the model was fitted with",
                hint=f"restore the lines of {type(law).__name__}, or fit the model again",
            )
    try:
        _check_types(tensors)
        training = _training(settings, spec, tensors)
        hyper = _below(tensors, "hyper.")
        _check_hyperparameters(spec, training, hyper)
        return _restored(spec, training, hyper, tensors, settings, system)
    except (KeyError, RuntimeError, ValueError, IndexError) as cause:
        raise ModelError(
            f"{source}: the tensors of the model do not match its settings", got=str(cause)
        ) from cause


def _specification(
    settings: StructuredSettings, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
) -> Specification:
    named = ((f"{source}: settings.priors.{i}", prior) for i, prior in enumerate(settings.priors))
    priors = tuple(decode(dict(prior), classes(), name) for name, prior in named)
    original, parameters = take_robot(tensors, "start.", system.robot, source), None
    system = system.with_robot(original)
    if settings.analytical_parameters is not None:
        with ModelError.within(f"{source}: field 'settings.analytical_parameters'"):
            parameters = AnalyticalParameters(original, settings.analytical_parameters)
    return Specification(
        system,
        AnalyticalMean(settings.mean),
        priors,
        Noise(**settings.noise.model_dump()),
        parameters,
        inference=settings.inference,
        inertia=settings.inertia,
    )


def _check_types(tensors: Mapping[str, Tensor]) -> None:
    """Raise `ValueError` unless each tensor contains real numbers or has its type in `NOT_REAL`."""
    for name, value in tensors.items():
        dtype = next((dtype for names, dtype in NOT_REAL if names.fullmatch(name)), None)
        if not value.is_floating_point() if dtype is None else value.dtype != dtype:
            raise ValueError(f"tensor {name!r} has type {value.dtype}")


def _training(settings: StructuredSettings, spec: Specification, tensors: Mapping[str, Tensor]) -> Training:
    measurements, parts = [], []
    for i, quantity in enumerate(settings.measured):
        part = _below(tensors, f"data.{i}.")
        m = Measurement(quantity, **{name: part[name] for name in _columns(spec)})
        (n, d), nq = m.values.shape, spec.system.robot.nq
        shapes = {"q": (n, nq), "qd": (n, nq), "tau": (n, nq), "active": (n, len(spec.system.contacts))}
        shapes |= {"recording": (n,), "weight": (n,), "slope": (n, d, 2 * nq)}
        shapes["noise_std"] = (d,) if part["noise_std"].ndim == 1 else (n, d)
        for name, shape in shapes.items():
            if name in part and part[name].shape != shape:
                raise ValueError(f"tensor 'data.{i}.{name}' has shape {tuple(part[name].shape)}")
        if "weight" in part and not bool((part["weight"] > 0.0).all()):
            raise ValueError(f"tensor 'data.{i}.weight' is not positive")
        measurements.append(m)
        parts.append(part)
    scales = tuple(
        Standardization(
            {name: tensors[f"scale.{prior.name}.mean.{name}"] for name in names},
            {name: tensors[f"scale.{prior.name}.std.{name}"] for name in names},
            constant,
        )
        for prior, names, constant in zip(spec.priors, _inputs(spec), settings.constant, strict=True)
    )
    weights = tuple(part["weight"] for part in parts) if parts and "weight" in parts[0] else None
    slopes = tuple(part.get("slope") for part in parts) if any("slope" in part for part in parts) else None
    noise = tuple(part["noise_std"] for part in parts)
    return Training(tuple(measurements), noise, scales, weights=weights, slopes=slopes)


def _check_hyperparameters(spec: Specification, training: Training, hyper: Mapping[str, Tensor]) -> None:
    """Raise `ValueError` or `KeyError` if the hyperparameters do not match the kernels."""
    for prior, scale in zip(spec.priors, training.scales, strict=True):
        widths = {name: x.shape[-1] for name, x in scale.mean.items()}
        expected = prior.kernel.initial(prior.outputs(spec.system.robot), widths)
        for key, value in expected.items():
            stored = hyper[f"{prior.prefix}.{key}"]
            if stored.shape != value.shape:
                raise ValueError(f"hyperparameter '{prior.prefix}.{key}' has shape {tuple(stored.shape)}")


@torch.no_grad()
def _restored(
    spec: Specification,
    training: Training,
    hyper: dict[str, Tensor],
    tensors: Mapping[str, Tensor],
    settings: StructuredSettings,
    system: ConstrainedSystem,
) -> Parts:
    """Restore the fit with its weights. Matrices are factorised only when a covariance is needed."""
    problem = dataclasses.replace(
        spec.problem(training),
        system=spec.system if spec.analytical_parameters is not None else system,
        power=settings.power,
        correlation=tensors.get("torque_correlation"),
        torque_std=tensors.get("torque_std"),
    )
    posterior = _posterior(*problem.with_coulomb_errors(hyper), tensors)
    result = dataclasses.replace(settings.result, constant_inputs=constant_inputs(problem), history=())
    return spec, problem, hyper, posterior, result, system, _below(tensors, "noise_std.")


def _inputs(spec: Specification) -> list[list[str]]:
    """Return the names of the inputs of each prior in the order that it defines.

    Columns and kernels on all inputs depend on this order, which files do not preserve.
    """
    system = spec.system
    rest = torch.zeros(1, system.robot.nq, dtype=system.robot.dtype, device=system.robot.device)
    closed = torch.ones(1, len(system.contacts), dtype=torch.bool, device=rest.device)
    at = states(system, rest, rest, rest, closed)
    return [list(prior.features(system, at)) for prior in spec.priors]


def _in_order(problem: Problem, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors with the inputs of each kernel in the order of the scales."""
    inputs = enumerate(scale.std for scale in problem.training.scales)
    named = [f"{p}.inducing.{name}" for p, names in inputs for name in names]
    return {name: tensors[name] for name in (*named, *tensors) if name in tensors}


def _posterior(problem: Problem, hyper: dict[str, Tensor], tensors: Mapping[str, Tensor]) -> ForcePosterior:
    """Restore the posterior from its weights or sums."""
    params, process = kernel_parameters(hyper), problem.process_at(hyper)
    if "alpha" not in tensors:
        kept = _in_order(problem, _below(tensors, "sparse."))
        latent = SparsePosterior.of_tensors(problem.priors, params, kept, len(problem.errors))
        return ForcePosterior(process, latent)
    blocks, alpha = problem.rows(hyper).blocks, tensors["alpha"]
    rows = sum(block.rows for block in blocks)
    if alpha.shape != (rows,):
        raise ValueError(f"weights of shape {tuple(alpha.shape)} for {rows} rows")
    latent = ExactPosterior(problem.priors, params, blocks, alpha, len(problem.errors))
    return ForcePosterior(process, latent)
