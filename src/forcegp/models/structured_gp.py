"""Gaussian-process priors on forces, carried to accelerations and multipliers by the known mechanics.

q̈ ~ GP(L b + H m_Q, H k_Q Hᵀ) (eq. 15), and likewise for every other quantity (eqs. 19 to 25).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.footprint import announce_states
from forcegp.data import Dataset
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.inference import check_method
from forcegp.forces.learn import Problem, Search
from forcegp.forces.mean import AnalyticalMean, mean_of
from forcegp.forces.measurements import NoiseStd, Observation, Training, training_of
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import ANALYTICAL, NOISE, ForcePrior, check_priors
from forcegp.forces.priors.default import default_priors
from forcegp.gp.optimise import LearningOptions
from forcegp.models.base import FitProgress, Model
from forcegp.models.structured_fit import KIND, StructuredFit, conditioned
from forcegp.models.structured_learning import in_motion, prepared, solve
from forcegp.models.structured_spec import Specification, torque_noise_of
from forcegp.storage.checkpoint import Checkpoint
from forcegp.storage.system import pack_system

FIT_COPIES = 3.0
"""Memory of a fit besides the matrices of its inference, in that of the equations of motion."""
WITH_PARAMETERS = LearningOptions(tolerance=1e-9)
"""Default options where θ_A is learned too: L-BFGS then stalls on its way for a step or two."""


class StructuredGP(Model[StructuredFit]):
    """A structured Gaussian process (S-GP): priors on the unknown forces of a constrained system.

    Args:
        system: robot and contacts.
        mean: `"zero"`, `"analytical"`, or an `AnalyticalMean` with some terms left out.
        force_priors: priors on the unknown forces. The default depends on the mean and on the data: around
            the analytical forces of a measured robot, `measured_priors` (friction of each joint and contact,
            noise of the torque); else `default_priors`: a `JointForcePrior`, and in contact its
            `NormalForcePrior`, which changes no acceleration but keeps the uncertainty of multipliers honest.
        noise_std: standard deviation of measured accelerations [rad/s², m/s²], one or one per joint; by
            default what the log states (`qdd_std` by sample, else its header), else 0.1.
        learn_noise: whether the noise is a hyperparameter too, starting from `noise_std`.
        analytical_parameters: a module whose `forward()` gives the robot with its analytical parameters θ_A
            as learned tensors; `None` keeps the robot as it is.

    Raises:
        ModelError, UnknownNameError: the priors do not fit the system.
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
    ) -> None:
        form = mean_of(mean)
        priors = default_priors(system, form) if force_priors is None else tuple(force_priors)
        check_priors(priors, system)
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
            force_priors is None and torque_noise == "auto" and "actuation" in form.terms,
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

    # -- learning ---------------------------------------------------------------------------------

    def fit(
        self,
        data: Dataset | Sequence[Observation],
        *,
        options: LearningOptions | None = None,
        learn: Iterable[str] | None = None,
        begin: Mapping[str, Tensor] | None = None,
        progress: FitProgress | None = None,
        checkpoint: str | Path | None = None,
        keep_checkpoint: bool = False,
    ) -> StructuredFit:
        """Learn hyperparameters (and analytical parameters) by maximum a posteriori, then condition.

        Args:
            data: measured accelerations, or any mixture of measurements.
            options: optimiser and its limits; L-BFGS by default, to a tolerance of 1e-9 where θ_A is learned.
            learn: what is learned: names of priors, `"noise"`, `"analytical"`. Everything else keeps the
                values (and input scales) of the previous fit, or else the initial ones. Default all; an
                empty list conditions only.
            begin: `hyperparameters` of a fit of the same kind of model, such as one to less data, where
                learning begins; by default it begins on fewer samples (`options.warm_start`).
            progress: called after each evaluation.
            checkpoint: file that records the evaluations of a long fit; a fit that finds it resumes
                there, to the same bits as one without a break, and removes it at its end.
            keep_checkpoint: leave the file, to be removed once the model is saved.

        Returns:
            The fitted model, which is also kept as `fitted`.

        Raises:
            ModelError, DataError, UnknownNameError: the data, or the checkpoint, do not fit the model.
            NumericalError: the likelihood cannot be computed.
        """
        if self._fitted is None:
            self.specification = self.specification.for_data(data)
        spec = self.specification
        options = options or (LearningOptions() if spec.parameters is None else WITH_PARAMETERS)
        chosen = self._chosen(learn)
        training, doubts = in_motion(spec, self._training(data, chosen))
        announce_states(spec.system, training.samples, FIT_COPIES, f"a fit to {training.samples:,} samples")
        problem = spec.problem(training)
        start = problem.initial(spec.learn_noise, spec.learns_torque_noise)
        before = {} if self._fitted is None else self._fitted.hyperparameters
        current = {key: before.get(key, value) for key, value in start.items()}
        held = {key: value for key, value in current.items() if key.split(".")[0] not in chosen}
        free = {key: value for key, value in start.items() if key not in held}
        if not free:
            return self.adopt(conditioned(spec, prepared(spec, problem, held), held, warnings=doubts))

        def report(evaluations: int, value: float, _: dict[str, Tensor]) -> None:
            if progress is not None:
                progress(evaluations, options.max_evaluations, value)

        search, saved = Search(free, held, options), None
        if checkpoint is not None:
            saved = Checkpoint(Path(checkpoint), _key(spec, problem, search, begin))
            saved.read(free)
            search = dataclasses.replace(search, recorded=saved.recorded)
        lesson = solve(spec, problem, search, report, begin)
        if saved is not None:
            saved.write()
        doubts = (*doubts, *lesson.warnings)
        fitted = self.adopt(conditioned(spec, lesson.problem, lesson.hyperparameters, lesson.learned, doubts))
        if saved is not None and not keep_checkpoint:
            saved.remove()
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
        training = self._training(data, learned=())
        if self.specification.learn_noise and training.quantities != fitted.training.quantities:
            raise ModelError(
                "the learned noise belongs to other measurements",
                expected=", ".join(fitted.training.quantities),
                got=", ".join(training.quantities),
                hint='call fit(data, learn=["noise"]), which learns the noise alone',
            )
        values = fitted.hyperparameters if hyperparameters is None else hyperparameters
        spec, (moving, doubts) = self.specification, in_motion(self.specification, training)
        problem = prepared(spec, dataclasses.replace(fitted.problem, training=moving), values)
        return self.adopt(conditioned(spec, problem, values, warnings=doubts))

    def update(self, data: Dataset | Sequence[Observation]) -> StructuredFit:
        """Add samples to the most recent fit, as in a control loop; needs sparse inference.

        The cost does not depend on the number of samples seen before. Hyperparameters, input scales and
        inducing points stay as they are.

        Args:
            data: further measurements of the same quantities.

        Raises:
            ModelError: the model has not been fitted, its inference is exact, or the data measure something
                else.
        """
        fitted = self.fitted
        training, _ = in_motion(self.specification, self._training(data, learned=()))
        if training.quantities != tuple(fitted.noise):
            raise ModelError(
                "an update measures other quantities than the fit",
                expected=", ".join(fitted.noise),
                got=", ".join(training.quantities),
            )
        return self.adopt(fitted.updated(training))

    def forget(self, factor: float) -> StructuredFit:
        """Multiply the weight of all samples so far by a factor, so that later ones count for more.

        Args:
            factor: between 0 and 1, such as exp(−Δt/T) for a memory of T seconds.

        Raises:
            ModelError: the model has not been fitted, its inference is exact, or the factor is out of range.
        """
        return self.adopt(self.fitted.forgetting(factor))

    def _chosen(self, learn: Iterable[str] | None) -> tuple[str, ...]:
        """What is learned, by prefix of its tensors."""
        names = (*(prior.name for prior in self.force_priors), NOISE, ANALYTICAL)
        chosen = names if learn is None else tuple(learn)
        for name in chosen:
            if name not in names:
                raise UnknownNameError("force prior to learn", name, names)
        return chosen

    def _training(self, data: Dataset | Sequence[Observation], learned: Sequence[str]) -> Training:
        spec = self.specification
        kept = {}
        if self._fitted is not None:
            scales = zip(spec.priors, self._fitted.training.scales, strict=True)
            kept = {prior.name: scale for prior, scale in scales if prior.name not in learned}
        return training_of(data, spec.system, spec.priors, spec.noise_std, kept)

    def adopt(self, fitted: StructuredFit) -> StructuredFit:
        """Predict with this fit from now on."""
        self._fitted = fitted
        return fitted

    # -- the most recent fit ----------------------------------------------------------------------

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


def _key(spec: Specification, problem: Problem, search: Search, begin: Mapping[str, Tensor] | None) -> str:
    """Identifies the learning of some tensors, on these data and this system, with these options."""
    training = problem.training
    data = [value for m in training.measurements for value in m.tensors]
    priors = [(type(prior).__name__, prior) for prior in problem.priors]
    record, robot = pack_system(problem.system)
    named = [pair for group in (search.start, search.held, begin or {}) for pair in group.items()]
    return Checkpoint.key_of(
        problem.mean, priors, spec.inference, search.options, training.quantities, *data, *training.noise_std,
        record, *robot.values(), *(part for pair in named for part in pair),
    )  # fmt: skip
