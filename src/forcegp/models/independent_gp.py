"""Gaussian-process baseline with one process per joint acceleration and no mechanical model.

q̈_j ~ GP(0, k_j(x, x′)) with x = (q, q̇, τ) and squared-exponential k_j (section 5.4 of the paper).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from pydantic import PositiveFloat
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.files import Record
from forcegp.forces.measurements import NoiseStd, Observation, measurement_of, plain
from forcegp.forces.noise import Noise
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.problem import require_double
from forcegp.forces.quantities import FlatStates
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.features import Block, Standardization
from forcegp.gp.likelihood import negative_log_likelihood
from forcegp.gp.optimise import Learned, LearningOptions, minimise, reported
from forcegp.learning.search import box_around, doubts_at_bounds, initial_hyperparameters, negative_log_prior
from forcegp.models.base import AccelerationFit, FitProgress, Model
from forcegp.models.fit_result import FitResult
from forcegp.resources import announce_memory
from forcegp.storage.model_file import ModelHeader
from forcegp.storage.system import take

KIND = "independent_gp"
LEARNING = 6
"""Number of `(n, n)` matrices needed to learn one joint, as measured, besides the factors of all joints."""


@dataclass(frozen=True)
class IndependentTraining:
    """Training data of fitted independent Gaussian processes.

    Attributes:
        features: inputs before standardization, `(n, nq)` each, keyed by name.
        qdd: accelerations `(n, nq)` [rad/s², m/s²].
        noise_std: standard deviation of the acceleration noise, `(nq,)` or `(n, nq)`.
        scale: standardization of the inputs.
    """

    features: dict[str, Tensor]
    qdd: Tensor
    noise_std: Tensor
    scale: Standardization

    def processes(self) -> list[tuple[JointForcePrior, Block, Tensor]]:
        """Return the process, the accelerations in units of the noise, and Σ log σ for each joint.

        The likelihood uses only the name and the kernel of a process.
        """
        inputs, noise = self.scale.apply(self.features), self.noise_std.expand_as(self.qdd)
        columns = enumerate(zip(self.qdd.split(1, dim=1), noise.split(1, dim=1), strict=True))
        return [
            (
                JointForcePrior(name=f"qdd_{joint}"),
                Block((inputs,), ((1.0 / std)[..., None],), qdd * (1.0 / std)),
                std.log().sum(),
            )
            for joint, (qdd, std) in columns
        ]

    def announce(self, copies: int) -> None:
        """Warn if the matrices of all joints need a lot of memory."""
        n, nq = self.qdd.shape
        announce_memory(8 * (2 * nq + copies) * n**2, f"independent Gaussian processes on {n:,} samples")


class IndependentSettings(Record):
    """Saved settings of independent Gaussian processes."""

    standardize: bool
    noise_std: PositiveFloat | tuple[PositiveFloat, ...] | None


class IndependentGP(Model["IndependentFit"]):
    """Independent zero-mean Gaussian processes, one per joint acceleration, on standardized (q, q̇, τ).

    The inputs are states and torques. Contacts are not used as inputs.

    Args:
        system: the robot and its contacts, which are used only for evaluation.
        noise: standard deviation of measured accelerations [rad/s², m/s²], as one value or one per joint. The
            default is the value in the log, or 0.1 if the log states none.
        standardize: whether to standardize the inputs, which the paper does not do.

    Raises:
        ModelError: the robot is not in float64, `noise` specifies more than acceleration noise, or
            `standardize` is not a truth value.
    """

    kind = KIND

    def __init__(
        self, system: ConstrainedSystem, noise: NoiseStd | Noise | None = None, standardize: bool = True
    ) -> None:
        self._keep(locals())
        require_double(system)
        self.system = system
        stated = Noise.of(noise)
        if stated != Noise(stated.acceleration):
            raise ModelError(
                "independent Gaussian processes support only white acceleration noise",
                expected="a number, one per joint, or Noise(acceleration)",
                got=noise,
            )
        self.noise = stated.acceleration
        if not isinstance(standardize, bool):
            raise ModelError("invalid `standardize`", expected="True or False", got=standardize)
        self.standardize = standardize

    def fit(
        self,
        data: Dataset,
        *,
        options: LearningOptions | None = None,
        progress: FitProgress | None = None,
    ) -> IndependentFit:
        """Learn the hyperparameters by maximum a posteriori estimation, one joint after the other.

        Args:
            data: states and measured accelerations.
            options: the optimiser and its limits, which apply to each joint.
            progress: a function called after each evaluation. Evaluations are counted over all joints.

        Raises:
            ModelError, DataError: the data are incompatible with the model.
            NumericalError: the likelihood cannot be computed.
        """
        options, began = options or LearningOptions(), time.perf_counter()
        measured, noise_std = measurement_of(Observation(data), self.system, self.noise)
        features = {"q": measured.q, "qd": measured.qd, "tau": measured.tau}
        training = self.training(features, measured.values, noise_std)
        training.announce(LEARNING)
        processes, parts = training.processes(), list[Learned]()
        for prior, block, constant in processes:
            start = initial_hyperparameters([prior], [block])
            centre = start if options.hyperpriors else {}
            objective = partial(_objective, prior, block, constant, centre)
            before = sum(part.evaluations for part in parts)
            report = reported(progress, options.max_evaluations * len(processes), before)
            box = box_around(start)
            learned = minimise(objective, start, options, bounds=box, progress=report)
            parts.append(dataclasses.replace(learned, doubts=doubts_at_bounds(learned.tensors, box)))
        hyperparameters = {key: x for part in parts for key, x in part.tensors.items()}
        fit = fitted(self, training, hyperparameters, parts)
        result = dataclasses.replace(fit.result, seconds=time.perf_counter() - began)
        return dataclasses.replace(fit, result=result)

    def training(self, features: dict[str, Tensor], qdd: Tensor, noise_std: Tensor) -> IndependentTraining:
        """Return the training data, including the standardization of the inputs."""
        scaled = Standardization.of if self.standardize else Standardization.none
        return IndependentTraining(features, qdd, noise_std, scaled(features))


def _objective(
    prior: JointForcePrior,
    block: Block,
    constant: Tensor,
    centre: Mapping[str, Tensor],
    theta: dict[str, Tensor],
) -> Tensor:
    """Return the negative log posterior of a joint's hyperparameters, with weak priors around `centre`."""
    value = negative_log_likelihood([prior], theta, [block]) + constant
    return value + negative_log_prior(theta, centre) if centre else value


