"""Parts of a structured Gaussian process, and the steps of learning it.

1. Samples at rest only bound the friction, and impacts break the equations of motion;
   measured robots learn from motion without impacts.
2. Hyperparameters are learned on a part of a long log, or on all of a short one.
3. Residuals that are correlated in time temper the likelihood, unless a `DisturbancePrior` explains them;
   they also determine slopes and weights (`forces/noise_learning.py`), and hyperparameters are learned again.
4. Inertial parameters move to their posterior mean: one Gauss–Newton step, physically consistent.
5. Torque noise is increased to that on held-out stretches of the training log, and its growth beyond the
trained speeds and torques is learned from held-out regimes; dry friction with memory is learned from the
residuals of logs in order of time. 6. The posterior is conditioned on all samples.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.data.fields import common_header
from forcegp.dynamics import mass_matrix
from forcegp.errors import check_name
from forcegp.forces.calibration import calibrated_noise, residual_times
from forcegp.forces.friction_memory import MEMORY, memory_of
from forcegp.forces.inertia import VOLUME_STATES, Inertia, inertia_of, with_updated_robot
from forcegp.forces.inverse_dynamics import LEAST
from forcegp.forces.measurements import (
    Observation,
    Training,
    observations_of,
    states_noise,
    training_of,
    unmeasured_forces,
    without_impacts,
)
from forcegp.forces.noise import TORQUE_NOISE, Noise, external_std, state_std_of
from forcegp.forces.noise_learning import left_out, weighted, with_learned_slopes
from forcegp.forces.posterior import REGION
from forcegp.forces.priors.base import ANALYTICAL, COULOMB, NOISE, ForcePrior
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import AnalyticalMean, JointFrictionPrior
from forcegp.forces.priors.sets import PriorSet
from forcegp.forces.problem import Problem, is_finite, is_sparse, with_inducing, without_inducing
from forcegp.forces.search import Search, initial
from forcegp.gp.exact import require_exact_fits
from forcegp.gp.optimise import FitProgress, Learned, LearningOptions, Progress, reported
from forcegp.robot.model import RobotModel
from forcegp.storage.checkpoint import Evaluations
from forcegp.storage.options import StructuredOptions
from forcegp.storage.system import pack_system

OPTIONS, WITH_PARAMETERS = LearningOptions(), LearningOptions(tolerance=1e-9)
"""Default options, also where θ_A is learned too: L-BFGS then stalls on its way for a step or two."""
LEARN_SAMPLES = 800
"""Samples that hyperparameters are learned on where priors are finite features."""
LEARN_SAMPLES_INDUCING = 400
"""Samples that hyperparameters are learned on, exactly, where a longer log is conditioned on sparsely."""
REST_SPEED = 0.01
"""A sample is at rest where no joint moves faster [rad/s, m/s]."""
FEWEST_MOVING = 20
"""With fewer samples in motion, samples at rest are kept."""
FIRST_POWER = 0.25
"""Power of the likelihood before the correlation of its residuals is known."""

ROUNDS = 3
"""Times that hyperparameters are learned again with what the residuals determine."""


@dataclass(frozen=True, eq=False)
class Specification:
    """Parts of a structured Gaussian process before it is fitted.

    Attributes:
        system: robot and contacts.
        mean: prior mean of Q.
        priors: on the unknown forces.
        noise: of measured accelerations, torques and states.
        analytical_parameters: module with a `forward()` that returns the robot at θ_A, or `None`.
        automatic: whether the data choose the priors among `SETS`.
        options: plain values.
    """

    system: ConstrainedSystem
    mean: AnalyticalMean
    priors: tuple[ForcePrior, ...]
    noise: Noise
    analytical_parameters: nn.Module | None = None
    automatic: bool = False
    options: StructuredOptions = field(default_factory=StructuredOptions)

    def for_data(self, data: Dataset | Sequence[Observation]) -> Specification:
        """The specification with the noise resolved for given data.

        Unless it is stated, the noise of accelerations is learned together with that of the torque, or to
        compare sets of priors. Joints without a measured torque have an unknown force. Contacts stick below
        the speeds that the log states.
        """
        observations, noise = observations_of(data), self.noise
        system = self.system.with_stick_speeds(
            common_header([o.data.header for o in observations]).stick_speeds
        )
        learns = noise.learns_torque or self.automatic
        if learns and noise.acceleration is None and not states_noise(observations):
            noise = dataclasses.replace(noise, learn=True)
        unmeasured = unmeasured_forces(system, observations)
        if unmeasured:
            noise = dataclasses.replace(noise, external={**unmeasured, **(noise.external or {})})
        return dataclasses.replace(self, system=system, noise=noise)

    def with_options(self, **changed: Any) -> Specification:
        """The specification with other options."""
        return dataclasses.replace(self, options=self.options.model_copy(update=changed))

    def with_set(self, chosen: PriorSet) -> Specification:
        """The specification with a set of priors and its torque noise."""
        priors, noise = chosen.priors(self.system), self.noise
        if isinstance(noise.torque, str) and noise.torque == "auto":
            noise = noise.for_priors(priors)
        return dataclasses.replace(self, priors=priors, noise=noise, automatic=False)

    def inertia_of(self, training: Training) -> Inertia:
        """The robot identified from the training samples, if requested."""
        friction = next((prior for prior in self.priors if isinstance(prior, JointFrictionPrior)), None)
        asks = (
            self.options.inertia == "auto"
            and "actuation" in self.mean.terms
            and self.analytical_parameters is None
        )
        if friction is None or not asks or any(isinstance(prior, InertialPrior) for prior in self.priors):
            return Inertia(self.system.robot)
        if training.free_motions < LEAST:
            return Inertia(self.system.robot, doubts=_unchecked_masses(training))
        return inertia_of(self.system, friction, self.mean, training)

    def problem(
        self, training: Training, robot: RobotModel | None = None, pinned: Mapping[str, Tensor] | None = None
    ) -> Problem:
        """The learning problem of training data.

        Args:
            robot: to learn with, if it is another one than that of the file.
            pinned: values of forces that it contains, by prior.
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
            pinned=pinned or {},
            state_std=state_std_of(noise.state, robot),
            external_std=external_std(noise.external, robot),
        )


