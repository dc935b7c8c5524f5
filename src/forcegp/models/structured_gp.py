"""Gaussian-process priors on forces, mapped to accelerations and multipliers by known mechanics.

The acceleration has the prior q̈ ~ GP(L b + H m_Q, H k_Q Hᵀ) (eq. 15). Priors on all other quantities are
similar (eqs. 19 and 20). `fit` learns the hyperparameters (`learning/fit.py`) and conditions on the
data (`structured_fit.conditioned`). `gram` in `gp/likelihood.py` computes the covariance in eq. 10.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING

from torch import nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset, StreamedDataset
from forcegp.errors import ModelError, check_name
from forcegp.forces.measurements import NoiseStd, Observation, excluded, observations_of
from forcegp.forces.noise import Noise, state_std_of
from forcegp.forces.priors.base import ForcePrior, check_priors
from forcegp.forces.priors.joint import AnalyticalMean, JointFrictionPrior, mean_of
from forcegp.forces.priors.sets import default_priors, friction_priors
from forcegp.forces.problem import require_double
from forcegp.gp.optimise import LearningOptions
from forcegp.learning.fit import learned
from forcegp.learning.regression import SAMPLES, are_columns
from forcegp.learning.specification import Specification, check_learned, problem_for, search_of
from forcegp.learning.streamed import Pass, Sample, sample_of
from forcegp.models.base import FitProgress, Model
from forcegp.models.structured_fit import KIND, StructuredFit, conditioned
from forcegp.options import Inference
from forcegp.resources import one_thread

if TYPE_CHECKING:
    from distributed import Client

FIT_COPIES = 3.0
"""Memory of a fit besides its inference matrices, relative to the memory of the equations of motion."""


class StructuredGP(Model[StructuredFit]):
    """A structured Gaussian process (S-GP) with priors on the unknown forces of a constrained system.

    Args:
        system: the robot and its contacts.
        mean: `"analytical"`, `"zero"`, or an `AnalyticalMean` with a subset of its terms.
        force_priors: priors on the unknown forces. By default, with the analytical mean, all terms that apply
            to the log take part: friction of joints and contacts, bristles for logs in time order, ripple, a
            residual force on (q, q̇), and torque noise. `fit.result.worth` contains their log evidence. Terms
            that the evidence speaks against are dropped (`learning/evidence.py`). If the mean does not
            include the motor torque, the default is `default_priors`: a `JointForcePrior` and, in contact, a
            `NormalForcePrior` that affects only multipliers.
        noise: standard deviation of measured accelerations [rad/s², m/s²], as one value or one per joint, or
            a `Noise` for accelerations, torques and states. The default is the value in the log, or 0.1.
        analytical_parameters: a module with a `forward()` method that returns the robot with learned
            analytical parameters θ_A. `None` leaves the robot unchanged.
        inference: `"exact"`, `"sparse"` or `"auto"`, or an `Inference`.
        inertia: `"file"` keeps the inertia of the robot. `"auto"` identifies the inertia of links and drives
            that the log determines (`learning/inertia.py`). It requires a
            `JointFrictionPrior` and a mean that includes the motor torque. `None` means `"auto"` for
            automatically selected priors, and `"file"` otherwise.

    Example:
        >>> import forcegp, torch
        >>> system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
        >>> q, qd, tau = torch.randn(3, 20, 2, dtype=torch.float64)
        >>> qdd = forcegp.dynamics.forward_dynamics(system.robot, q, qd, tau - 0.5 * qd)
        >>> t = torch.arange(20, dtype=torch.float64)
        >>> data = forcegp.Dataset(t, q, qd, tau, qdd, system.robot.joint_names)
        >>> fit = StructuredGP(system, mean="analytical", noise=0.1).fit(data)
        >>> fit.predict(q, qd, tau).std.shape
        torch.Size([20, 2])

    Raises:
        ModelError, UnknownNameError: the priors do not match the system, or the robot is not in float64.
    """

    kind = KIND

    def __init__(
        self,
        system: ConstrainedSystem,
        mean: str | AnalyticalMean = "analytical",
        force_priors: Sequence[ForcePrior] | None = None,
        noise: NoiseStd | Noise | None = None,
        analytical_parameters: nn.Module | None = None,
        inference: str | Inference = "auto",
        inertia: str | None = None,
    ) -> None:
        self._keep(locals())
        require_double(system)
        form, stated = mean_of(mean), Noise.of(noise)
        check_name("inertia", "auto" if inertia is None else inertia, ("file", "auto"))
        around = "actuation" in form.terms
        automatic = force_priors is None and around
        if force_priors is None:
            force_priors = friction_priors(system) if around else default_priors(system, form)
        priors = tuple(force_priors)
        check_priors(priors, system)
        state_std_of(stated.state, system.robot)
        self.system = system
        self.specification = Specification(
            system,
            form,
            priors,
            stated if automatic else stated.for_priors(priors),
            analytical_parameters,
            automatic,
            inference if isinstance(inference, Inference) else Inference(inference),  # pyright: ignore
            inertia,
        )

    @property
    def mean(self) -> AnalyticalMean:
        """Prior mean of Q."""
        return self.specification.mean

    @property
    def force_priors(self) -> tuple[ForcePrior, ...]:
        """Priors on the unknown forces."""
        return self.specification.priors

    def fit(
        self,
        data: Dataset | Sequence[Observation] | StreamedDataset,
        *,
        learn: Iterable[str] | None = None,
        after: StructuredFit | None = None,
        options: LearningOptions | None = None,
        progress: FitProgress | None = None,
        client: Client | None = None,
    ) -> StructuredFit:
        """Learn the hyperparameters, and condition the forces on the data.

        If all priors consist of columns and torque noise is learned, their scales are the fixed point of the
        evidence, s² ← (s² |ŵ|² + s₀²)/(γ + 1) (MacKay, *Bayesian interpolation*, 1992; Tipping, *Sparse
        Bayesian learning*, 2001), which alternates with Fisher scoring of the variances of rows
        (`learning/evidence.py`, `learning/scales.py`). All other hyperparameters are maximum a posteriori
        estimates (`learning/search.py`).

        Args:
            data: measured accelerations, any mixture of measurements, or a streamed log. Fitting a streamed
                log requires a constant amount of memory.
            learn: the parts to learn, which are names of priors, `"noise"` or `"analytical_parameters"`.
                Other parts keep the values and input scales of the fit `after`, or their initial values. By
                default, all parts are learned. With an empty list, the forces are only conditioned.
            after: an earlier fit of this model, for example to fewer data. It provides the values of parts
                that are not learned. If `learn` is not given, it provides the initial values.
            options: the optimiser and its limits. The default is L-BFGS, with tolerance 1e-9 if θ_A is
                learned.
            progress: a function called after each evaluation. For a streamed log, it is also called after
                each piece with the number of processed samples, the total number, and NaN.
            client: a client of a Dask cluster, whose workers share the pass over a streamed log and can read
                its files. By default, this process reads the log alone.

        Returns:
            The fitted model. Repeated fits give bit-identical results.

        Raises:
            ModelError, DataError, UnknownNameError: the data, the earlier fit, or `learn` do not match the
                model.
            NumericalError: the likelihood cannot be computed.
        """
        began = time.perf_counter()
        spec = self.specification if after is None else self._continued(after)
        sample = sample_of(spec, data) if isinstance(data, StreamedDataset) else Sample(data)
        chosen = None if learn is None else tuple(learn)
        spec = spec.for_data(sample.data, adds=after is None or chosen is None)
        check_learned(spec, chosen or ())
        if chosen == () and after is not None and sample.log is None:
            return dataclasses.replace(after, specification=spec).condition(sample.data)
        count = sample.count or sum(len(each.data) for each in observations_of(sample.data))
        # Threads that wait for each other take longer than sums over few samples.
        with one_thread() if are_columns(spec.priors) and count <= SAMPLES else nullcontext():
            fit = self._learned_from(spec, sample, chosen, after, options, progress, client)
        result = dataclasses.replace(fit.result, seconds=time.perf_counter() - began)
        return dataclasses.replace(fit, result=result)

    def _learned_from(
        self,
        spec: Specification,
        sample: Sample,
        chosen: tuple[str, ...] | None,
        after: StructuredFit | None,
        options: LearningOptions | None,
        progress: FitProgress | None,
        client: Client | None,
    ) -> StructuredFit:
        """Learn the chosen parts from a sample of the log, and condition the forces on the whole log."""
        earlier, before = (None, {}) if after is None else (after.problem, after.hyperparameters)
        spec, problem, doubts = problem_for(spec, earlier, sample.data, chosen, sample.count)
        count = problem.training.samples
        spec.system.announce_states(count, FIT_COPIES, f"a fit to {count:,} samples")
        search = search_of(spec, problem, before, chosen, options)
        begins = chosen is None and after is not None
        begin = {key: before[key] for key in search.start if key in before} if begins else None
        neighbours = None if sample.log is None else sample.neighbours(spec, problem.training)
        lesson = learned(spec, problem, search, progress, begin, neighbours)
        spec, values, forces = spec.with_priors_of(lesson.problem), lesson.hyperparameters, None
        if sample.log is not None and lesson.problem.inducing is not None:
            whole = Pass(spec, sample.log, sample, client, progress)
            forces = whole.forces(*lesson.problem.with_coulomb_errors(values))
        warnings = (*excluded(sample.outliers), *doubts, *lesson.warnings)
        fit = conditioned(spec, lesson.problem, values, lesson.learned, warnings, lesson.learned_on, forces)
        if progress is not None:
            progress(fit.result.evaluations, fit.result.evaluations, fit.result.objective)
        warnings = (*fit.result.warnings, *self._without_effect(fit))
        result = dataclasses.replace(fit.result, worth=dict(lesson.worth), warnings=warnings)
        return dataclasses.replace(fit, result=result)

    def _without_effect(self, fit: StructuredFit) -> Iterator[str]:
        """Yield a warning for each given option that had no effect on a fit."""
        points = [x for Z in fit.problem.inducing or () for x in Z.values()]
        most = self.specification.inference.inducing_points
        if most != Inference().inducing_points and not any(map(len, points)):
            how = "exact inference" if fit.problem.inducing is None else "priors with finitely many features"
            yield f"inducing_points={most} has no effect: the fit has {how}"
        friction = any(isinstance(prior, JointFrictionPrior) for prior in fit.force_priors)
        if self.specification.inertia == "auto" and not (friction and "actuation" in self.mean.terms):
            lacks = "the motor torque in its mean" if friction else "a JointFrictionPrior"
            yield f'inertia="auto" has no effect: the model lacks {lacks}'

    def _continued(self, after: StructuredFit) -> Specification:
        """Return this model with the priors of an earlier fit, including automatically selected priors."""
        spec = self.specification
        stated = () if self.specification.automatic else tuple(prior.name for prior in self.force_priors)
        names = tuple(prior.name for prior in after.force_priors)
        contacts = after.system.contact_names
        if names[: len(stated)] != stated or contacts != self.system.contact_names:
            raise ModelError(
                "`after` is a fit of a different model",
                expected=f"priors {', '.join(stated)} and contacts {', '.join(self.system.contact_names)}",
                got=f"priors {', '.join(names)} and contacts {', '.join(contacts)}",
            )
        robots = [system.robot for system in (self.system, after.specified)]
        if robots[0].fingerprint != robots[1].fingerprint:
            raise ModelError(
                "`after` is a fit of another robot",
                expected=f"{robots[0].name!r} with the parameters, base and gravity of this model",
                got=f"{robots[1].name!r}, which differs in them",
                hint="fit this model to the data of its own robot first",
            )
        if spec.automatic:
            return after.specification
        return dataclasses.replace(spec, priors=after.specification.priors)
