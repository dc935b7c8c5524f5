"""Gaussian-process priors on forces, carried to accelerations and multipliers by the known mechanics.

q̈ ~ GP(L b + H m_Q, H k_Q Hᵀ) (eq. 15), and likewise for every other quantity (eqs. 19 to 25).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset, StreamedDataset
from forcegp.errors import ModelError
from forcegp.forces.inference import check_method, is_sparse, require_double
from forcegp.forces.measurements import Training
from forcegp.forces.observations import NoiseStd, Observation
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import ForcePrior, check_priors
from forcegp.forces.priors.default import default_priors
from forcegp.forces.priors.joint import AnalyticalMean, mean_of
from forcegp.forces.state_noise import state_std_of
from forcegp.forces.student_t import check_degrees
from forcegp.gp.inducing import LIMIT, check_limit
from forcegp.gp.optimise import LearningOptions
from forcegp.models.base import FitProgress, Model
from forcegp.models.structured_fit import KIND, StructuredFit, conditioned
from forcegp.models.structured_learning import (
    chosen_of,
    given_to,
    learned,
    prepared,
    search_of,
    training_for,
)
from forcegp.models.structured_spec import Specification, check_inertia, torque_noise_of
from forcegp.models.structured_stream import Pass, neighbours_of, sample_of

FIT_COPIES = 3.0
"""Memory of a fit besides the matrices of its inference, in that of the equations of motion."""


class StructuredGP(Model[StructuredFit]):
    """A structured Gaussian process (S-GP): priors on the unknown forces of a constrained system.

    Args:
        system: robot and contacts.
        mean: `"zero"`, `"analytical"`, or an `AnalyticalMean` with some terms left out.
        force_priors: priors on the unknown forces. The default depends on the mean and on the data: around
            the analytical forces of a measured robot, `measured_priors` (friction of each joint and contact,
            noise of the torque); else `default_priors`: a `JointForcePrior`, in contact its
            `NormalForcePrior`, which changes no acceleration but keeps the uncertainty of multipliers honest,
            and around the analytical forces a `SlidingFrictionPrior` for each surface.
        noise_std: standard deviation of measured accelerations [rad/s², m/s²], one or one per joint; by
            default what the log states (`qdd_std` by sample, else its header), else 0.1.
        learn_noise: whether the noise is a hyperparameter too, starting from `noise_std`.
        analytical_parameters: a module whose `forward()` gives the robot with its analytical parameters θ_A
            as learned tensors; `None` keeps the robot as it is.
        torque_noise: standard deviation of the motor torque's white noise [N m, N], `"learn"`, `None` for
            none, or `"auto"`: learned with priors for measured robots.
        inference: `"exact"`, `"sparse"` or `"auto"`.
        inducing_points: maximum number of inducing points of one prior; fewer are taken where they suffice,
            and the result of the fit says where more would help.
        state_noise: standard deviations of the white noise of measured q and q̇ [rad, rad/s], each one number
            or one per joint; `None` for none. It counts to first order (`forces/state_noise.py`).
        inertia: `"file"` keeps that of the robot; `"auto"` identifies links and drives where held-out
            stretches of the log ask for it (`forces/inertia.py`), as the defaults of a measured robot do. It
            needs a `JointFrictionPrior` and a mean with the motor torque.
        standardize: whether the inputs of kernels are standardized; otherwise they enter in their units, as
            in the paper.
        degrees_of_freedom: ν > 2 of a Student t distribution of each sample's noise, such as 4, for logs with
            impacts and other outliers; `None` for Gaussian noise (`forces/student_t.py`).

    Example:
        >>> import forcegp, torch
        >>> system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
        >>> q, qd, tau = torch.randn(3, 20, 2, dtype=torch.float64)
        >>> qdd = forcegp.dynamics.forward_dynamics(system.robot, q, qd, tau - 0.5 * qd)
        >>> t = torch.arange(20, dtype=torch.float64)
        >>> data = forcegp.Dataset(t, q, qd, tau, qdd, system.robot.joint_names)
        >>> fit = StructuredGP(system, mean="analytical", noise_std=0.1).fit(data)
        >>> fit.predict(q, qd, tau).std.shape
        torch.Size([20, 2])

    Raises:
        ModelError, UnknownNameError: the priors do not fit the system, or the robot is not float64.
    """

    kind = KIND
    has_function_samples = True

    def __init__(
        self,
        system: ConstrainedSystem,
        mean: str | AnalyticalMean = "zero",
        force_priors: Sequence[ForcePrior] | None = None,
        noise_std: NoiseStd | None = None,
        learn_noise: bool = False,
        analytical_parameters: nn.Module | None = None,
        torque_noise: NoiseStd | str | None = "auto",
        inference: str = "auto",
        inducing_points: int = LIMIT,
        state_noise: tuple[NoiseStd, NoiseStd] | None = None,
        inertia: str | None = None,
        standardize: bool = True,
        degrees_of_freedom: float | None = None,
    ) -> None:
        require_double(system)
        form = mean_of(mean)
        priors = default_priors(system, form) if force_priors is None else tuple(force_priors)
        check_priors(priors, system)
        state_std_of(state_noise, system.robot)
        self.specified = system
        self.specification = Specification(
            system,
            form,
            priors,
            noise_std,
            learn_noise,
            analytical_parameters,
            torque_noise_of(torque_noise, priors),
            check_method(inference),
            check_limit(inducing_points),
            force_priors is None and torque_noise == "auto" and "actuation" in form.terms,
            state_noise,
            check_inertia(inertia),
            standardize,
            check_degrees(degrees_of_freedom),
        )

    @classmethod
    def of(cls, specification: Specification) -> StructuredGP:
        """A model with a given specification."""
        model = cls.__new__(cls)
        model.specified, model.specification = specification.system, specification
        return model

    @property
    def mean(self) -> AnalyticalMean:
        """Prior mean of Q."""
        return self.specification.mean

    @property
    def force_priors(self) -> tuple[ForcePrior, ...]:
        """Priors on the unknown forces."""
        return self.specification.priors

    @property
    def noise_std(self) -> NoiseStd | None:
        """Noise of measured accelerations as given, `None` for what the log states."""
        return self.specification.noise_std

    def get_params(self) -> dict[str, Any]:
        spec = self.specification
        return {
            "system": spec.system,
            "mean": spec.mean,
            "force_priors": None if spec.automatic else spec.priors,
            "noise_std": spec.noise_std,
            "learn_noise": spec.learn_noise,
            "analytical_parameters": spec.parameters,
            "torque_noise": "auto" if spec.automatic else spec.torque_noise,
            "inference": spec.inference,
            "inducing_points": spec.inducing_points,
            "state_noise": spec.state_noise,
            "inertia": spec.inertia,
            "standardize": spec.standardize,
            "degrees_of_freedom": spec.degrees_of_freedom,
        }

    def fit(
        self,
        data: Dataset | Sequence[Observation] | StreamedDataset,
        *,
        options: LearningOptions | None = None,
        learn: Iterable[str] | None = None,
        begin: Mapping[str, Tensor] | None = None,
        progress: FitProgress | None = None,
        checkpoint: str | Path | None = None,
        keep_checkpoint: bool = False,
        distributed: bool = False,
    ) -> StructuredFit:
        """Learn hyperparameters (and analytical parameters) by maximum a posteriori, then condition.

        Args:
            data: measured accelerations, any mixture of measurements, or a log that is read piece by piece,
                in memory that does not grow with its length.
            options: optimiser and its limits; L-BFGS by default, to a tolerance of 1e-9 where θ_A is learned.
            learn: what is learned: names of priors, `"noise"`, `"analytical"`. Everything else keeps the
                values (and input scales) of the previous fit, or else the initial ones. Default all; an
                empty list conditions only.
            begin: `hyperparameters` of a fit of the same kind of model, such as one to less data, where
                learning begins; by default it begins on fewer samples (`options.warm_start`).
            progress: called after each evaluation; for a streamed log also after each piece, with the samples
                so far, the number of all, and NaN.
            checkpoint: file that records the evaluations of a long fit; a fit that finds it resumes
                there, to the same bits as one without a break, and removes it at its end.
            keep_checkpoint: leave the file, to be removed once the model is saved.
            distributed: for a streamed log, share its pieces among the processes of `torch.distributed`, each
                of which makes this call and gets the same fit.

        Returns:
            The fitted model, which is also kept as `fitted`.

        Raises:
            ModelError, DataError, UnknownNameError: the data, or the checkpoint, do not fit the model.
            NumericalError: the likelihood cannot be computed.
        """
        if isinstance(data, StreamedDataset):
            sample = sample_of(self.specification, data)
            known = sample.data
        else:
            sample, known = None, data
        if self._fitted is None:
            self.specification = self.specification.for_data(known)
        chosen = None if learn is None else chosen_of(self.specification, learn)
        if chosen == () and self._fitted is not None and not isinstance(data, StreamedDataset):
            return self.condition(data)
        given = given_to(self.specification, self._fitted, known, chosen)
        self.specification, training = given.specification, given.training
        spec, file = self.specification, None if checkpoint is None else Path(checkpoint)
        spec.system.announce_states(training.samples, FIT_COPIES, f"a fit to {training.samples:,} samples")
        log, neighbours, forces = None, None, None
        if sample is not None:
            training = dataclasses.replace(training, part_of=sample.count)
            log = Pass(spec, sample, file, progress, distributed)
            neighbours = neighbours_of(spec, sample, training)
        problem = spec.problem(training)
        if given.robot is not spec.system.robot:
            system = spec.system.with_robot(given.robot)
            problem = dataclasses.replace(problem, system=system, pinned=given.pinned)
        search = search_of(spec, problem, self._fitted, chosen, options)
        lesson, saved = learned(spec, problem, search, file, progress, begin, neighbours)
        values, doubts = lesson.hyperparameters, (*given.doubts, *lesson.warnings)
        if log is not None and lesson.problem.inducing is not None:
            forces = log.forces(*lesson.problem.with_coulomb_errors(values))
        fitted = self.adopt(
            conditioned(spec, lesson.problem, values, lesson.learned, doubts, lesson.learned_on, forces)
        )
        for kept in () if keep_checkpoint else (saved, log):
            if kept is not None:
                kept.remove()
        return fitted

    def condition(
        self,
        data: Dataset | Sequence[Observation],
        hyperparameters: Mapping[str, Tensor] | None = None,
    ) -> StructuredFit:
        """Condition on other data, with the hyperparameters and input scales of the previous fit.

        Args:
            data: what to condition on.
            hyperparameters: use these instead.

        Raises:
            ModelError: the model has not been fitted, or the data do not fit it.
        """
        fitted = self.fitted
        training, doubts = training_for(self.specification, fitted, data, learned=())
        if self.specification.learn_noise and training.quantities != fitted.training.quantities:
            raise ModelError(
                "the learned noise belongs to other measurements",
                expected=", ".join(fitted.training.quantities),
                got=", ".join(training.quantities),
                hint='call fit(data, learn=["noise"]), which learns the noise alone',
            )
        values = fitted.hyperparameters if hyperparameters is None else hyperparameters
        spec, priors = self.specification, fitted.problem.priors
        if not is_sparse(spec.inference, priors, training.all_samples):
            training = fitted.with_slopes(training)
        problem = prepared(spec, dataclasses.replace(fitted.problem, training=training), values)
        return self.adopt(conditioned(spec, problem, values, warnings=doubts))

    def update(self, data: Dataset | Sequence[Observation]) -> StructuredFit:
        """Add samples to the most recent fit, as in a control loop.

        With sparse inference the cost does not depend on the number of samples seen before; with exact
        inference it grows with their square. Hyperparameters, input scales and inducing points stay as they
        are.

        Args:
            data: further measurements of the same quantities.

        Raises:
            ModelError: the model has not been fitted, or the data measure something else.
        """
        fitted = self.fitted
        training, _ = training_for(self.specification, fitted, data, learned=())
        if training.quantities != tuple(fitted.noise):
            raise ModelError(
                "an update measures other quantities than the fit",
                expected=", ".join(fitted.noise),
                got=", ".join(training.quantities),
            )
        return self.adopt(fitted.updated(training))

    def forget(
        self, what: float | Dataset | Sequence[Observation], priors: Sequence[str] | None = None
    ) -> StructuredFit:
        """Forget samples, so that later ones count for more.

        Args:
            what: a factor between 0 and 1, such as exp(−Δt/T) for a memory of T seconds, which the weight of
                all samples so far is multiplied by; or samples of the fit, which are removed.
            priors: forget only what the samples say about the forces of these priors, such as a payload: they
                drift towards their prior, and the factor is the correlation with what they were.

        Raises:
            ModelError: the model has not been fitted, its inference is exact, or the factor is out of range.
            UnknownNameError: no such prior.
            NumericalError: the samples to remove were not among those of the fit.
        """
        if isinstance(what, int | float):
            return self.adopt(self.fitted.forgetting(float(what), priors))
        training, _ = training_for(self.specification, self.fitted, what, learned=())
        return self.adopt(self.fitted.without(training))

    def adopt(self, fitted: StructuredFit) -> StructuredFit:
        """Predict with this fit from now on."""
        self._fitted = fitted
        return fitted

    def log_marginal_likelihood(self) -> float:
        """log p(y | X, θ) of the training data.

        Raises:
            ModelError: the model has not been fitted.
        """
        value = self.fitted.log_marginal_likelihood
        assert value is not None
        return value

    @property
    def hyperparameters(self) -> Mapping[str, Tensor]:
        """All learned tensors of the most recent fit, by name."""
        return self.fitted.hyperparameters

    @property
    def posterior(self) -> ForcePosterior:
        """The posterior over latent forces.

        Raises:
            ModelError: the model has not been fitted.
        """
        return self.fitted.posterior

    @property
    def training(self) -> Training:
        """What the posterior is conditioned on."""
        return self.fitted.training
