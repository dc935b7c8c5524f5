"""A fit as the list of its steps.

1. Samples at rest only bound friction, and impacts violate the equations of motion. All others are used
   (`specification.py`).
2. Inertia is identified with instruments, if held-out parts of the log confirm it (`inertia.py`). Its
   remaining errors have zero mean and widen error bars.
3. Scales of columns and variances of rows follow from the evidence (`regression.py`). Kernels with other
   hyperparameters are searched on part of the log (`search.py`), and again if residuals change the weights
   of samples or the slopes that propagate state noise (`noise_learning.py`).
4. Torque noise is raised to the level observed on held-out blocks of the log (`held_out.py`).
5. The correlation of residuals in time determines how many samples are independent (`correlation.py`).
6. The posterior is conditioned on all samples (`models/structured_fit.py`).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from forcegp.forces.measurements import Training
from forcegp.forces.noise import TORQUE_NOISE
from forcegp.forces.priors.base import NOISE
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.problem import Problem, is_finite, is_sparse, with_inducing, without_inducing
from forcegp.gp.exact import require_exact_fits
from forcegp.gp.optimise import FitProgress, Learned, reported
from forcegp.learning.accelerations import with_likely_accelerations
from forcegp.learning.correlation import residual_times
from forcegp.learning.held_out import calibrated_noise
from forcegp.learning.inertia import with_updated_robot
from forcegp.learning.noise_learning import left_out, weighted, with_learned_slopes
from forcegp.learning.regression import are_columns, regression, with_acceleration_noise, with_expectations
from forcegp.learning.search import Search
from forcegp.learning.specification import Specification
from forcegp.robot.model import RobotModel

LEARN_SAMPLES = 800
"""Number of samples for learning hyperparameters if all priors have finitely many features."""
LEARN_SAMPLES_INDUCING = 400
"""Number of samples for learning hyperparameters by exact inference if the log needs sparse inference."""
FIRST_POWER = 0.25
"""Exponent of the tempered likelihood before the correlation of the residuals is known."""
STEPS = 3
"""Number of Gauss–Newton steps for links after the first one. More change the inertia of a pendulum whose
accelerations are half noise (`tests/learning/test_accelerations.py`) by less than 0.1 %."""
RELEARNINGS = 3
"""Maximum number of times that hyperparameters are relearned after updates based on the residuals."""


@dataclass(frozen=True)
class Lesson:
    """Result of learning, and the problem on which the posterior is conditioned.

    Attributes:
        problem: the problem with all samples, the updated robot, and the noise.
        hyperparameters: the learned and fixed hyperparameters.
        learned: the result of the optimisation.
        learned_on: number of samples used for learning.
        warnings: warnings about the result.
        worth: log evidence of each group of columns over its absence [nats].
    """

    problem: Problem
    hyperparameters: dict[str, Tensor]
    learned: Learned | None = None
    learned_on: int | None = None
    warnings: tuple[str, ...] = ()
    worth: Mapping[str, float] = field(default_factory=dict)


def learned(
    spec: Specification,
    problem: Problem,
    search: Search,
    progress: FitProgress | None,
    begin: Mapping[str, Tensor] | None,
    neighbours: Training | None,
) -> Lesson:
    """Learn the free parameters of a search from a problem, and prepare the problem for conditioning.

    Args:
        begin: initial values that differ from those of the search.
        neighbours: samples at the sampling rate of the log, if the problem contains only part of the log.
    """
    if not search.start:
        return Lesson(prepared(spec, problem, search.held), search.held)
    # 3. Scales of columns and variances of rows, or hyperparameters of kernels
    columns, robot = is_regression(spec, problem), problem.system.robot
    if columns:
        moved = _with_links_of_laws(spec, problem, search, progress)
        lesson = _of_columns(spec, moved, search, progress, begin)
    else:
        lesson = _of_kernels(spec, problem, search, progress, begin)
    part, values = lesson.problem, dict(lesson.hyperparameters)
    if spec.noise.learns_torque:
        # Given priors on links move the robot.
        part = _with_links(part, values, robot, STEPS if columns else 0)
        # 4. Torque noise of held-out blocks
        if TORQUE_NOISE in search.start:
            values |= calibrated_noise(part, values)
        # 5. Correlation of the residuals
        part = _at_the_rate_of_the_log(part, values, neighbours or problem.training)
    training = dataclasses.replace(problem.training, scales=part.training.scales, slopes=part.training.slopes)
    keeps = columns and spec.inference.method != "exact"
    whole = dataclasses.replace(part, training=training, inducing=part.inducing if keeps else None)
    whole = prepared(spec, whole, values)
    warnings = (*lesson.warnings, *_little_weight(spec, whole))
    return dataclasses.replace(lesson, problem=whole, hyperparameters=values, warnings=warnings)


def _with_links(part: Problem, values: Mapping[str, Tensor], robot: RobotModel, steps: int) -> Problem:
    """Return a learned problem with links and drives at their posterior mean, if there is a prior on them.

    Args:
        part: the problem, whose robot may be that of earlier steps.
        values: its hyperparameters.
        robot: the robot of the file.
        steps: number of Gauss–Newton steps after the first one, with columns of the inertia at the most
            probable accelerations, since measured ones are noisy (`accelerations.py`).
    """
    moved = with_updated_robot(part, values, robot)
    for _ in range(steps if moved is not part else 0):
        moved = with_updated_robot(_with_moved_robot(part, moved, values), values, robot)
    return moved


def _with_links_of_laws(
    spec: Specification, problem: Problem, search: Search, progress: FitProgress | None
) -> Problem:
    """Return the problem with the robot that a first fit without a residual force finds, if links may change.

    Noise depends on the inertia, by which the noise of accelerations acts like torques.
    """
    if all(prior.is_error or not isinstance(prior, InertialPrior) for prior in problem.priors):
        return problem
    laws = problem.without_priors([prior.name for prior in problem.priors if prior.remainder])
    first = _of_columns(dataclasses.replace(spec, automatic=False), laws, search, progress, None)
    part, values = first.problem, first.hyperparameters
    return _with_moved_robot(problem, _with_links(part, values, problem.system.robot, STEPS), values)


def _with_moved_robot(problem: Problem, moved: Problem, values: Mapping[str, Tensor]) -> Problem:
    """Return the problem with the robot and the most probable accelerations of another one."""
    robot = problem.system.robot
    priors = [x.around(robot) if isinstance(x, InertialPrior) else x for x in problem.priors]
    training = with_likely_accelerations(moved, values, problem.training)
    return dataclasses.replace(problem, system=moved.system, priors=tuple(priors), training=training)


def is_regression(spec: Specification, problem: Problem) -> bool:
    """Return whether all unknowns are columns or variances of rows, so that no search is needed."""
    plain = spec.analytical_parameters is None and problem.state_std is None
    return plain and spec.noise.learns_torque and are_columns(problem.priors)


def _of_columns(
    spec: Specification,
    problem: Problem,
    search: Search,
    progress: FitProgress | None,
    begin: Mapping[str, Tensor] | None,
) -> Lesson:
    """Learn columns and variances of rows from the evidence."""
    began, free = time.perf_counter(), {key.split(".")[0] for key in search.start}
    start = {**search.start, **search.held, **(begin or {})}
    if spec.noise.learn and NOISE in free:
        problem, noise = with_acceleration_noise(problem)
        start |= noise
    problem = with_expectations(problem)
    degrees = spec.noise.degrees_of_freedom
    result = regression(problem, start, free.__contains__, spec.automatic, degrees, progress)
    values, seconds = dict(result.values), time.perf_counter() - began
    message = "the evidence is stationary" if result.converged else "stopped at the limit of alternations"
    outcome = Learned(values, result.objective, result.converged, result.rounds, seconds, message)
    return Lesson(result.problem, values, outcome, result.samples, worth=result.worth)


def _of_kernels(
    spec: Specification,
    problem: Problem,
    search: Search,
    progress: FitProgress | None,
    begin: Mapping[str, Tensor] | None,
) -> Lesson:
    """Search for hyperparameters of kernels on part of the samples.

    The residuals determine the exponent of the tempered likelihood, the slopes that propagate state noise,
    and the sample weights. Whenever these change, hyperparameters are relearned, at most `RELEARNINGS` times.
    """
    part, report = subset(spec, problem), reported(progress, search.options.max_evaluations)
    if part.inducing is None:
        require_exact_fits(part.fixed_rows.blocks)
    correlated = spec.noise.learns_torque and TORQUE_NOISE in search.start
    if correlated:
        part = dataclasses.replace(part, power=FIRST_POWER)
    outcome, learned_on = search.solve(part, report, begin), part.training.samples
    sloped = part.state_std is not None
    sloped &= not is_sparse(spec.inference.method, part.priors, problem.training.all_samples)
    warnings: list[str] = []
    for number in range(RELEARNINGS):
        before = part
        if sloped:
            part, outcome, doubts = with_learned_slopes(part, search, outcome, report)
            warnings += doubts
        rest, values = part, search.values(outcome)
        if correlated and number == 0:
            part = dataclasses.replace(part, power=residual_times(part, values, part.training)[0])
        if spec.noise.degrees_of_freedom is not None:
            part = weighted(part, values, spec.noise.degrees_of_freedom)
        if part is not rest:
            outcome = search.solve(part, report, outcome.tensors)
        if part is before:
            break
    return Lesson(part, search.values(outcome), outcome, learned_on, tuple(dict.fromkeys(warnings)))


def _little_weight(spec: Specification, whole: Problem) -> tuple[str, ...]:
    """Return a warning about samples that heavy-tailed noise gives little weight."""
    if spec.noise.degrees_of_freedom is None or not (count := left_out(whole)):
        return ()
    samples = whole.training.samples
    return (f"{count} of {samples} samples are far outside the noise and have little weight",)


def subset(spec: Specification, problem: Problem) -> Problem:
    """Return the problem restricted to the samples from which hyperparameters are learned."""
    training = problem.training
    if not is_sparse(spec.inference.method, problem.priors, training.all_samples):
        return problem
    finite = is_finite(problem.priors)
    most = LEARN_SAMPLES if finite else LEARN_SAMPLES_INDUCING
    if training.samples > most:
        # Neighbours in time determine the correlation of residuals; otherwise distant samples are better.
        training = training.evenly(most) if spec.noise.learns_torque else training.thinned(most)
    problem = dataclasses.replace(problem, training=training)
    return without_inducing(problem) if finite else problem


def _at_the_rate_of_the_log(part: Problem, values: Mapping[str, Tensor], training: Training) -> Problem:
    """Return the problem with the correlation of its residuals at the sampling rate of the log.

    Neighbouring samples are closer in time in the whole log than in the part used for learning. For a
    streamed log, the correlation is estimated from a few contiguous runs of samples.
    """
    power, correlation = residual_times(part, values, training)
    if part.training.measurements is training.measurements:
        power = part.power
    share = training.samples / training.all_samples
    return dataclasses.replace(part, power=power * share, correlation=correlation)


def prepared(spec: Specification, problem: Problem, values: Mapping[str, Tensor]) -> Problem:
    """Return the problem with its inference method and, for heavy-tailed noise, its sample weights."""
    pointed = problem.inducing is not None and any(prior.remainder for prior in problem.priors)
    if pointed or is_sparse(spec.inference.method, problem.priors, problem.training.all_samples):
        # Sums over samples use the slopes of the model in the robot file.
        problem = dataclasses.replace(problem, training=dataclasses.replace(problem.training, slopes=None))
        if is_finite(problem.priors):
            problem = without_inducing(problem)
        elif not pointed:
            problem = with_inducing(problem, values, spec.inference.inducing_points)
    if spec.noise.degrees_of_freedom is None:
        return problem
    return weighted(problem, values, spec.noise.degrees_of_freedom)
