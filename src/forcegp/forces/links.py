"""Inertial parameters of the links, with the inertia of drives, that a log in free motion determines.

Least squares make inertia too small where accelerations are noisy. The likelihood of accelerations given
torques makes it too large where the torque is noisy and a controller chose the motion. Here the equations of
motion a little earlier and later are the instruments (`inverse_dynamics.py`), which neither disturbs. The
unknowns are Gaussian around the robot file, each link stays physically consistent, and the inertia of a drive
is not negative.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forcegp.dynamics import mass_matrix
from forcegp.forces.calibration import autocorrelation_time
from forcegp.forces.inverse_dynamics import (
    Rows,
    Sums,
    acceleration_errors,
    instrumental,
    is_harmless,
    is_less,
    products,
)
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.identification import regressor
from forcegp.robot.model import RobotModel

PASSES = 3
"""Estimates of the unknowns, each with the noise that the one before left."""


def rigid_robot(robot: RobotModel, rows: Rows) -> RobotModel | None:
    """The physically consistent robot that predicts held-out torques better than the file, or `None`.

    It has to do so significantly, by more than two standard errors over stretches of the log: better than the
    file, and better than the file with drives that it lacks. And no joint's held-out acceleration error may
    grow.

    Args:
        robot: of the file.
        rows: samples in free motion.
    """
    prior, n = InertialPrior(), robot.nq
    size = mass_matrix(robot, rows.q).diagonal(dim1=-2, dim2=-1).mean(0)
    links = regressor(robot, rows.q, rows.qd, rows.qdd) * prior.scale(robot)
    C = torch.cat([size * torch.diag_embed(rows.qdd), links], dim=-1)
    by_stretch, judged = instrumental(rows, C), products(rows, C)
    every = by_stretch.total()
    mean, noise, power = C.new_zeros(C.shape[-1]), C.new_ones(n), 1.0
    for _ in range(PASSES):
        left = rows.slides * (rows.residual - C @ mean - (rows.friction * every.friction(mean)).sum(-1))
        noise = (left.square().sum(0) / rows.slides.sum(0).clamp(min=1)).sqrt().clamp(min=1e-300)
        power = _power(rows, left / noise)
        mean = _estimate(every, noise, power)

    def compared(estimate: Tensor | None) -> Tensor:
        """Held-out errors in units of the noise, of an estimate, or of that of the other stretches."""
        errors = []
        for g in range(len(judged.gram)):
            rest = by_stretch.without(g)
            delta = _estimate(rest, noise, power) if estimate is None else estimate
            errors.append(judged.of(g).error(delta, rest.friction(delta)) / noise**2)
        return torch.stack(errors)

    nothing, drives = torch.zeros_like(mean), _drives_alone(every, noise, n)
    known = min(compared(nothing), compared(drives), key=lambda error: float(error.mean()))
    if not _is_better(compared(None), known):
        return None
    driven = robot.replace(armature=robot.armature + size * mean[:n])
    _, precision = _normal(every, noise, power)
    consistent, moved = prior.updated(driven, mean[n:], precision[n:, n:])
    found = torch.cat([mean[:n], moved])
    before, after = (
        acceleration_errors(rows, by_stretch, C, delta, mass_matrix(each, rows.q))
        for each, delta in ((robot, nothing), (consistent, found))
    )
    return consistent if _is_better(compared(found), known) and is_harmless(after, before) else None


def _power(rows: Rows, left: Tensor) -> float:
    """κ = 1/τ̄ of what nothing explains, as in `likelihood_power`."""
    times = autocorrelation_time(left[: rows.leading], rows.segment[: rows.leading])
    return min(1.0, math.exp(-float(times.log().mean())))


def _normal(given: Sums, noise: Tensor, power: float) -> tuple[Tensor, Tensor]:
    """Linear term κ h and precision κ H + 1 of the unknowns, without directions in which H is negative."""
    H, h = given.quadratic(noise)
    values, vectors = torch.linalg.eigh(0.5 * (H + H.mT))
    shown = vectors * (values > 0.0)
    precision = power * (vectors * values.clamp(min=0.0)) @ vectors.mT
    return power * shown @ (vectors.mT @ h), precision + torch.eye(len(h), dtype=h.dtype, device=h.device)


def _estimate(given: Sums, noise: Tensor, power: float) -> Tensor:
    """Most probable unknowns, of which the first n, the drives, are not negative."""
    h, precision = _normal(given, noise, power)
    n = len(noise)
    drives = torch.linalg.solve(precision, h)[:n].clamp(min=0.0)
    links = torch.linalg.solve(precision[n:, n:], h[n:] - precision[n:, :n] @ drives)
    return torch.cat([drives, links])


def _drives_alone(every: Sums, noise: Tensor, n: int) -> Tensor:
    """The unknowns with the inertia of drives alone, which is not negative."""
    H, h = every.quadratic(noise)
    drives = torch.linalg.lstsq(H[:n, :n], h[:n, None]).solution[:, 0].clamp(min=0.0)
    return torch.cat([drives, torch.zeros_like(h[n:])])


def _is_better(after: Tensor, before: Tensor) -> bool:
    """Whether errors `(groups, nq)` are significantly smaller, in the mean of the joints."""
    return is_less((after - before).mean(-1))