def _unchecked_masses(training: Training) -> tuple[str, ...]:
    """The warning for a log in contact with neither free motion nor a measured force."""
    closed = sum(int(m.active.any(-1).sum()) for m in training.measurements)
    if not closed or set(training.quantities) != {"qdd"}:
        return ()
    return (
        f"{training.free_motions} samples in free motion are too few to check the masses of the robot file "
        f"(expected: {LEAST} or more), and any error of the masses biases the multiplier: train on "
        "more samples if the log has free motion, else add a few seconds of it, or measure the contact force",
    )


def constant_inputs(problem: Problem) -> tuple[str, ...]:
    """Inputs of priors that do not vary in the training data."""
    pairs = zip(problem.priors, problem.training.scales, strict=True)
    return tuple(f"{prior.name}.{name}" for prior, scale in pairs for name in scale.constant)


@dataclass(frozen=True)
class Lesson:
    """Result of learning, and the problem that the posterior is conditioned on.

    Attributes:
        problem: all samples, the updated robot, and the noise.
        hyperparameters: learned and fixed.
        learned: course of the optimisation.
        learned_on: number of samples used for learning.
        warnings: doubts.
    """

    problem: Problem
    hyperparameters: dict[str, Tensor]
    learned: Learned | None = None
    learned_on: int | None = None
    warnings: tuple[str, ...] = ()


