"""Parts of a structured Gaussian process, and the samples and the robot that it learns from."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.data.fields import UNKNOWN, common_recordings, common_stick_speeds, recording_number
from forcegp.errors import ModelError, check_name
from forcegp.forces.measurements import (
    Observation,
    Training,
    excluded,
    observations_of,
    period_of,
    require_measured,
    states_noise,
    training_of,
    unmeasured_forces,
    without_impacts,
    without_outliers,
)
from forcegp.forces.noise import Noise, external_std, state_std_of
from forcegp.forces.posterior import REGION
from forcegp.forces.priors.base import ANALYTICAL, COULOMB, NOISE, ForcePrior
from forcegp.forces.priors.constants import DrivePrior, OffsetPrior, PerRecording
from forcegp.forces.priors.inertial import InertialPrior, PayloadPrior
from forcegp.forces.priors.joint import AnalyticalMean, ConstantForcePrior, JointFrictionPrior
from forcegp.forces.priors.memory import DISTANCES, LONGEST_STEP, PAST, BristlePrior
from forcegp.forces.priors.residual import ResidualPrior
from forcegp.forces.problem import Problem
from forcegp.forces.term import JointTerm
from forcegp.gp.features import Standardization
from forcegp.gp.optimise import LearningOptions
from forcegp.learning.inertia import Inertia, inertia_of
from forcegp.learning.inverse_dynamics import LEAST, without_delay
from forcegp.learning.payloads import Payloads, payloads_of
from forcegp.learning.search import Search, initial
from forcegp.options import Inference
from forcegp.robot.model import RobotModel

OPTIONS, WITH_PARAMETERS = LearningOptions(), LearningOptions(tolerance=1e-9)
"""Default options, and options for learning θ_A, for which L-BFGS may stall for a step or two."""
REST_SPEED = 0.01
"""Largest joint speed at which a sample counts as being at rest [rad/s, m/s]."""
SAMPLED, OUTERMOST = 20_000, 0.005
"""Largest number of samples that determine the range of motion of a joint, and their share beyond it."""
FEWEST_MOVING = 20
"""Number of samples in motion below which samples at rest are also kept."""


@dataclass(frozen=True, eq=False)
class Specification:
    """Parts of a structured Gaussian process before it is fitted.

    Attributes:
        system: the robot and its contacts.
        mean: the prior mean of Q.
        priors: the priors on the unknown forces.
        noise: the noise of measured accelerations, torques and states.
        analytical_parameters: a module with a `forward()` method that returns the robot at θ_A, or `None`.
        automatic: whether all terms that apply to the data take part.
        inference: the method of inference.
        inertia: `"file"`, or `"auto"` to identify the inertia if the log supports it. `None` means `"auto"`
            if all terms that apply take part, and `"file"` otherwise.
    """

    system: ConstrainedSystem
    mean: AnalyticalMean
    priors: tuple[ForcePrior, ...]
    noise: Noise
    analytical_parameters: nn.Module | None = None
    automatic: bool = False
    inference: Inference = field(default_factory=Inference)
    inertia: str | None = None

    def for_data(self, data: Dataset | Sequence[Observation], adds: bool = True) -> Specification:
        """Return the specification with the noise resolved for the given data.

        Unless given, the acceleration noise is learned if torque noise is learned or sets of priors are
        compared. Joints without a measured torque have an unknown force. Contacts stick below the speeds
        specified in the header of the log.

        Args:
            adds: whether an automatic model gets all terms that apply to the data.
        """
        observations, noise = observations_of(data), self.noise
        system = self.system.with_stick_speeds(common_stick_speeds([o.data.header for o in observations]))
        learns = noise.learns_torque or self.automatic
        if learns and noise.acceleration is None and not states_noise(observations):
            noise = dataclasses.replace(noise, learn=True)
        unmeasured = unmeasured_forces(system, observations)
        if unmeasured:
            noise = dataclasses.replace(noise, external={**unmeasured, **(noise.external or {})})
        spec = dataclasses.replace(self, system=system, noise=noise)
        return spec.with_terms(observations) if self.automatic and adds else spec

    def with_terms(self, observations: Sequence[Observation]) -> Specification:
        """Return the specification with all terms that apply to a log, and with the noise of these terms."""
        past = any(
            0.0 < period_of(o.data) <= LONGEST_STEP or f"{PAST}0" in o.data.extras for o in observations
        )
        known = any(prior.remembers for prior in self.priors)
        priors = (*self.priors, BristlePrior()) if past and not known else self.priors
        priors = (*priors, *_of_recordings(observations, priors, self.system.robot))
        scale = max(o.data.header.torque_scale_std or 0.0 for o in observations)
        if scale and not any(isinstance(prior, DrivePrior) for prior in priors):
            nominal = {o.data.header.torque_constants for o in observations}
            priors = (*priors, DrivePrior(std=scale, nominal=nominal.pop() if len(nominal) == 1 else ()))
        if self.inference.method != "exact" and not any(prior.remainder for prior in priors):
            priors = (*priors, ResidualPrior())
        noise, inertia = self.noise.for_priors(priors), self.inertia or "auto"
        return dataclasses.replace(self, priors=priors, noise=noise, inertia=inertia)

    def with_spread(self, spread: tuple[float, ...]) -> Specification:
        """Return the specification with the standard deviations of the scales of torques over the log."""
        drives = [prior for prior in self.priors if isinstance(prior, DrivePrior)]
        others = [prior for prior in self.priors if not isinstance(prior, DrivePrior)]
        errors = (dataclasses.replace(prior, spread=spread, is_error=True) for prior in drives)
        return dataclasses.replace(self, priors=(*others, *errors))

    def with_priors_of(self, problem: Problem) -> Specification:
        """Return the specification with the priors of a problem, without those that were dropped."""
        by_name = {prior.name: prior for prior in self.priors}
        return dataclasses.replace(self, priors=tuple(by_name.get(p.name, p) for p in problem.priors))

    def inertia_of(self, training: Training, payloads: Payloads | None = None) -> Inertia:
        """Return the inertia identified from the training samples if requested, or that of the robot file.

        Args:
            payloads: payloads of the recordings, which are not part of the links.
        """
        scale = next((prior.std for prior in self.priors if isinstance(prior, DrivePrior)), None)
        links = self.inertia == "auto"
        if not self._identifiable or not (links or (self.automatic and scale is not None)):
            return Inertia(self.system.robot)
        mean = self.mean if payloads is None else payloads.carried(self.mean)
        inertia = inertia_of(self.system, self._laws, mean, training, scale, links)
        checked = training.free_motions >= LEAST or not bool(self.system.robot.driven.all())
        return inertia if checked else replace(inertia, doubts=_unchecked_masses(training))

    def payloads_of(self, training: Training, recordings: Sequence[str]) -> Payloads | None:
        """Return the payloads that differ between recordings, or `None` if the log does not show any.

        The links of a robot without a fixed base are not identified from free motion.
        """
        known = any(isinstance(prior, PerRecording | PayloadPrior) for prior in self.priors)
        asks = self.automatic and self.inertia == "auto" and self._identifiable and not known
        short = training.free_motions < LEAST or not bool(self.system.robot.driven.all())
        if not asks or short or len(recordings) < 2:
            return None
        return payloads_of(self.system, self._laws, self.mean, training, recordings)

    @property
    def _laws(self) -> list[JointTerm]:
        """Return the terms of joints that are eliminated if the inertia is identified."""
        return [prior for prior in self.priors if isinstance(prior, JointFrictionPrior | OffsetPrior)]

    @property
    def _identifiable(self) -> bool:
        """Whether torques are known, and no prior on links or other parameters is given."""
        given = any(isinstance(prior, InertialPrior) for prior in self.priors)
        has_friction = any(isinstance(law, JointFrictionPrior) for law in self._laws)
        known = "actuation" in self.mean.terms and self.analytical_parameters is None
        return known and has_friction and not given

    def problem(self, training: Training, robot: RobotModel | None = None) -> Problem:
        """Return the learning problem for training data.

        Args:
            robot: the robot used for learning, if it differs from that of the file.
        """
        system = self.system if robot in (None, self.system.robot) else self.system.with_robot(robot)
        noise, robot, std = self.noise, self.system.robot, None
        if noise.torque is not None and not isinstance(noise.torque, str):
            std = torch.as_tensor(noise.torque, dtype=robot.dtype, device=robot.device).expand(robot.nq)
        return Problem(
            system,
            self.priors,
            self.mean,
            training,
            self.analytical_parameters,
            std,
            state_std=state_std_of(noise.state, robot),
            external_std=external_std(noise.external, robot),
        )


def _of_recordings(
    observations: Sequence[Observation], priors: Sequence[ForcePrior], robot: RobotModel
) -> tuple[ForcePrior, ...]:
    """Return the terms that differ between recordings, if each sample belongs to one of several.

    In contact, an offset cannot be told from contact forces, which balance it.
    """
    known, names = (
        any(isinstance(prior, OffsetPrior | PerRecording) for prior in priors),
        names_of(observations),
    )
    if known or len(names) < 2:
        return ()
    q, qd = (robot.drive_motion(torch.cat([getattr(o.data, x) for o in observations])) for x in ("q", "qd"))
    recording = torch.cat([o.data.recording for o in observations])
    free = torch.cat([~o.data.active(o.data.contact_names).any(-1) for o in observations])
    masks = (free & (recording == recording_number(name)) for name in names)
    offsets = OffsetPrior(names, tuple(tuple(reverses(q[rows], qd[rows])) for rows in masks))
    return (offsets,) if any(offsets.separable) else ()


def names_of(observations: Sequence[Observation]) -> tuple[str, ...]:
    """Return the names of the recordings, or no name if some samples have none."""
    common_recordings([o.data.header for o in observations])
    if any(bool((o.data.recording == UNKNOWN).any()) for o in observations):
        return ()
    return tuple(dict.fromkeys(name for o in observations for name in o.data.recordings))


def _unchecked_masses(training: Training) -> tuple[str, ...]:
    """Return a warning if the log has contact but no measured force and too little free motion."""
    closed = sum(int(m.active.any(-1).sum()) for m in training.measurements)
    if not closed or set(training.quantities) != {"qdd"}:
        return ()
    return (
        f"{training.free_motions} samples in free motion are too few to check the masses of the robot file "
        f"(expected: at least {LEAST}), and any mass error biases the multiplier: train on more samples if "
        "the log contains free motion; otherwise, record a few seconds of it or measure the contact force",
    )


def constant_inputs(problem: Problem) -> tuple[str, ...]:
    """Return the inputs that are constant in the training data, for each prior that has inputs."""
    pairs = zip(problem.priors, problem.training.scales, strict=True)
    pairs = (pair for pair in pairs if not isinstance(pair[0], ConstantForcePrior))
    return tuple(f"{prior.name}.{name}" for prior, scale in pairs for name in scale.constant)


def problem_for(
    spec: Specification,
    before: Problem | None,
    data: Dataset | Sequence[Observation],
    chosen: Sequence[str] | None,
    part_of: int = 0,
) -> tuple[Specification, Problem, tuple[str, ...]]:
    """Return the learning problem for a first fit to data, or for a fit after an earlier one.

    Args:
        part_of: total number of samples to condition on, if the data are only part of these samples.

    Returns:
        The model, the problem, and warnings about the samples and the robot. If a first fit considers the
        inertia, the model has a prior on its remaining errors.
    """
    training, doubts = training_for(spec, before, data, chosen)
    robot = spec.system.robot
    _check_scales(spec, before)
    if before is not None and any(prior.is_error for prior in spec.priors):
        robot = before.system.robot
    elif before is None and chosen is None:
        payloads = spec.payloads_of(training, names_of(observations_of(data)))
        inertia, plain = spec.inertia_of(training, payloads), spec
        robot, doubts = inertia.robot, (*doubts, *inertia.doubts)
        if inertia.spread:
            spec = spec.with_spread(inertia.spread)
        # Errors of the inertia come last.
        further = [*([] if payloads is None else [payloads.prior]), inertia.errors]
        spec = dataclasses.replace(
            spec, priors=(*spec.priors, *(prior for prior in further if prior is not None))
        )
        if spec.priors != plain.priors:
            training, _ = training_for(spec, before, data, chosen)
    return spec, spec.problem(dataclasses.replace(training, part_of=part_of), robot), doubts


def _check_scales(spec: Specification, before: Problem | None) -> None:
    """Raise `ModelError` if torques have unknown scales, and an earlier fit took them as measured."""
    if before is None or not any(isinstance(prior, DrivePrior) for prior in spec.priors):
        return
    if not any(isinstance(prior, DrivePrior) for prior in before.priors):
        raise ModelError(
            "the torques of this log have unknown scales, and the earlier fit has none",
            expected="a log with measured torques",
            got="currents or commands of servos",
            hint="fit without after=, or import with torque_constant_std = 0 if the constants are known",
        )


def training_for(
    spec: Specification,
    before: Problem | None,
    data: Dataset | Sequence[Observation],
    learned: Sequence[str] | None,
    fewest: int = FEWEST_MOVING,
) -> tuple[Training, tuple[str, ...]]:
    """Return the training data, without an identified delay of the torque, and warnings about them.

    Priors that are not in `learned` keep the scales of their inputs. If `learned` is `None`, all priors are
    learned. Samples at rest are kept if fewer than `fewest` samples are in motion.
    """
    kept = {}
    if before is not None and learned is not None:
        scales = zip(spec.priors, before.training.scales, strict=True)
        kept = {prior.name: scale for prior, scale in scales if prior.name not in learned}
    observations, dropped, still = observations_of(data), 0, [False] * spec.system.robot.nq
    if spec.noise.learns_torque:
        observations, dropped = without_outliers(observations)
        still = still_of(spec, kept) if learned is not None else still_joints(observations)
        observations = [replace(o, data=at_rest(o.data, still)) for o in observations]
    training = training_of(observations, spec.system, spec.priors, spec.noise.acceleration, kept)
    if any(prior.delay for prior in spec.priors):
        training = without_delay(training, spec.priors)
    if spec.automatic:
        require_measured(training, spec.system)
    if not spec.noise.learns_torque:
        return training, ()
    moving, doubts = in_motion(spec.system, training, fewest)
    names = spec.system.robot.joint_names
    unmoved = [name for name, rests in zip(names, still, strict=True) if rests]
    if unmoved and learned is None:
        doubts = (*doubts, f"friction is not determined for joints that do not move: {', '.join(unmoved)}")
    return moving, (*excluded(dropped), *doubts)


def still_joints(observations: Iterable[Observation]) -> list[bool]:
    """Return for each joint whether it rests within the least distance over which friction builds up."""
    q, qd = (torch.cat([getattr(o.data, name) for o in observations]) for name in ("q", "qd"))
    return ((qd.abs().amax(0) < REST_SPEED) & (travel(q) < DISTANCES[0])).tolist()


def travel(q: Tensor) -> Tensor:
    """Return the range `(...)` of positions `(n, ...)`, without outliers."""
    share = torch.tensor([OUTERMOST, 1.0 - OUTERMOST]).to(q)
    return q[:: max(1, len(q) // SAMPLED)].quantile(share, dim=0).diff(dim=0)[0]


def reverses(q: Tensor, qd: Tensor) -> list[bool]:
    """Return for each joint whether its friction develops in both directions."""
    ways = ([x[sign * v > REST_SPEED] for sign in (1.0, -1.0)] for x, v in zip(q.mT, qd.mT, strict=True))
    return [all(len(x) > 0 and float(travel(x)) > DISTANCES[-1] for x in both) for both in ways]


def still_of(spec: Specification, scales: Mapping[str, Standardization]) -> list[bool]:
    """Return for each joint whether it rested in all samples behind the scales of friction."""
    names = [prior.name for prior in spec.priors if isinstance(prior, JointFrictionPrior)]
    still = {column for name in names if name in scales for column in scales[name].constant}
    return [f"velocity[{j}]" in still for j in range(spec.system.robot.nq)]


def at_rest(data: Dataset, still: Sequence[bool]) -> Dataset:
    """Return the data with zero velocities of the given joints below the speed of rest, as these are noise.

    Otherwise a fit would explain the static torque of a joint by the noise of its velocity, or conclude from
    torques that do not depend on this noise that the joint has no friction.
    """
    if not any(still):
        return data
    noise = data.qd.new_tensor(still).bool() & (data.qd.abs() < REST_SPEED)
    return data.replace(qd=data.qd.masked_fill(noise, 0.0))


def check_learned(spec: Specification, learn: Iterable[str]) -> None:
    """Check the names of the parts to learn, which are prefixes of the names of their tensors.

    Raises:
        UnknownNameError: a name is neither that of a prior nor that of another learnable part.
    """
    names = (*(prior.name for prior in spec.priors), NOISE, ANALYTICAL, COULOMB)
    for name in learn:
        check_name("force prior to learn", name, names)


def in_motion(
    system: ConstrainedSystem, training: Training, fewest: int = FEWEST_MOVING
) -> tuple[Training, tuple[str, ...]]:
    """Return the samples in motion and without impacts, and warnings about them."""
    moving = training.moving(REST_SPEED)
    if moving.samples < fewest:
        text = "samples are in motion: friction cannot be separated from noise at rest"
        return training, (f"only {moving.samples} {text}",)
    moving, impacts = without_impacts(moving, system)
    if not impacts:
        return moving, ()
    text = "samples in contact were excluded as impacts: they accelerate away from the surface or into it"
    return moving, (f"{impacts} {text}",)


def search_of(
    spec: Specification,
    problem: Problem,
    known: Mapping[str, Tensor],
    chosen: Sequence[str] | None,
    options: LearningOptions | None,
) -> Search:
    """Return the search for the learned parts of a problem, with initial values and fixed values.

    The scale of an error of what the robot includes is not learned.
    """
    options = options or (OPTIONS if spec.analytical_parameters is None else WITH_PARAMETERS)
    start = initial(problem, spec.noise.learn, spec.noise.learns_torque, spec.automatic)
    known = {} if chosen is None else known
    current = {key: known.get(key, value) for key, value in start.items()}
    if chosen is not None and NOISE not in chosen:
        current |= {key: value for key, value in known.items() if key.startswith(REGION)}

    errors = {prior.name for prior in problem.priors if prior.is_error or prior.is_stated}

    def is_held(name: str) -> bool:
        # If the robot includes a force, the scale of its error cannot be learned from the residuals. That of
        # a drive constant would follow from a drive that the robot lacks.
        return name in errors or (chosen is not None and name not in chosen)

    held = {key: value for key, value in current.items() if is_held(key.split(".")[0])}
    return Search({key: value for key, value in start.items() if key not in held}, held, options)
