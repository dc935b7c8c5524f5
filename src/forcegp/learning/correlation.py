"""Correlation of residual torques in time.

Temperature, hysteresis and filters cause residuals that are correlated in time. The number of independent
samples in a log is therefore smaller by a factor equal to the integrated autocorrelation time.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import torch
from torch import Tensor

from forcegp.forces.measurements import Measurement, Training
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.problem import Problem, force_posterior
from forcegp.forces.quantities import affine_map
from forcegp.forces.unknowns import tip_factor

FEWEST = 50
"""Minimum number of samples for an estimate."""
RUNS, MOST_RESIDUALS = 8, 16_000
"""Number of contiguous runs of samples used of a longer log, and maximum number of samples in all runs."""
CHUNK_STATES = 2000
"""Number of states for which residuals are computed at a time, to limit memory use."""
NEGLIGIBLE = 0.05
"""Autocorrelation below which an estimate is considered noise."""
COVARIANCE_Z = 2.0
"""Number of standard errors above which the covariance of neighbouring samples is significant."""
WINDOW, WINDOWS = 10.0, 20
"""Window length in `correlation_times`, in autocorrelation times, and minimum number of windows."""


def autocorrelation_time(x: Tensor, segment: Tensor, white: Tensor | float = 0.0) -> Tensor:
    """Return the integrated autocorrelation time 1 + 2 Σ ρ_k of each column, in samples `(d,)`.

    The sum ends when ρ falls below 0.05, or at half the length of the longest segment. The result is 1 if the
    covariance of neighbouring samples is not significant (below two standard errors).

    Args:
        x: `(n, d)` zero-mean signals in time order.
        white: variance of white noise in x, which is subtracted.
    """
    longest = int(segment.unique(return_counts=True)[1].max())
    variance, first = _variance_in_time(x, segment, white)
    total = torch.ones_like(variance)
    open_ = first > COVARIANCE_Z * x.square().mean(0) / math.sqrt(len(x))
    for lag in range(1, longest // 2):
        rho = (first if lag == 1 else _covariance(x, segment, lag)) / variance
        open_ = open_ & (rho > NEGLIGIBLE)
        if not bool(open_.any()):
            break
        total = total + torch.where(open_, 2.0 * rho, 0.0)
    return total


def correlation_times(x: Tensor, segment: Tensor, length: int, white: Tensor | float = 0.0) -> Tensor:
    """Return the ratio of low-frequency spectral density to variance for each column, in samples `(d,)`.

    The ratio is L · mean(x̄²) / (mean(x²) − white), where x̄ are the means over windows of L samples (batch
    means, Flegal and Jones 2010). Unlike `autocorrelation_time`, it includes the negative lobes of
    oscillating residuals that barely move a robot, such as the noise of differentiated positions.

    Args:
        x: `(n, d)` zero-mean signals in time order.
        length: window length L, several times the autocorrelation time.
        white: variance of white noise in x, which is subtracted.
    """
    squares = []
    for s in segment.unique():
        part = x[segment == s]
        windows = len(part) // length
        squares.append(part[: windows * length].unflatten(0, (windows, length)).mean(1).square())
    variance = _variance_in_time(x, segment, white)[0]
    ratio = torch.cat(squares).mean(0) / variance
    # If white noise hides the signal, its correlation is unknown, and it counts as white too.
    return torch.where(variance > NEGLIGIBLE * x.square().mean(0), length * ratio.clamp(max=1.0), 1.0)


def _variance_in_time(x: Tensor, segment: Tensor, white: Tensor | float) -> tuple[Tensor, Tensor]:
    """Return the variance without white noise `(d,)`, which is at least the covariance of neighbours."""
    first = _covariance(x, segment, 1)
    return (x.square().mean(0) - white).clamp(min=1e-300).maximum(first), first


def _covariance(x: Tensor, segment: Tensor, lag: int) -> Tensor:
    """Return the mean product `(d,)` of samples in the same segment that are separated by a given lag."""
    same = segment[:-lag] == segment[lag:]
    return ((x[:-lag] * x[lag:]) * same[:, None]).sum(0) / same.sum().clamp(min=1)


def residual_times(
    problem: Problem, hyperparameters: Mapping[str, Tensor], training: Training
) -> tuple[float, Tensor | None]:
    """Return κ ≤ 1, and the `correlation_times` `(nq,)` of the joints [s] (`None` if samples are too few).

    κ = 1/τ̄, where τ̄ is the autocorrelation time of torque noise in the residuals of `training`, averaged
    geometrically over the joints. n samples contain as much information as n/τ̄ independent samples.
    """
    posterior = force_posterior(problem, hyperparameters)
    logs, times = [], []
    for i in training.motions:
        m = training.measurements[i]
        rows = _some(len(m.q)).to(m.q.device)
        if len(rows) < FEWEST:
            continue
        std = dataclasses.replace(problem, training=training).noise_at(hyperparameters, i)
        parts = [
            _torque_noise(posterior, problem, hyperparameters, m[piece], std if std.ndim == 1 else std[piece])
            for piece in rows.split(CHUNK_STATES)
        ]
        noise, white = (torch.cat(part) for part in zip(*parts, strict=True))
        segment, white = m.segment[rows], white.mean(0)
        logs.append(autocorrelation_time(noise, segment, white)[problem.system.robot.driven].log())
        longest_part = int(segment.unique(return_counts=True)[1].max())
        wanted = round(WINDOW * math.exp(float(logs[-1].mean())))
        length = max(1, min(wanted, len(rows) // WINDOWS, longest_part))
        times.append(training.period * correlation_times(noise, segment, length, white))
    if not logs:
        return 1.0, None
    return min(1.0, math.exp(-float(torch.stack(logs).mean()))), torch.stack(times).mean(0)


def _some(n: int) -> Tensor:
    """Select at most `MOST_RESIDUALS` of n rows, in contiguous blocks so that neighbours stay together."""
    if n <= MOST_RESIDUALS:
        return torch.arange(n)
    length = MOST_RESIDUALS // RUNS
    first = torch.linspace(0, n - length, RUNS).round().long()
    return (first[:, None] + torch.arange(length)).flatten()


def _torque_noise(
    posterior: ForcePosterior,
    problem: Problem,
    hyperparameters: Mapping[str, Tensor],
    m: Measurement,
    std: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the estimated torque noise of each joint divided by its standard deviation, and the contribution
    of white acceleration noise to the variance of this estimate, each `(n, nq)`.

    Residuals are r = B ε + e with torque noise ε ~ N(0, S) and white noise e ~ N(0, Σ), where B = H for
    accelerations. e masks the correlation of ε, and contributes least to the estimate E[ε | r] = G r.
    """
    system, force_noise = problem.system, problem.force_noise(hyperparameters)
    assert force_noise is not None
    at = m.at(system)
    z = affine_map(system, at, m.quantity)
    r = m.values - posterior.read_mean(system, at, z)
    # G = S Bᵀ (B S Bᵀ + Σ)⁻¹
    S, B = force_noise(at), z.B_Q
    white = std.square().expand_as(r)
    SB = S[..., None] * B.mT
    C = B @ SB + torch.diag_embed(white)
    tips = tip_factor(hyperparameters, system, at)
    if tips is not None:
        C = C + (z.B_z @ tips) @ (z.B_z @ tips).mT
    G = torch.linalg.solve(C, SB, left=False)
    return (G @ r[..., None])[..., 0] / S.sqrt(), (G.square() @ white[..., None])[..., 0] / S
