"""How a structured Gaussian process is learned: on which samples, with which inference, in which steps.

1. Samples at rest say nothing but that friction is below a limit, and impacts break the equations of motion;
   robots that are measured learn from motion without impacts.
2. Hyperparameters are learned on a part of a long log, or on all of a short one.
3. Residuals that are correlated in time temper the likelihood, and hyperparameters are learned once more;
   unless a `DisturbancePrior` explains them.
4. Inertial parameters move to their posterior mean: one Gauss–Newton step, physically consistent.
5. The noise of the torque is enlarged to what held-out stretches of the training log ask for.
6. The posterior is conditioned on all samples.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.dynamics import mass_matrix
from forcegp.forces.calibration import held_out_torque_std, likelihood_power, residual_times
from forcegp.forces.impacts import without_impacts
from forcegp.forces.inference import (
    force_posterior,
    is_finite,
    is_sparse,
    with_inducing,
    without_inducing,
)
from forcegp.forces.learn import Problem
from forcegp.forces.measurements import Training
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.slopes import with_learned_slopes, without_slopes
from forcegp.forces.start import Search
from forcegp.forces.student_t import left_out, weighted
from forcegp.forces.torque_noise import TORQUE_NOISE
from forcegp.gp.likelihood import require_exact_fits
from forcegp.gp.optimise import Learned, Progress
from forcegp.gp.structured_covariance import Block
from forcegp.models.structured_spec import Specification
from forcegp.robot.model import RobotModel

LEARN_SAMPLES = 800
"""Samples that hyperparameters are learned on where priors are finite features."""
LEARN_SAMPLES_INDUCING = 400
"""Samples that hyperparameters are learned on, exactly, where a longer log is conditioned on sparsely."""
REST_SPEED = 0.01
"""A sample is at rest where no joint moves faster [rad/s, m/s]."""
FEWEST_MOVING = 20
"""With fewer samples in motion, samples at rest are kept."""
VOLUME_STATES = 100
"""States that the volume of the noise is averaged over."""
ROUNDS = 3
"""Rounds of the weights of samples under heavy-tailed noise and of the hyperparameters with them."""
FIRST_POWER = 0.25
"""Power of the likelihood before the correlation of its residuals is known."""


@dataclass(frozen=True)
class Lesson:
    """What was learned, and the problem that the posterior is conditioned on.

    Attributes:
        problem: all samples, the updated robot, and the noise.
        hyperparameters: learned and held.
        learned: how the optimisation went.
        learned_on: number of samples that were learned on.
        warnings: doubts that came up.
    """

    problem: Problem
    hyperparameters: dict[str, Tensor]
    learned: Learned | None = None
    learned_on: int | None = None
    warnings: tuple[str, ...] = ()


def in_motion(system: ConstrainedSystem, training: Training) -> tuple[Training, tuple[str, ...]]:
    """The samples in motion, without impacts, and doubts about them."""
    moving = training.moving(REST_SPEED)
    if moving.samples < FEWEST_MOVING:
        return training, (
            f"only {moving.samples} samples are in motion: friction cannot be told from noise at rest",
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
    if not is_sparse(spec.inference, problem.priors, training.all_samples):
        return problem
    finite = is_finite(problem.priors)
    most = LEARN_SAMPLES if finite else LEARN_SAMPLES_INDUCING
    if training.samples > most:
        # Neighbours in time show how long residuals are correlated; elsewhere samples far apart say most.
        training = training.evenly(most) if spec.learns_torque_noise else training.thinned(most)
    problem = dataclasses.replace(problem, training=training)
    return without_inducing(problem) if finite else problem


def solve(
    spec: Specification,
    problem: Problem,
    search: Search,
    progress: Progress | None = None,
    begin: Mapping[str, Tensor] | None = None,
    neighbours: Training | None = None,
) -> Lesson:
    """Learn what is free in a search, then prepare the problem that is conditioned on.

    Args:
        spec: the model.
        problem: all samples.
        search: what is learned and what is held.
        progress: called after each evaluation.
        begin: where to begin.
        neighbours: samples as close in time as those of the log, where those of the problem are a part of it.
    """
    part = subset(spec, problem)
    if part.inducing is None:
        require_exact_fits(part.fixed_rows.blocks)
    calibrated = spec.learns_torque_noise and TORQUE_NOISE in search.start
    correlated = calibrated and not any(prior.in_time for prior in part.priors)
    if correlated:
        part = dataclasses.replace(part, power=FIRST_POWER)
    learned, learned_on = search.solve(part, progress, begin), part.training.samples
    values = {**search.held, **learned.tensors}
    if not is_sparse(spec.inference, part.priors, problem.training.all_samples):
        part, learned = with_learned_slopes(part, search, learned, progress)
        values = {**search.held, **learned.tensors}
    if spec.degrees_of_freedom is not None:
        for _ in range(ROUNDS):
            part = weighted(part, values, spec.degrees_of_freedom)
            learned = search.solve(part, progress, learned.tensors)
            values = {**search.held, **learned.tensors}
    if correlated:
        part = dataclasses.replace(part, power=likelihood_power(part, values))
        learned = search.solve(part, progress, learned.tensors)
        values = {**search.held, **learned.tensors}
    if calibrated:
        part = with_updated_robot(part, values)
        values[TORQUE_NOISE] = held_out_torque_std(part, values, values[TORQUE_NOISE].exp()).log()
    if correlated:
        part = _at_the_rate_of_the_log(part, values, neighbours or problem.training)
    training = dataclasses.replace(problem.training, slopes=part.training.slopes)
    whole = dataclasses.replace(part, training=training, inducing=None)
    whole = prepared(spec, whole, values)
    warnings = ()
    if count := left_out(whole):
        samples = whole.training.samples
        warnings = (f"{count} of {samples} samples lie far outside the noise and hardly count",)
    return Lesson(whole, values, learned, learned_on, warnings)


def _at_the_rate_of_the_log(part: Problem, values: Mapping[str, Tensor], training: Training) -> Problem:
    """The problem with the correlation of its residuals among all samples.

    Neighbours in the whole log are closer in time than in the part that was learned on. Of a log that is read
    piece by piece, a few contiguous stretches are looked at.
    """
    power, correlation = residual_times(part, values, training)
    if part.training is training:
        power = part.power
    share = training.samples / training.all_samples
    return dataclasses.replace(part, power=power * share, correlation=correlation)


def prepared(spec: Specification, problem: Problem, values: Mapping[str, Tensor]) -> Problem:
    """The problem with the inference that its samples ask for, and their weights under heavy-tailed noise."""
    if is_sparse(spec.inference, problem.priors, problem.training.all_samples):
        problem = without_slopes(problem)
        if is_finite(problem.priors):
            problem = without_inducing(problem)
        else:
            problem = with_inducing(problem, values, spec.inducing_points)
    if spec.degrees_of_freedom is None:
        return problem
    return weighted(problem, values, spec.degrees_of_freedom)


@torch.no_grad()
def with_updated_robot(problem: Problem, values: Mapping[str, Tensor]) -> Problem:
    """The problem with the robot at the posterior mean of its inertial parameters (a Gauss–Newton step)."""
    for p, prior in enumerate(problem.priors):
        contained = prior.name in problem.pinned
        if isinstance(prior, InertialPrior) and problem.parameters is None and not contained:
            posterior = force_posterior(problem, values)
            features = _one_row(posterior, problem)
            mean = posterior.latent.latent_mean(p, features[p])[0]
            precision = _precision(posterior, features, p, problem.system.robot)
            volume = _log_volume(problem, values)
            robot, moved = prior.updated(problem.system.robot, mean, precision, volume)
            # The prior keeps the scale of the file's parameters, not that of the updated ones.
            return dataclasses.replace(
                problem,
                system=problem.system.with_robot(robot),
                priors=tuple(prior.around(problem.system.robot) if q is prior else q for q in problem.priors),
                offsets={**problem.offsets, prior.name: -moved},
                pinned=(prior.name,),
            )
    return problem


def _log_volume(problem: Problem, values: Mapping[str, Tensor]) -> Callable[[RobotModel], Tensor]:
    """κ Σ_i log |M (Σ_τ + M Σ_q̈ Mᵀ)^−½| at the samples in free motion, as a function of the robot.

    With it, the density of the torque's error is that of the acceleration's. Without it, a robot that has
    next to no inertia explains small torques best, whatever it does to the accelerations.
    """
    terms = []
    std = problem.system.robot.mass.new_zeros(problem.system.robot.nq)
    if TORQUE_NOISE in values:
        std = values[TORQUE_NOISE].exp()
    elif problem.torque_std is not None:
        std = problem.torque_std
    for i in (i for i, quantity in enumerate(problem.training.quantities) if quantity == "qdd"):
        m = problem.training.measurements[i]
        free = (~m.active.any(-1)).nonzero()[:, 0]
        if not len(free):
            continue
        q = m.q[free[torch.linspace(0, len(free) - 1, min(VOLUME_STATES, len(free))).round().long()]]
        noise = problem.noise_at(values, i)
        spread = (noise if noise.ndim == 1 else noise.square().mean(0).sqrt()).detach() ** 2
        terms.append((q, problem.power * len(free) / len(q), spread))

    def volume(robot: RobotModel) -> Tensor:
        total = robot.mass.new_zeros(())
        for q, weight, spread in terms:
            M = mass_matrix(robot, q)
            C = torch.diag(std**2) + (M * spread) @ M.mT
            total = total + weight * (torch.logdet(M) - 0.5 * torch.logdet(C)).sum()
        return total

    return volume


def _one_row(posterior: ForcePosterior, problem: Problem) -> list[dict[str, Tensor]]:
    """Kernel inputs of every prior at the first sample; constants have the same value everywhere."""
    m = problem.training.measurements[0]
    at = m[torch.zeros(1, dtype=torch.int64, device=m.q.device)].at(problem.system)
    return [posterior.features_of(p, problem.system, at) for p in range(len(problem.priors))]


def _precision(
    posterior: ForcePosterior, features: list[dict[str, Tensor]], p: int, robot: RobotModel
) -> Tensor:
    """Inverse posterior covariance of the components of prior p, all others marginalised."""
    widths = [prior.outputs(robot) for prior in posterior.priors]
    eye = torch.eye(widths[p], dtype=robot.dtype, device=robot.device)
    operators = [eye[None] if q == p else eye.new_zeros(1, widths[p], w) for q, w in enumerate(widths)]
    block = Block(tuple(features), tuple(operators), eye[:1])
    return torch.linalg.inv(posterior.latent.covariance(block)[0])