def fitted(
    model: IndependentGP,
    training: IndependentTraining,
    hyperparameters: dict[str, Tensor],
    parts: Sequence[Learned] = (),
) -> IndependentFit:
    """Condition the processes on training data for given hyperparameters.

    Raises:
        NumericalError: a covariance is not positive definite.
    """
    processes = training.processes()
    posteriors = tuple(ExactPosterior.of([prior], hyperparameters, [block]) for prior, block, _ in processes)
    pairs = zip(posteriors, processes, strict=True)
    value = sum(p.log_likelihood - float(constant) for p, (_, _, constant) in pairs)
    ended = zip(model.system.robot.joint_names, parts, strict=False)
    result = FitResult(
        converged=all(part.converged for part in parts),
        evaluations=sum(part.evaluations for part in parts),
        seconds=sum(part.seconds for part in parts),
        objective=sum(part.value for part in parts) if parts else -value,
        log_marginal_likelihood=value,
        jitter=max(p.conditioned.jitter for p in posteriors),
        constant_inputs=training.scale.constant,
        message="; ".join(f"{joint}: {part.message}" for joint, part in ended),
        history=tuple(value for part in parts for value in part.history),
        warnings=tuple(doubt for part in parts for doubt in part.doubts),
    )
    return IndependentFit(model.system, model, training, hyperparameters, posteriors, result)


@dataclass(frozen=True, eq=False, repr=False)
class IndependentFit(AccelerationFit):
    """Fitted independent Gaussian processes.

    Attributes:
        system: the robot and its contacts.
        specification: the specification of the model.
        training: the data on which the processes are conditioned.
        hyperparameters: log-hyperparameters of all processes.
        posteriors: the posterior for each joint.
        result: result of the fit.
    """

    system: ConstrainedSystem
    specification: IndependentGP
    training: IndependentTraining
    hyperparameters: dict[str, Tensor]
    posteriors: tuple[ExactPosterior, ...]
    result: FitResult

    kind = KIND

    def accelerations(self, at: FlatStates, variance: bool) -> tuple[Tensor, Tensor | None]:
        features = self.training.scale.apply({"q": at.q, "qd": at.qd, "tau": at.tau})
        mean = torch.cat([p.latent_mean(0, features) for p in self.posteriors], dim=-1)
        if not variance:
            return mean, None
        like = torch.ones_like(mean[:, :1])
        rows = Block((features,), (like[..., None],), torch.zeros_like(like))
        return mean, torch.stack([p.covariance(rows)[:, 0, 0] for p in self.posteriors], dim=-1)

    @classmethod
    def restored(
        cls, header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
    ) -> IndependentFit:
        settings = header.settings_as(IndependentSettings, source)
        model = IndependentGP(system, settings.noise_std, settings.standardize)
        nq, dtype = system.robot.nq, system.robot.dtype
        n = next(iter(take(tensors, "training.q", None, dtype, source).shape), 0)
        features = {x: take(tensors, f"training.{x}", (n, nq), dtype, source) for x in ("q", "qd", "tau")}
        noise = take(tensors, "training.noise_std", None, dtype, source)
        if noise.shape not in ((nq,), (n, nq)):
            raise ModelError(
                f"{source}: tensor 'training.noise_std' has the wrong shape", got=tuple(noise.shape)
            )
        training = model.training(features, take(tensors, "training.qdd", (n, nq), dtype, source), noise)
        hyperparameters = {
            f"{prior.name}.{name}": take(
                tensors, f"hyperparameters.{prior.name}.{name}", tuple(value.shape), torch.float64, source
            )
            for prior, _, _ in training.processes()
            for name, value in prior.kernel.initial(1, dict.fromkeys(features, nq)).items()
        }
        training.announce(0)
        with ModelError.within(f"{source}: the training data"):
            return fitted(model, training, hyperparameters)

    def record(self) -> tuple[Record, dict[str, Tensor]]:
        model = self.specification
        settings = IndependentSettings(standardize=model.standardize, noise_std=plain(model.noise))
        tensors = {f"training.{name}": value for name, value in self.training.features.items()}
        tensors |= {"training.qdd": self.training.qdd, "training.noise_std": self.training.noise_std}
        tensors |= {f"hyperparameters.{name}": value for name, value in self.hyperparameters.items()}
        return settings, tensors
