"""Inertial parameters of the robot at their posterior mean: one Gauss–Newton step, physically consistent."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from forcegp.dynamics import mass_matrix
from forcegp.forces.inference import force_posterior
from forcegp.forces.learn import Problem
from forcegp.forces.noise import TORQUE_NOISE
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.gp.structured_covariance import Block
from forcegp.robot.model import RobotModel

VOLUME_STATES = 100
"""States that the volume of the noise is averaged over."""


@torch.no_grad()
def with_updated_robot(problem: Problem, values: Mapping[str, Tensor]) -> Problem:
    """The problem with the robot at the posterior mean of its inertial parameters (a Gauss–Newton step)."""
    for p, prior in enumerate(problem.priors):
        contained = prior.name in problem.pinned
        if isinstance(prior, InertialPrior) and problem.parameters is None and not contained:
            posterior = force_posterior(problem, values)
            features = one_row(posterior, problem)
            mean = posterior.latent.latent_mean(p, features[p])[0]
            precision = latent_precision(posterior, features, p, problem.system.robot)
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


def one_row(posterior: ForcePosterior, problem: Problem) -> list[dict[str, Tensor]]:
    """Kernel inputs of every prior at the first sample; constants have the same value everywhere."""
    m = problem.training.measurements[0]
    at = m[torch.zeros(1, dtype=torch.int64, device=m.q.device)].at(problem.system)
    return [posterior.features_of(p, problem.system, at) for p in range(len(problem.priors))]


def latent_precision(
    posterior: ForcePosterior, features: list[dict[str, Tensor]], p: int, robot: RobotModel
) -> Tensor:
    """Inverse posterior covariance of the components of prior p, all others marginalised."""
    widths = [prior.outputs(robot) for prior in posterior.priors]
    eye = torch.eye(widths[p], dtype=robot.dtype, device=robot.device)
    operators = [eye[None] if q == p else eye.new_zeros(1, widths[p], w) for q, w in enumerate(widths)]
    block = Block(tuple(features), tuple(operators), eye[:1])
    return torch.linalg.inv(posterior.latent.covariance(block)[0])