def problem_for(
    spec: Specification,
    before: Problem | None,
    data: Dataset | Sequence[Observation],
    chosen: Sequence[str] | None,
    part_of: int = 0,
) -> tuple[Specification, Problem, tuple[str, ...]]:
    """The learning problem of a fit to data, after the problem of an earlier fit or as the first.

    Args:
        part_of: number of samples that are conditioned on, if the data are a part of them.

    Returns:
        The model, to which a first fit that identifies the robot adds a prior on errors that remain; the
        problem; and doubts about the samples and the robot.
    """
    training, doubts = training_for(spec, before, data, chosen)
    robot, pinned = spec.system.robot, dict[str, Tensor]()
    if before is not None and not any(bool(value.any()) for value in before.pinned.values()):
        robot, pinned = before.system.robot, before.pinned
    elif before is None and chosen is None:
        found = spec.inertia_of(training)
        robot, doubts = found.robot, (*doubts, *found.doubts)
        if found.identified:
            spec, pinned = identified(spec, training)
            training, _ = training_for(spec, before, data, chosen)
    return spec, spec.problem(dataclasses.replace(training, part_of=part_of), robot, pinned), doubts


def identified(spec: Specification, training: Training) -> tuple[Specification, dict[str, Tensor]]:
    """The model of a robot with identified inertia: errors of links and drives remain, with mean zero."""
    robot = spec.system.robot
    q = torch.cat([m.q for m in training.evenly(VOLUME_STATES).measurements])
    size = mass_matrix(robot, q).diagonal(dim1=-2, dim2=-1).mean(0)
    errors = InertialPrior().around(robot).with_drives(size)
    pinned = {errors.name: robot.mass.new_zeros(errors.outputs(robot))}
    return dataclasses.replace(spec, priors=(*spec.priors, errors)), pinned


def training_for(
    spec: Specification,
    before: Problem | None,
    data: Dataset | Sequence[Observation],
    learned: Sequence[str] | None,
    fewest: int = FEWEST_MOVING,
) -> tuple[Training, tuple[str, ...]]:
    """Training data, with doubts about them.

    Priors that are not learned (`None`: all are) keep the scales of their inputs. If fewer than `fewest`
    samples are in motion, those at rest are kept.
    """
    kept = {}
    if before is not None and learned is not None:
        scales = zip(spec.priors, before.training.scales, strict=True)
        kept = {prior.name: scale for prior, scale in scales if prior.name not in learned}
    training = training_of(
        data, spec.system, spec.priors, spec.noise.acceleration, kept, spec.options.standardize
    )
    return in_motion(spec.system, training, fewest) if spec.noise.learns_torque else (training, ())


def check_learned(spec: Specification, learn: Iterable[str]) -> None:
    """Check the names of learned parts, the prefixes of their tensors.

    Raises:
        UnknownNameError: a name is neither a prior nor another learnable part.
    """
    names = (*(prior.name for prior in spec.priors), NOISE, ANALYTICAL, COULOMB)
    for name in learn:
        check_name("force prior to learn", name, names)


def search_of(
    spec: Specification,
    problem: Problem,
    known: Mapping[str, Tensor],
    chosen: Sequence[str] | None,
    options: LearningOptions | None,
) -> Search:
    """Learned parts of a problem, their start, and parts with a known value.

    The scale of a force that the robot contains is not learned.
    """
    options = options or (OPTIONS if spec.analytical_parameters is None else WITH_PARAMETERS)
    start = initial(problem, spec.noise.learn, spec.noise.learns_torque)
    known = {} if chosen is None else known
    current = {key: known.get(key, value) for key, value in start.items()}
    if chosen is not None and NOISE not in chosen:
        current |= {key: value for key, value in known.items() if key.startswith((REGION, MEMORY))}

    def is_held(name: str) -> bool:
        # Residuals of a robot that contains a force do not show the scale of that force.
        return name in problem.pinned or (chosen is not None and name not in chosen)

    held = {key: value for key, value in current.items() if is_held(key.split(".")[0])}
    return Search({key: value for key, value in start.items() if key not in held}, held, options)


