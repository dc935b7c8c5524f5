"""Torque noise and its growth beyond the trained region, from held-out blocks of the log.

The variance on new motions is estimated from blocks of the training log that the posterior was not
conditioned on.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping

import scipy
import torch
from torch import Tensor

from forcegp.data.fields import resolution
from forcegp.forces.measurements import Training
from forcegp.forces.noise import TORQUE_NOISE
from forcegp.forces.posterior import (
    GROWTH,
    RELATIVE,
    ForcePosterior,
    distance_beyond,
    hidden_variance,
    trained_region,
)
from forcegp.forces.problem import (
    PIECE_SAMPLES,
    Problem,
    Totals,
    basis_of,
    force_posterior,
    posterior_of,
    total_over,
    typical,
)
from forcegp.forces.quantities import States, affine_map
from forcegp.forces.unknowns import tip_factor

STRETCHES, RECORDINGS = 8, 5
"""Number of contiguous blocks into which a log with fewer segments than the second number is divided. Two
known standard errors correspond to 4.5 estimated from three blocks, and to 2.9 from five (Student's t)."""
MOST_STRETCHES = 16
"""Maximum number of blocks, each of which requires a posterior; a block may consist of several segments."""
FEWEST = 50
"""Minimum number of samples required for calibration."""
SWEEPS, SETTLED = 20, 1e-3
"""Maximum number of sweeps over the joints, and relative change in the noise at convergence."""
REGIME = 0.25
"""Fraction of the samples in the fast regime and in the heavily loaded regime."""
PRIOR_SAMPLES = 4.0
"""Weight of the prior in `growth`, as an equivalent number of independent samples."""


def calibrated_noise(problem: Problem, hyperparameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return torque noise calibrated on held-out samples, the trained region, and error growth outside it."""
    load, training = problem.typical_load(), problem.training
    each = ((m.qd, problem.torque(m)) for m in training.measurements)
    qd, tau = map(torch.cat, zip(*each, strict=True))
    # Rounding to steps h has the variance h²/12.
    rounding = torch.from_numpy(resolution(tau.cpu().numpy())).to(tau) / math.sqrt(12.0)
    learned = hyperparameters[TORQUE_NOISE].exp().maximum(rounding)
    driven = problem.system.robot.driven
    std = held_out_torque_std(problem, hyperparameters, learned).where(driven, learned)
    noise = {TORQUE_NOISE: std.log()}
    grows = driven * growth(problem, {**hyperparameters, **noise}, load)
    region = trained_region(qd, tau, load, problem.power * len(qd))
    return {**noise, **region, GROWTH: grows}


def held_out_torque_std(problem: Problem, hyperparameters: Mapping[str, Tensor], least: Tensor) -> Tensor:
    """Return the torque noise `(nq,)` for which normalised errors on held-out blocks have unit variance.

    Each block is predicted from all others with the given hyperparameters. The force error computed from
    accelerations is r = M(q̈ − E q̈) = P ε, where P = I in free motion. For joint i, s_i² is the solution of
    mean(r_i² / (Σ_k P_ik² s_k² + Var r_i)) = 1, where the mean is over all samples with P_ii above one half.

    Args:
        least: the learned standard deviations, which are the lower bounds.
    """
    parts = held_out_blocks(problem, hyperparameters)
    if sum(len(residual) for residual, _, _ in parts) < FEWEST:
        return least
    residual, variance, P = (torch.cat(part) for part in zip(*parts, strict=True))
    return unit_scales(residual**2, variance, P**2, least)


def held_out_blocks(
    problem: Problem, hyperparameters: Mapping[str, Tensor]
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return the residuals, variances and P of each block of the log (see `_held_out`)."""
    return [
        _held_out(problem, hyperparameters, posterior, i, rows)
        for i in problem.training.motions
        for rows, posterior in posteriors_of_others(problem, hyperparameters, i)
    ]


def held_out_squares(problem: Problem, hyperparameters: Mapping[str, Tensor]) -> Tensor:
    """Return the mean squared torque error of each joint on each block of the log `(blocks, nq)`."""
    squares = []
    for i in problem.training.motions:
        for rows, posterior in posteriors_of_others(problem, hyperparameters, i):
            m = problem.training.measurements[i][rows]
            at = m.at(problem.system)
            z = affine_map(problem.system, at, m.quantity)
            residual = _torque_error(problem, i, rows, at, posterior.read_mean(problem.system, at, z))
            squares.append(residual.square().mean(0))
    return torch.stack(squares)


def _torque_error(problem: Problem, i: int, rows: Tensor, at: States, mean: Tensor) -> Tensor:
    """Return the torque errors `(n, nq)` of rows of measurement i, M times those of accelerations."""
    m, weights = problem.training.measurements[i], problem.training.weights
    error = m.values[rows] - mean
    error = error if m.quantity == "joint_force" else (at.eom.M @ error[..., None])[..., 0]
    return error if weights is None else weights[i][rows].sqrt()[:, None] * error


def growth(problem: Problem, hyperparameters: Mapping[str, Tensor], load: Tensor) -> Tensor:
    """Return the growth rate g `(nq,)` of torque standard deviations outside the trained region.

    The fastest quarter and the most heavily loaded quarter of the training samples are predicted from the
    rest; D is their distance from the region of the rest. The rate is g = c · load with a common c for all
    joints. c is the posterior mode under r_i ~ N(0, V_i + Σ_k P_ik² (s_k² + g_k² D_k²)), tempered like the
    likelihood, and a scaled inverse-χ² prior, which dominates if the log has only one regime.

    Args:
        problem: the learned problem, including its likelihood exponent.
        hyperparameters: hyperparameters, including the predicted torque noise.
        load: typical torque of each joint `(nq,)` [N m, N].
    """
    s2, square, known, slope = hyperparameters[TORQUE_NOISE].exp() ** 2, [], [], []
    for i in problem.training.motions:
        m = problem.training.measurements[i]
        tau = problem.torque(m)
        for x in (m.qd, tau):
            intensity = ((x - x.mean(0)) / x.std(0).clamp(min=1e-12)).abs().amax(-1)
            top = intensity > intensity.quantile(1.0 - REGIME)
            if min(int(top.sum()), int((~top).sum())) < FEWEST:
                continue
            rest = trained_region(m.qd[~top], tau[~top], load)
            rows = top.nonzero()[:, 0]
            others = dataclasses.replace(problem, training=problem.training.without(i, rows))
            posterior = force_posterior(others, hyperparameters)
            residual, V, P = _held_out(problem, hyperparameters, posterior, i, rows)
            D = distance_beyond(rest, m.qd[rows], tau[rows])
            reached = (P.diagonal(dim1=-2, dim2=-1) > 0.5) & (D > 0.0)
            square.append(residual.square()[reached])
            known.append((V + P.square() @ s2)[reached])
            slope.append((P.square() @ (load * D).square()[..., None])[..., 0][reached])
    r2, V, a = (torch.cat(x) if x else load[:0] for x in (square, known, slope))

    def objective(log_c2: float) -> float:
        c2 = math.exp(log_c2)
        v = V + c2 * a
        misfit = 0.5 * problem.power * float((v.log() + r2 / v).sum())
        return misfit + 0.5 * PRIOR_SAMPLES * (log_c2 + RELATIVE**2 / c2)

    bounds = (2.0 * math.log(1e-2 * RELATIVE), 2.0 * math.log(1e2 * RELATIVE))
    minimum = scipy.optimize.minimize_scalar(objective, bounds=bounds, method="bounded")
    return math.exp(0.5 * float(minimum.x)) * load


def stretches(segment: Tensor) -> Tensor:
    """Return the block index of each sample. Blocks are segments, or eighths of a log with fewer segments."""
    _, block = segment.unique(return_inverse=True)
    if int(block.max()) + 1 >= RECORDINGS:
        return block % MOST_STRETCHES
    n = len(segment)
    return torch.arange(n, device=segment.device) * STRETCHES // max(n, 1)


def posteriors_of_others(
    problem: Problem, hyperparameters: Mapping[str, Tensor], measurement: int
) -> Iterator[tuple[Tensor, ForcePosterior]]:
    """Yield the rows of each block of a measurement, and the forces conditioned on all other samples.

    The sums of the other blocks are added. Subtracting a block from the sums of the whole log could leave an
    indefinite matrix, since the rounding errors of large sums can exceed the prior precision.
    """
    training = problem.training
    group = stretches(training.measurements[measurement].segment)
    blocks = [(group == g).nonzero()[:, 0] for g in group.unique().tolist()]
    if problem.inducing is None:
        for rows in blocks:
            others = dataclasses.replace(problem, training=training.without(measurement, rows))
            yield rows, force_posterior(others, hyperparameters)
        return
    basis = basis_of(problem, hyperparameters)

    def over(part: Training) -> Totals:
        return total_over(problem, hyperparameters, basis, part.pieces(PIECE_SAMPLES))

    def only(rows: Tensor) -> Training:
        index = range(len(training.measurements))
        return training.of_rows([rows if i == measurement else rows[:0] for i in index])

    everything = torch.arange(len(group), device=group.device)
    elsewhere = over(training.without(measurement, everything))
    totals = [over(only(rows)) for rows in blocks]
    for k, rows in enumerate(blocks):
        total = sum((totals[j] for j in range(len(totals)) if j != k), start=elsewhere)
        yield rows, posterior_of(problem, hyperparameters, basis, total)


def _held_out(
    problem: Problem,
    hyperparameters: Mapping[str, Tensor],
    posterior: ForcePosterior,
    i: int,
    rows: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return torque residuals `(n, nq)` of rows of measurement i, their variance without noise, and P.

    Args:
        posterior: forces conditioned on other samples.
        rows: rows of the measurement.
    """
    training, std = problem.training, problem.noise_at(hyperparameters, i)
    m, system = training.measurements[i][rows], problem.system
    at = m.at(system)
    z, M = affine_map(system, at, m.quantity), at.eom.M
    if m.quantity == "joint_force":
        M = torch.eye(M.shape[-1], dtype=M.dtype, device=M.device).expand_as(M)
    P = M @ z.B_Q
    mean, covariance = posterior.read(system, at, z)
    residual = _torque_error(problem, i, rows, at, mean)
    spread = (M @ covariance @ M.mT).diagonal(dim1=-2, dim2=-1)
    stick = (P**2 @ hidden_variance(hyperparameters, at, problem.external_std)[..., None])[..., 0]
    tips = tip_factor(hyperparameters, system, at)
    if tips is not None:
        stick = stick + (M @ z.B_z @ tips).square().sum(-1)
    return residual, spread + (M**2 @ typical(std) ** 2) + stick, P


def unit_scales(r2: Tensor, V: Tensor, share: Tensor, least: Tensor) -> Tensor:
    """Solve mean(r_i² / (Σ_k share_ik s_k² + V_i)) = 1 for s, one joint at a time.

    Args:
        r2, V: `(n, nq)` squared errors, and the part of their variance that is not due to noise.
        share: `(n, nq, nq)` P_ik², the contribution of the noise of joint k to the error of joint i.
        least: `(nq,)` lower bounds.
    """
    s = least.clone()
    for _ in range(SWEEPS):
        before = s.clone()
        for i in range(len(s)):
            share_ii = share[:, i, i]
            shows = share_ii > 0.25
            if int(shows.sum()) < FEWEST:
                continue
            others = (share[:, i] @ s**2 - share_ii * s[i] ** 2 + V[:, i])[shows]
            s[i] = _unit_scale(r2[shows, i] / share_ii[shows], others / share_ii[shows], least[i])
        if torch.allclose(s, before, rtol=SETTLED, atol=0.0):
            break
    return s


def _unit_scale(r2: Tensor, V: Tensor, least: Tensor) -> Tensor:
    """Solve mean(r² / (s² + V)) = 1 for s ≥ `least`."""
    low, high = 2.0 * math.log(float(least)), math.log(float(r2.mean()) + float(least) ** 2) + 1.0

    def excess(log_variance: float) -> float:
        return float((r2 / (math.exp(log_variance) + V)).mean()) - 1.0

    if excess(low) <= 0.0:
        return least
    return torch.full_like(least, math.exp(0.5 * float(scipy.optimize.brentq(excess, low, high))))  # pyright: ignore[reportArgumentType]
