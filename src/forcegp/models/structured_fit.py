"""Fitted structured Gaussian processes. All quantities follow from forces conditioned on data."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.compiled_system import compiled_system
from forcegp.data import Dataset
from forcegp.errors import DataError, ModelError, check_name
from forcegp.files import Record
from forcegp.forces.external_wrench import WrenchFrame
from forcegp.forces.measurements import Observation, Training
from forcegp.forces.noise import TORQUE_NOISE, learned_slopes
from forcegp.forces.posterior import (
    GROWTH,
    LOW,
    ForcePosterior,
    distance_beyond,
    doubts_of,
    draw_samples,
    unknown_variance,
)
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.constants import PerRecording
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.memory import bristles
from forcegp.forces.problem import (
    Problem,
    forces_and_constant,
    is_sparse,
    lost_by_inducing,
    of_unknown_recording,
    typical,
)
from forcegp.forces.quantities import (
    AffineMap,
    FlatStates,
    ForceField,
    States,
    affine_map,
    affine_maps,
    flat_states,
    hidden_forces,
)
from forcegp.forces.unknowns import tip_factor
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.optimise import Learned
from forcegp.gp.sparse import SparsePosterior
from forcegp.learning.fit import prepared
from forcegp.learning.specification import Specification, constant_inputs, training_for
from forcegp.models.base import FittedModel
from forcegp.models.export.folder import Export, write_export
from forcegp.models.export.library import CompiledFit
from forcegp.models.export.model import ExportedModel
from forcegp.models.export.motion import CompiledMotion, compiled_motion
from forcegp.models.external_wrench import ExternalWrench, contact_force, external_wrench
from forcegp.models.fit_result import FitResult
from forcegp.models.parameter_std import parameter_std
from forcegp.models.parameters import LearnedParameter, learned_parameters
from forcegp.models.prediction import Answer, Prediction, Query, in_pieces
from forcegp.models.robot_parameters import RobotParameter, robot_parameters
from forcegp.models.structured_file import pack, unpack
from forcegp.rollout.inputs import Disturbance
from forcegp.storage.model_file import ModelHeader

KIND = "structured_gp"
JOINED = 256
"""Number of updates after which the digests of their samples are merged."""


@dataclass(frozen=True, eq=False, repr=False)
class StructuredFit(FittedModel):
    """Force priors conditioned on data, with learned hyperparameters.

    Attributes:
        specification: the specification of the model.
        problem: the training data with the robot, priors and noise.
        hyperparameters: all learned tensors, keyed by name.
        posterior: the posterior over the latent forces.
        result: the result of the fit.
        system: the robot with its learned parameters, and its contacts.
        noise: the standard deviation of the noise `(d,)` for each measured quantity.
        added: digests of the samples that `forget` can remove from a sparse posterior.
    """

    specification: Specification
    problem: Problem
    hyperparameters: Mapping[str, Tensor]
    posterior: ForcePosterior
    result: FitResult
    system: ConstrainedSystem
    noise: Mapping[str, Tensor]
    added: tuple[Tensor, ...] = ()

    kind = KIND
    has_function_samples = True
    has_noise = True

    def described(self) -> list[tuple[str, object]]:
        return [
            ("training samples", sum(len(part.q) for part in self.training.measurements)),
            *((f"prior {prior.name}", type(prior).__name__) for prior in self.posterior.priors),
            *((f"noise of {name}", std) for name, std in self.noise.items()),
            *([] if self.torque_std is None else [("noise of the torque", self.torque_std)]),
            *((f"log evidence of {name}", f"{worth:.1f}") for name, worth in self.result.worth.items()),
        ]

    @property
    def training(self) -> Training:
        """Data on which the posterior is conditioned."""
        return self.problem.training

    @property
    def force_priors(self) -> tuple[ForcePrior, ...]:
        """Priors on the unknown forces, including automatically selected priors."""
        return self.posterior.priors

    def at(self, flat: FlatStates, query: Query) -> Answer:
        system = query.system or self.system
        unseen = self.result.never_closed if query.system is None else ()
        at = flat.with_equations(system)
        if at.recording is not None and any(
            isinstance(prior, PerRecording) for prior in self.posterior.priors
        ):
            at = self._consistent(system, at)
        elif query.covariance and any(isinstance(prior, InertialPrior) for prior in self.posterior.priors):
            # Inertia errors are multiplied by the predicted acceleration.
            qdd = self.posterior.read_mean(system, at, affine_map(system, at, "qdd"))
            at = dataclasses.replace(at, qdd=qdd)
        z, parts = affine_maps(system, at, query.quantity)
        if query.covariance:
            mean, spread = self._read(system, at, z, parts, query.noise)
        else:
            mean, spread = self.posterior.read_mean(system, at, z), None
        hidden, beyond = hidden_forces(system, at, parts, unseen), self._distance(at.qd, at.tau)
        if hidden is None:
            return (mean, spread, beyond, torch.ones_like(mean, dtype=torch.bool)), parts, ()
        return (*hidden.applied(mean, spread), beyond, ~hidden.whole), parts, hidden.doubts

    def _consistent(self, system: ConstrainedSystem, at: States) -> States:
        """Return states at the accelerations that solve q̈ = f(q̈), where forces are affine in q̈."""
        z = affine_map(system, at, "qdd")

        def mean(qdd: Tensor) -> Tensor:
            return self.posterior.read_mean(system, dataclasses.replace(at, qdd=qdd), z)

        zero = torch.zeros_like(at.q)
        free = mean(zero)
        slopes = torch.stack([mean(zero + e) - free for e in torch.eye(zero.shape[-1]).to(zero)], dim=-1)
        qdd = torch.linalg.solve(torch.eye(zero.shape[-1]).to(zero) - slopes, free[..., None])[..., 0]
        return dataclasses.replace(at, qdd=qdd)

    def _read(
        self, system: ConstrainedSystem, at: States, z: AffineMap, parts: Mapping[str, slice], noise: bool
    ) -> tuple[Tensor, Tensor]:
        """Return the mean and covariance of quantities, including unknown forces and, if requested, noise."""
        mean, spread = self.posterior.read(system, at, z)
        z = self.posterior.process.coupled(system, at, z)
        of_all = z if z.B_F is None else z._replace(B_Q=z.B_Q + z.B_F)
        spread = spread + _carried(
            of_all, unknown_variance(self.hyperparameters, at, self.problem.external_std)
        )
        tips = tip_factor(self.hyperparameters, system, at)
        if tips is not None:
            spread = spread + (z.B_z @ tips) @ (z.B_z @ tips).mT
        return mean, spread + self._noise_covariance(z, parts) if noise else spread

    def parameter_std(self) -> dict[str, Tensor]:
        """Return the standard deviations of the robot parameters learned as `analytical_parameters`.

        They are those of the Laplace approximation (`models/parameter_std.py`), at the learned kernels and
        noise. The unknown forces are marginalised.

        Returns:
            σ of each learned field of `fit.system.robot`, keyed by its name and of its shape, in SI units. It
            is zero for parameters that are not learned, and infinite if the data do not determine them.

        Raises:
            ModelError: no robot parameters were learned, or the training data were not saved.

        Example:
            `mass, std = fit.system.robot.mass[-1], fit.parameter_std()["mass"][-1]`
        """
        return parameter_std(self.problem, self.hyperparameters)

    def predict_log(
        self,
        data: Dataset,
        quantity: str | Sequence[str] = "qdd",
        *,
        covariance: bool = True,
        noise: bool = False,
    ) -> Prediction:
        """Predict quantities along a log in time order, with friction with memory and offsets of recordings.

        The state of a bristle follows from the velocities before a sample (`forces/priors/memory.py`), which
        a single state does not contain. Constants of a recording are those of the training recording with
        the same name. In other recordings, they are unknown (`forces/priors/constants.py`).

        Args:
            data: the log, with the measured torques.
            quantity, covariance, noise: see `predict`.

        Raises:
            DataError: the log does not match the robot, or is not in time order.

        Example:
            `fit.predict_log(log, noise=True).std`
        """
        data.check_robot(self.specified.robot)
        if not data.header.ordered:
            raise DataError("friction with memory needs a log in time order", got="points in another order")
        active, history = data.active(self.system.contact_names), None
        if any(prior.remembers for prior in self.force_priors):
            history = bristles(data.t, self.system.robot.drive_motion(data.qd), data.segment)
        flat = flat_states(self.system, data.q, data.qd, data.tau, active)
        flat = flat._replace(history=history, recording=data.recording[:, None])
        with torch.no_grad():
            return self._answered(flat, Query(quantity, None, covariance, noise))

    def parameters(self) -> tuple[LearnedParameter, ...]:
        """Return the learned weights of all columns in SI units, with standard deviations.

        The columns of a law are nearly collinear, so that their sum is often known far better than each.

        Example:
            `for each in fit.parameters(): print(each.name, each.value, each.std, each.unit)`
        """
        return learned_parameters(self.posterior, self.hyperparameters, self.system.robot)

    def robot_parameters(self) -> tuple[RobotParameter, ...]:
        """Return the learned parameters of the robot and its contacts, with standard deviations.

        Friction and offsets are averages over training samples, which files of sparse fits do not contain.

        Example:
            `for each in fit.robot_parameters(): print(each.name, each.of, each.value, each.std, each.unit)`
        """
        friction, file = self.hyperparameters, self.specified.robot
        columns, training = self.parameters(), self.problem.training
        return robot_parameters(self.posterior, columns, friction, training, file, self.system)

    def external_wrench(
        self,
        data: Dataset,
        frame: str,
        *,
        method: str = "acceleration",
        external: Mapping[str, float] | None = None,
        **components: Any,
    ) -> ExternalWrench:
        """Estimate the wrench that the environment exerts on a frame.

        The wrench w acts in addition to learned forces and closed contacts: M q̈ = Q̄ + Aᵀλ + Jᵀ w
        (`forces/external_wrench.py`). `method="acceleration"` estimates w separately for each sample by
        generalized least squares. `method="momentum"` runs a causal Kalman filter over each trajectory and
        needs no accelerations. For logs in time order, the learned forces include friction with memory.

        Args:
            data: a log. The momentum filter requires a log in time order.
            frame: the name of a frame of the robot.
            method: `"acceleration"` or `"momentum"`.
            external: standard deviations [N m, N], by joint name, of unknown joint forces that did not act in
                the training log, such as those of a hand that pushes the arm.
            **components: the arguments `reference` (`"world"` or `"local"`), `axes` (some of `fx`, `fy`,
                `fz`, `mx`, `my` and `mz`), `point`, `prior_std` and `change` of `WrenchFrame`. Components
                that are not in `axes` are zero.

        Returns:
            An `ExternalWrench` with a mean `(n, k)` and a covariance `(n, k, k)` [N, N m].

        Raises:
            UnknownNameError: the frame, reference, component or method does not exist.
            ParameterError: a number is out of range.
            DataError: the log does not match the robot, or is not in time order.
            ModelError: the fit has no torque noise, which the momentum filter requires.

        Example:
            `wrench = fit.external_wrench(log, "tool", axes=("fx", "fy", "fz"), method="momentum")`
        """
        data.check_robot(self.specified.robot)
        return external_wrench(self, data, WrenchFrame(frame, **components), method, external)

    def contact_force(
        self, data: Dataset, contact: str | None = None, *, prior_std: tuple[float, float] | None = None
    ) -> Prediction:
        """Estimate the forces on the robot at closed contacts along a log, from the measured accelerations.

        Forces F = λ (n − μ s(v)) + F_z + u act in addition to the learned joint forces: M q̈ = Q + Σ J_EᵀF.
        Coulomb friction μ and other friction F_z at the contact are those of the fit. The tangential force u
        of a contact at rest is unknown. λ and u are estimated by generalized least squares, as is an external
        wrench (`forces/external_wrench.py`). `predict` does without accelerations and is less accurate.

        Args:
            data: a log with accelerations. Friction with memory is included if it is in time order.
            contact: the name of a surface contact; by default, the forces of all of them are returned.
            prior_std: prior standard deviations of the normal force and of the tangential force at rest [N].
                By default, the normal force is free, and the tangential force has the learned size.

        Returns:
            The mean `(n, 3 c)` and covariance `(n, 3 c, 3 c)` of c contacts in world axes [N], both zero for
            open contacts. With several contacts, `parts` has the slice of each.

        Raises:
            UnknownNameError: the contact does not exist.
            ModelError: the contact has no surface, or no contact has one.
            DataError: the log does not match the robot.

        Example:
            `force = fit.contact_force(log)`
        """
        data.check_robot(self.specified.robot)
        return contact_force(self, data, contact, prior_std)

    def _exported(
        self,
        functions: int | None,
        wrench: WrenchFrame | None = None,
        dtype: torch.dtype = torch.float64,
        jacobians: bool = True,
        online: bool = True,
    ) -> ExportedModel:
        if functions is not None and functions < 1:
            raise ModelError("at least one function must be drawn", expected="1 or more", got=functions)
        tensors = {**self.hyperparameters, **self._region}
        posterior = of_unknown_recording(self.problem, self.hyperparameters, self.posterior)
        parts = self.system, posterior, tensors, self.noise, self.torque_std
        learned, std = self.hyperparameters.get(TORQUE_NOISE), self.problem.torque_std
        std = learned.exp() if learned is not None else 0.0 if std is None else std
        variance = torch.zeros_like(self.system.robot.mass) + std**2
        moving = self.specification.noise.learns_torque
        # With state noise, the rows of a sample depend on the slopes of the learned forces.
        learns = online and self.problem.state_std is None
        sampling = (variance, self.problem.power, moving) if learns else None
        never = self.result.never_closed
        parts = *parts, self.problem.external_std, functions, sampling, wrench, dtype, never, jacobians
        return ExportedModel(*parts)

    def export(
        self,
        path: str | Path,
        *,
        language: str = "c",
        name: str = "controller",
        functions: int | None = None,
        wrench: WrenchFrame | None = None,
        dtype: torch.dtype = torch.float64,
        jacobians: bool = True,
        online: bool = True,
    ) -> Export:
        """Export the fit as C99 code with a test program, or its mean as a CasADi function.

        The C code requires only libm. It maps (q, q̇, τ, closed contacts) to the mean and covariance of every
        quantity, and to the Jacobians of the mean. With q̈, it estimates the forces of all contacts, as
        `contact_force` does. The CasADi function returns the mean, with exact derivatives of any order.

        Args:
            path: the folder to create.
            language: `"c"` or `"casadi"`.
            name: name of the files, and prefix of all identifiers in them.
            functions: number of basis functions in a reduced-rank covariance. `None` uses all of them, or 200
                in C code if there are more than 1700.
            wrench: frame and components of an external wrench to estimate from the state and accelerations.
            dtype: precision of the C code, `torch.float64` or `torch.float32`.
            jacobians: whether C code includes Jacobians. For a legged robot, they are most of the code.
            online: whether C code can learn online. If not, code for uncertain inertia is faster.

        Returns:
            The folder, the growth of error bars caused by a reduced-rank covariance, and the errors caused by
            single precision. Both are measured at training states.

        Raises:
            ModelError: a prior, kernel or contact cannot be exported to C.
            NumericalError: single precision cannot resolve a variance.
            UnknownNameError, ParameterError: the language or frame is unknown, or the name is not a C
                identifier.
            DestinationError: the folder cannot be written, or contains other files.
            MissingDependencyError: CasADi is not installed.
        """
        model = self._exported(functions, wrench, dtype, jacobians, online)
        return write_export(model, self, self.training, path, language, name)

    def compiled(
        self,
        *,
        functions: int | None = None,
        wrench: WrenchFrame | None = None,
        jacobians: bool = True,
        online: bool = True,
    ) -> CompiledFit:
        """Compile the fit to a fast predictor in C with the local compiler.

        Args:
            functions: number of basis functions in a reduced-rank covariance, which is never smaller than the
                full covariance. `None` uses all of them.
            wrench: the frame and components that `external_wrench` estimates.
            jacobians: whether to compile `jacobian` and `linearize`, a minute for a legged robot.
            online: whether to compile `update`. Without it, predictions with uncertain inertia are faster.

        Raises:
            ModelError: a prior, kernel or contact cannot be exported to C, or the posterior is too large.
            UnknownNameError: the frame does not exist.
            MissingDependencyError: there is no C++ compiler.
        """
        return CompiledFit(self._exported(functions, wrench, jacobians=jacobians, online=online))

    def beyond(self, qd: Tensor, tau: Tensor) -> Tensor | None:
        """Return how far speeds and torques exceed the training data, `(*batch, nq)`, in standard deviations
        of these data. The result is `None` if the model file does not contain the trained region.
        """
        return self._distance(qd, self.system.robot.true_torque(tau))

    def _distance(self, qd: Tensor, tau: Tensor) -> Tensor | None:
        """Return this distance for torques that act, not nominal ones."""
        region = self._region
        return distance_beyond(region, qd, tau) if LOW in region else None

    @property
    def _region(self) -> Mapping[str, Tensor]:
        """Return the trained region, which is that of the calibrated noise or else of the training data."""
        calibrated = GROWTH in self.hyperparameters or not self.training.samples
        return self.hyperparameters if calibrated else self.problem.region

    def force_field(self) -> ForceField:
        """Return the posterior mean of Q̄ = Q + Q_z as a force field."""
        return self.posterior

    def force_samples(self, samples: int, generator: torch.Generator) -> ForceField:
        """Return functions drawn from the posterior as a force field."""
        return draw_samples(self.posterior, samples, generator)

    def compiled_motion(self, system: ConstrainedSystem, force: ForceField) -> CompiledMotion | None:
        """Return C code for the motion under the posterior mean or under function samples."""
        model = dataclasses.replace(self._exported(None), system=system, functions=0)
        return compiled_motion(model, force, self.specified)

    def condition(
        self, data: Dataset | Sequence[Observation], hyperparameters: Mapping[str, Tensor] | None = None
    ) -> StructuredFit:
        """Condition the forces on different data, with the same hyperparameters and input scales.

        Args:
            data: the data to condition on.
            hyperparameters: hyperparameters to use in place of those of the fit.

        Raises:
            ModelError: the data are incompatible with the model.
        """
        spec = self.specification
        training, doubts = training_for(spec, self.problem, data, learned=())
        if spec.noise.learn and training.quantities != self.training.quantities:
            raise ModelError(
                "the learned noise belongs to other measurements",
                expected=", ".join(self.training.quantities),
                got=", ".join(training.quantities),
                hint='call model.fit(data, learn=["noise"], after=fit), which learns only the noise',
            )
        values = self.hyperparameters if hyperparameters is None else hyperparameters
        if not is_sparse(spec.inference.method, self.problem.priors, training.all_samples):
            training = self._with_slopes(training)
        problem = prepared(spec, dataclasses.replace(self.problem, training=training), values)
        return conditioned(spec, problem, values, warnings=doubts)

    def update(self, data: Dataset | Sequence[Observation]) -> StructuredFit:
        """Add samples, for example in a control loop.

        With sparse inference, the cost does not depend on the number of previous samples. With exact
        inference, it grows quadratically. Hyperparameters, input scales and inducing points do not change.

        Args:
            data: additional measurements of the same quantities.

        Raises:
            ModelError: the data contain different quantities.
        """
        measurements, _ = training_for(self.specification, self.problem, data, learned=(), fewest=0)
        if measurements.quantities != tuple(self.noise):
            raise ModelError(
                "the update contains quantities that the fit does not",
                expected=", ".join(self.noise),
                got=", ".join(measurements.quantities),
            )
        if not measurements.samples:
            return self
        measurements = self._with_slopes(measurements)
        problem = self._problem_of(measurements)
        rows = problem.rows(self.hyperparameters).blocks
        before = self.added if len(self.added) < JOINED else (torch.cat(self.added),)
        updated = self._with(self.posterior.latent.updated(rows), (*before, measurements.digests))
        never = set(self.result.never_closed) & set(measurements.never_closed(self.system))
        result = dataclasses.replace(self.result, never_closed=tuple(sorted(never)))
        updated = dataclasses.replace(updated, result=result)
        if isinstance(self.posterior.latent, SparsePosterior):
            return updated
        noise = [problem.noise_at(self.hyperparameters, i) for i in range(len(measurements.measurements))]
        whole = dataclasses.replace(self.problem, training=self.training.joined(measurements, noise))
        return dataclasses.replace(updated, problem=whole)

    def _with_slopes(self, measurements: Training) -> Training:
        """Return the measurements with the slopes of the learned forces if the fit uses slopes."""
        if self.training.slopes is None:
            return measurements
        return learned_slopes(measurements, self.system, self.posterior)

    def _problem_of(self, measurements: Training) -> Problem:
        """Return the problem with the given measurements and the learned robot, using compiled mechanics."""
        system = compiled_system(self.system)
        problem = dataclasses.replace(self.problem, training=measurements, system=system, parameters=None)
        return problem.with_coulomb_errors(self.hyperparameters)[0]

    def forget(
        self, what: float | Dataset | Sequence[Observation], priors: Sequence[str] | None = None
    ) -> StructuredFit:
        """Remove given samples, or reduce the weight of all previous samples.

        Args:
            what: samples to remove from the fit, or a factor between 0 and 1 by which the weight of all
                previous samples is multiplied. For a memory of T seconds, the factor is exp(−Δt/T).
            priors: names of the priors to which forgetting is limited, such as a payload. Their forces drift
                towards the prior, and the factor is the correlation of these forces with the previous ones.

        Raises:
            ModelError: inference is exact, the factor is out of range, or a sample to remove was never added,
                is partly forgotten, or belongs to a streamed log.
            UnknownNameError: a prior does not exist.
        """
        latent = self.posterior.latent
        if not isinstance(latent, SparsePosterior):
            raise ModelError(
                "a fit with exact inference cannot forget",
                hint='create the model with inference="sparse", or condition it on the relevant data',
            )
        if not isinstance(what, int | float):
            without, _ = training_for(self.specification, self.problem, what, learned=(), fewest=0)
            if not without.samples:
                return self
            remaining = _without(self.added, without.digests)
            rows = self._problem_of(without).rows(self.hyperparameters)
            return self._with(latent.without(rows.blocks), remaining)
        factor = float(what)
        if priors is not None:
            names = [prior.name for prior in self.posterior.priors]
            for name in priors:
                check_name("force prior to forget", name, names)
            return self._with(latent.drifting(factor, [names.index(name) for name in priors]))
        if not 0.0 < factor <= 1.0:
            raise ModelError("invalid forgetting factor", expected="above 0, at most 1", got=factor)
        return self._with(latent.forgetting(factor))

    def _with(
        self, latent: ExactPosterior | SparsePosterior, added: tuple[Tensor, ...] = ()
    ) -> StructuredFit:
        """Return the fit with a new posterior that can forget the samples in `added`."""
        posterior = dataclasses.replace(self.posterior, latent=latent)
        return dataclasses.replace(self, posterior=posterior, added=added)

    @classmethod
    def restored(
        cls, header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
    ) -> StructuredFit:
        added = (tensors["added"],) if "added" in tensors else ()
        return cls(*unpack(header, tensors, system, source), added)

    def record(self) -> tuple[Record, dict[str, Tensor]]:
        values = {**self.hyperparameters, **self._region}
        settings, tensors = pack(self.specification, self.problem, values, self.posterior, self.result)
        tensors |= {"added": torch.cat(self.added)} if self.added else {}
        return settings, tensors | {f"noise_std.{name}": std for name, std in self.noise.items()}

    @property
    def torque_std(self) -> Tensor | None:
        """Standard deviation of the motor torque noise `(nq,)`, or `None` if there is no torque noise."""
        learned = self.hyperparameters.get(TORQUE_NOISE)
        if self.problem.torque_std is not None:
            return self.problem.torque_std
        return None if learned is None else learned.exp()

    @property
    def specified(self) -> ConstrainedSystem:
        """System before the fit, with the robot from the file."""
        return self.specification.system

    @property
    def disturbance(self) -> Disturbance | None:
        """Torque noise as s √T (standard deviation s, correlation time T), and the size of unknown forces.

        Over times longer than T, the noise acts as white noise with spectral density s² T.
        """
        none, density = torch.zeros_like(self.system.robot.mass[:1]).expand(self.system.robot.nq), None
        if self.torque_std is not None and self.problem.correlation is not None:
            density = self.torque_std * self.problem.correlation.sqrt()
        external = self.problem.external_std
        if density is None and external is None:
            return None
        return Disturbance(none if density is None else density, none if external is None else external)

    def _noise_covariance(self, z: AffineMap, parts: Mapping[str, slice]) -> Tensor:
        """Return the noise covariance B Σ_τ Bᵀ + Σ_q̈ of measured quantities, `(n, d, d)`."""
        noise = z.o.new_zeros(*z.o.shape, z.o.shape[-1])
        if self.torque_std is not None:
            noise = noise + _carried(z, self.torque_std**2)
        for quantity, rows in parts.items():
            if quantity in self.noise:
                variance = torch.zeros_like(z.o[0])
                variance[rows] = self.noise[quantity] ** 2
                noise = noise + torch.diag(variance)
        return noise

    @torch.no_grad()
    def noise_variance(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str = "qdd",
        active: Tensor | None = None,
        *,
        sensor: bool = True,
    ) -> Tensor:
        """Return the variance that noise adds to measurements of a quantity, `(*batch, d)`.

        Args:
            q, qd, tau: states, `(*batch, nq)`.
            quantity: the measured quantity. Torque noise affects every quantity. Sensor noise is known only
                for quantities that were used in training.
            active: mask `(*batch, n_contacts)` of closed contacts. By default, all contacts are closed.
            sensor: whether to include sensor noise.
        """

        def read(flat: FlatStates) -> tuple[Tensor | None, ...]:
            at = flat.with_equations(self.system)
            z, parts = affine_maps(self.system, at, quantity)
            z = self.posterior.process.coupled(self.system, at, z)
            return (self._noise_covariance(z, parts if sensor else {}).diagonal(dim1=-2, dim2=-1),)

        [noise] = in_pieces(flat_states(self.system, q, qd, tau, active), read)
        assert noise is not None
        return noise


def _without(added: tuple[Tensor, ...], removed: Tensor) -> tuple[Tensor, ...]:
    """Return the digests of the samples that remain after some have been removed."""
    values, counts = torch.cat([*added, removed]).unique(return_counts=True)
    _, occurrences = torch.cat([values, removed]).unique(return_counts=True)
    remaining = counts - 2 * (occurrences - 1)
    if bool((remaining < 0).any()):
        raise ModelError(
            f"{int(-remaining.clamp(max=0).sum())} of {len(removed)} samples to forget were never added",
            expected="samples of this fit with their full weight, not from a streamed log",
        )
    return (values.repeat_interleave(remaining),)


def _carried(z: AffineMap, variance: Tensor) -> Tensor:
    """Return the covariance B Σ Bᵀ `(n, d, d)` that white noise on the joint force causes."""
    return (z.B_Q * variance[..., None, :]) @ z.B_Q.mT


@torch.no_grad()
def conditioned(
    specification: Specification,
    problem: Problem,
    hyperparameters: Mapping[str, Tensor],
    learned: Learned | None = None,
    warnings: Sequence[str] = (),
    learned_on: int | None = None,
    forces: tuple[ForcePosterior, Tensor] | None = None,
) -> StructuredFit:
    """Condition the forces on the data of a problem with given hyperparameters.

    Args:
        learned_on: number of samples used for learning.
        forces: the result of conditioning if the problem contains only part of the log.

    Raises:
        NumericalError: the covariance of the data is not positive definite.
    """
    measured = enumerate(problem.training.measurements)
    noise = {m.quantity: typical(problem.noise_at(hyperparameters, i)) for i, m in measured}
    posterior, constant = forces or forces_and_constant(*problem.with_coulomb_errors(hyperparameters))
    lost, more_points = lost_by_inducing(posterior)
    likelihood, jitter = posterior.latent.log_likelihood - float(constant), posterior.latent.jitter
    learned = learned or Learned({}, -likelihood, True, 0, 0.0, "conditioned, nothing learned")
    training, system = problem.training, problem.system_at(hyperparameters)
    correlation, doubts = doubts_of(posterior, system, training, problem.power)
    result = FitResult(
        **learned.outcome,
        log_marginal_likelihood=likelihood,
        jitter=jitter,
        constant_inputs=constant_inputs(problem),
        force_correlation=correlation,
        warnings=(*warnings, *learned.doubts, *doubts, *more_points),
        samples=training.all_samples,
        learned_on=learned_on,
        never_closed=training.never_closed(system),
        **lost,
    )
    remembers = forces is None and isinstance(posterior.latent, SparsePosterior)
    added = (training.digests,) if remembers else ()
    return StructuredFit(specification, problem, hyperparameters, posterior, result, system, noise, added)