def in_motion(
    system: ConstrainedSystem, training: Training, fewest: int = FEWEST_MOVING
) -> tuple[Training, tuple[str, ...]]:
    """The samples in motion, without impacts, and doubts about them."""
    moving = training.moving(REST_SPEED)
    if moving.samples < fewest:
        return training, (
            f"only {moving.samples} samples are in motion: friction cannot be separated from noise at rest",
        )
    moving, impacts = without_impacts(moving, system)
    if not impacts:
        return moving, ()
    return moving, (
        f"{impacts} samples in contact were left out as impacts: they accelerate off the surface or into it",
    )


def subset(spec: Specification, problem: Problem) -> Problem:
    """The problem on the samples that hyperparameters are learned on."""
    training = problem.training
    if not is_sparse(spec.options.inference, problem.priors, training.all_samples):
        return problem
    finite = is_finite(problem.priors)
    most = LEARN_SAMPLES if finite else LEARN_SAMPLES_INDUCING
    if training.samples > most:
        # Neighbours in time show how long residuals are correlated; elsewhere samples far apart say most.
        training = training.evenly(most) if spec.noise.learns_torque else training.thinned(most)
    problem = dataclasses.replace(problem, training=training)
    return without_inducing(problem) if finite else problem


def learned(
    spec: Specification,
    problem: Problem,
    search: Search,
    file: Path | None,
    progress: FitProgress | None,
    begin: Mapping[str, Tensor] | None,
    neighbours: Training | None,
) -> Lesson:
    """Learn the free parts of a search, and record the evaluations.

    Args:
        file: record of the evaluations, from which learning resumes with the same result to the bit.

    Raises:
        ModelError: the file belongs to other learning.
    """
    if not search.start:
        return Lesson(prepared(spec, problem, search.held), search.held)
    saved = None
    if file is not None:
        saved = Evaluations.resumed(file, search.start, *_key(spec, problem, search, begin))
        search = dataclasses.replace(search, recorded=saved.recorded)
    report = reported(progress, search.options.max_evaluations)
    lesson = solve(spec, problem, search, report, begin, neighbours)
    if TORQUE_NOISE in search.start:
        lesson = _with_memory(lesson, neighbours)
    if saved is not None:
        saved.write()
    return lesson


def _with_memory(lesson: Lesson, neighbours: Training | None) -> Lesson:
    """The lesson with friction with memory, where the log has free motion."""
    training = neighbours or lesson.problem.training
    if training.free_motions < LEAST:
        return lesson
    memory = memory_of(lesson.problem, lesson.hyperparameters, training)
    return dataclasses.replace(lesson, hyperparameters={**lesson.hyperparameters, **memory})


def identity(problem: Problem) -> tuple[object, ...]:
    """The mean, priors, data, noise and system of a problem, for the keys of checkpoints."""
    training, (record, robot) = problem.training, pack_system(problem.system)
    data = (value for m in training.measurements for value in m.tensors)
    priors = [(type(prior).__name__, prior) for prior in problem.priors]
    return problem.mean, priors, training.part_of, *data, *training.noise_std, record, *robot.values()


def _key(
    spec: Specification, problem: Problem, search: Search, begin: Mapping[str, Tensor] | None
) -> tuple[object, ...]:
    """Identifies the learning of some tensors of a problem, with these options."""
    named = [pair for group in (search.start, search.held, begin or {}) for pair in group.items()]
    sides = [side for scale in problem.training.scales for side in (scale.mean, scale.std)]
    stated = problem.state_std, problem.torque_std, problem.external_std
    noise = ["none" if x is None else x for x in stated]
    return (
        *identity(problem), *problem.pinned, *problem.pinned.values(), problem.training.quantities,
        spec.options, spec.noise.degrees_of_freedom, search.options,
        *noise, *(x for side in sides for x in side.values()), *(part for pair in named for part in pair),
    )  # fmt: skip


