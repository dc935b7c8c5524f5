"""The Gaussian-process baseline: each joint acceleration has a process of its own, blind to mechanics.

q̈_j ~ GP(0, k_j(x, x′)) with x = (q, q̇, τ) and squared-exponential k_j (section 5.4 of the paper).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.forces.measurements import NoiseStd, Observation, measurement_of
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.start import bounds_of, initial_hyperparameters, negative_log_prior
from forcegp.gp.kernels import sub
from forcegp.gp.likelihood import Conditioned, condition, negative_log_likelihood
from forcegp.gp.optimise import Learned, LearningOptions, minimise
from forcegp.gp.standardization import Standardization
from forcegp.gp.structured_covariance import Block, cross_gram
from forcegp.models.base import FitProgress, FitResult, Model, Prediction, not_fitted, only_qdd
from forcegp.models.flat import flat_states

CHUNK_STATES = 2000
"""States predicted at a time, which bounds the memory."""


@dataclass(frozen=True)
class IndependentTraining:
    """What a fitted model keeps of its training data.

    Attributes:
        features: inputs before standardization, `(n, nq)` by name.
        qdd: `(n, nq)` [rad/s², m/s²].
        noise_std: `(nq,)`.
        scale: standardization of the inputs.
    """

    features: dict[str, Tensor]
    qdd: Tensor
    noise_std: Tensor
    scale: Standardization


class IndependentGP(Model):
    """Independent zero-mean Gaussian processes, one a joint acceleration, on standardized (q, q̇, τ).

    Contacts are not an input: the model sees only states and torques.

    Args:
        system: robot and contacts; the contacts serve to evaluate the model, not to learn it.
        noise_std: standard deviation of measured accelerations [rad/s², m/s²], one or one a joint.
    """

    kind = "independent_gp"

    def __init__(self, system: ConstrainedSystem, noise_std: NoiseStd = 0.1) -> None:
        self.system = system
        self.noise_std = noise_std
        # Likelihood and Gram matrices read nothing of a prior but its name and kernel.
        self.priors = tuple(JointForcePrior(name=f"qdd_{j}") for j in range(system.robot.nq))
        self.hyperparameters: dict[str, Tensor] = {}
        self.training: IndependentTraining | None = None
        self._conditioned: tuple[Conditioned, ...] = ()

    def fit(
        self,
        data: Dataset,
        *,
        options: LearningOptions | None = None,
        progress: FitProgress | None = None,
    ) -> FitResult:
        """Learn the hyperparameters of each joint by maximum a posteriori, one joint after the other.

        Args:
            data: states and measured accelerations.
            options: optimiser and its limits, for each joint.
            progress: called after each evaluation, with those of all joints.

        Raises:
            ModelError, DataError: the data do not fit the model.
            NumericalError: the likelihood cannot be computed.
        """
        options = options or LearningOptions()
        measured, noise_std = measurement_of(Observation(data), self.system, self.noise_std)
        features = {"q": measured.q, "qd": measured.qd, "tau": measured.tau}
        training = IndependentTraining(features, measured.values, noise_std, Standardization.of(features))
        parts: list[Learned] = []
        for joint in range(self.system.robot.nq):
            before = sum(part.evaluations for part in parts)
            parts.append(self._learn(training, joint, options, before, progress))
        self.adopt({key: x for part in parts for key, x in part.tensors.items()}, training)
        return self._result(training, parts)

    def _learn(
        self,
        training: IndependentTraining,
        joint: int,
        options: LearningOptions,
        before: int,
        progress: FitProgress | None,
    ) -> Learned:
        """Learn the process of one joint."""
        priors, blocks = self.priors[joint : joint + 1], [self.block(training, joint)]
        start = initial_hyperparameters(priors, blocks)
        constant = len(training.qdd) * training.noise_std[joint].log()

        def objective(tensors: dict[str, Tensor]) -> Tensor:
            value, _ = negative_log_likelihood(priors, tensors, blocks)
            return value + constant + negative_log_prior(tensors, start)

        def report(evaluations: int, value: float, _: dict[str, Tensor]) -> None:
            if progress is not None:
                progress(before + evaluations, options.max_evaluations * len(self.priors), value)

        return minimise(objective, start, options, bounds=bounds_of(start), progress=report)

    def block(self, training: IndependentTraining, joint: int) -> Block:
        """The accelerations of one joint in units of their noise."""
        inverse = 1.0 / training.noise_std[joint]
        operator = inverse.expand(len(training.qdd), 1, 1)
        target = training.qdd[:, joint : joint + 1] * inverse
        return Block((training.scale.apply(training.features),), (operator,), target)

    def adopt(self, hyperparameters: dict[str, Tensor], training: IndependentTraining) -> None:
        """Condition on training data under given hyperparameters.

        Raises:
            NumericalError: a covariance is not positive definite.
        """
        self._conditioned = tuple(
            condition(self.priors[j : j + 1], hyperparameters, [self.block(training, j)])
            for j in range(len(self.priors))
        )
        self.hyperparameters, self.training = hyperparameters, training

    def log_marginal_likelihood(self) -> float:
        """log p(y | X, θ) of the training data, summed over the joints.

        Raises:
            ModelError: the model has not been fitted.
        """
        if self.training is None:
            raise not_fitted(self)
        total = len(self.training.qdd) * float(self.training.noise_std.log().sum())
        for j in range(len(self.priors)):
            blocks = [self.block(self.training, j)]
            total += float(negative_log_likelihood(self.priors[j : j + 1], self.hyperparameters, blocks)[0])
        return -total

    def _result(self, training: IndependentTraining, parts: list[Learned]) -> FitResult:
        ended = zip(self.system.robot.joint_names, parts, strict=True)
        return FitResult(
            converged=all(part.converged for part in parts),
            evaluations=sum(part.evaluations for part in parts),
            seconds=sum(part.seconds for part in parts),
            objective=sum(part.value for part in parts),
            log_marginal_likelihood=self.log_marginal_likelihood(),
            jitter=max(fitted.jitter for fitted in self._conditioned),
            constant_inputs=training.scale.constant,
            message="; ".join(f"{joint}: {part.message}" for joint, part in ended),
            history=tuple(value for part in parts for value in part.history),
        )

    @torch.no_grad()
    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
    ) -> Prediction:
        """Posterior mean and covariance of the accelerations; the covariance is diagonal.

        Args:
            q, qd, tau: `(*batch, nq)` states.
            quantity: `qdd`, the only one that this model knows.
            active: without effect, since the model does not know of contacts.
            covariance: whether to compute the covariance.

        Returns:
            Mean `(*batch, nq)` and covariance `(*batch, nq, nq)`, without measurement noise.

        Raises:
            ModelError: the model has not been fitted, or another quantity is asked for.
            ShapeError: a state does not fit the robot.
        """
        only_qdd(self, quantity)
        if self.training is None:
            raise not_fitted(self)
        flat = flat_states(self.system, q, qd, tau, active)
        features = self.training.scale.apply({"q": flat.q, "qd": flat.qd, "tau": flat.tau})
        means, variances = [], []
        for first in range(0, max(len(flat.q), 1), CHUNK_STATES):
            part = {name: x[first : first + CHUNK_STATES] for name, x in features.items()}
            mean, variance = self._predict(self.training, part, covariance)
            means.append(mean)
            variances.append(variance)
        mean = torch.cat(means).reshape(*flat.batch, self.system.robot.nq)
        if not covariance:
            return Prediction(mean, None, {"qdd": slice(0, mean.shape[-1])})
        spread = torch.cat(variances).reshape(mean.shape)
        return Prediction(mean, torch.diag_embed(spread), {"qdd": slice(0, mean.shape[-1])})

    def _predict(
        self, training: IndependentTraining, features: dict[str, Tensor], covariance: bool
    ) -> tuple[Tensor, Tensor]:
        """Mean and variance `(n, nq)` at standardized features; the variance is 0 if not asked for."""
        n = len(features["q"])
        means, variances = [], []
        for j, prior in enumerate(self.priors):
            fitted = self._conditioned[j]
            at = Block((features,), (training.qdd.new_ones(n, 1, 1),), training.qdd.new_zeros(n, 1))
            cross = cross_gram((prior,), self.hyperparameters, [self.block(training, j)], [at])
            means.append(cross.mT @ fitted.alpha)
            variance = torch.zeros_like(means[-1])
            if covariance:
                V = torch.linalg.solve_triangular(fitted.L, cross, upper=False)
                own = sub(self.hyperparameters, prior.name)
                variance = (prior.kernel.diagonal(own, features)[0] - (V * V).sum(0)).clamp(min=0.0)
            variances.append(variance)
        return torch.stack(means, dim=-1), torch.stack(variances, dim=-1)

    def save(self, path: str | Path) -> None:
        """Write the model as a folder; `forcegp.load_model` reads it back exactly."""
        from forcegp.models.baseline_files import save_independent

        save_independent(self, path)