def solve(
    spec: Specification,
    problem: Problem,
    search: Search,
    progress: Progress | None = None,
    begin: Mapping[str, Tensor] | None = None,
    neighbours: Training | None = None,
) -> Lesson:
    """Learn the free parts of a search, then prepare the problem for conditioning.

    The residuals determine the power of the likelihood, slopes that carry noise of the state, and weights of
    the samples; each time these change, hyperparameters are learned again, `ROUNDS` times at most.

    Args:
        neighbours: samples at the rate of the log, if those of the problem are only a part of it.
    """
    part = subset(spec, problem)
    if part.inducing is None:
        require_exact_fits(part.fixed_rows.blocks)
    calibrated = spec.noise.learns_torque and TORQUE_NOISE in search.start
    correlated = calibrated and not any(prior.in_time for prior in part.priors)
    if correlated:
        part = dataclasses.replace(part, power=FIRST_POWER)
    learned, learned_on = search.solve(part, progress, begin), part.training.samples
    sloped = part.state_std is not None and not any(prior.in_time for prior in part.priors)
    sloped &= not is_sparse(spec.options.inference, part.priors, problem.training.all_samples)
    warnings: list[str] = []
    for number in range(ROUNDS):
        before = part
        if sloped:
            part, learned, doubts = with_learned_slopes(part, search, learned, progress)
            warnings += doubts
        rest, values = part, search.values(learned)
        if correlated and number == 0:
            part = dataclasses.replace(part, power=residual_times(part, values, part.training)[0])
        if spec.noise.degrees_of_freedom is not None:
            part = weighted(part, values, spec.noise.degrees_of_freedom)
        if part is not rest:
            learned = search.solve(part, progress, learned.tensors)
        if part is before:
            break
    values = search.values(learned)
    if calibrated and any(isinstance(prior, InertialPrior) for prior in part.priors):
        part = with_updated_robot(part, values)
    if calibrated:
        values |= calibrated_noise(part, values)
    if correlated:
        part = _at_the_rate_of_the_log(part, values, neighbours or problem.training)
    training = dataclasses.replace(problem.training, slopes=part.training.slopes)
    whole = dataclasses.replace(part, training=training, inducing=None)
    whole = prepared(spec, whole, values)
    if spec.noise.degrees_of_freedom is not None and (count := left_out(whole)):
        samples = whole.training.samples
        warnings.append(f"{count} of {samples} samples lie far outside the noise and hardly count")
    return Lesson(whole, values, learned, learned_on, tuple(dict.fromkeys(warnings)))


def _at_the_rate_of_the_log(part: Problem, values: Mapping[str, Tensor], training: Training) -> Problem:
    """The problem with the correlation of its residuals among all samples.

    Neighbours in the whole log are closer in time than in the part that was learned on. Of a log that is read
    piece by piece, a few contiguous stretches are looked at.
    """
    power, correlation = residual_times(part, values, training)
    if part.training.measurements is training.measurements:
        power = part.power
    share = training.samples / training.all_samples
    return dataclasses.replace(part, power=power * share, correlation=correlation)


def prepared(spec: Specification, problem: Problem, values: Mapping[str, Tensor]) -> Problem:
    """The problem with the inference for its samples, and their weights under heavy-tailed noise."""
    if is_sparse(spec.options.inference, problem.priors, problem.training.all_samples):
        # Sums over samples have the slopes of the robot file.
        problem = dataclasses.replace(problem, training=dataclasses.replace(problem.training, slopes=None))
        if is_finite(problem.priors):
            problem = without_inducing(problem)
        else:
            problem = with_inducing(problem, values, spec.options.inducing_points)
    if spec.noise.degrees_of_freedom is None:
        return problem
    return weighted(problem, values, spec.noise.degrees_of_freedom)
