"""Friction of a joint as simulators take it: polynomial damping, and LuGre's dry friction with memory.

    F = (d + b |q̇| + c q̇²) q̇ + σ₀ z,   dz/dt = q̇ − σ₀ |q̇| z / g(q̇),   g(q̇) = f + s e^{−(q̇/v_s)²}

is fitted to the learned friction by least squares, at the speeds of harmonic motions of different amplitudes
before and after each reversal. Without memory, σ₀ z = g(q̇) sign q̇. Of the laws with and without (b, c) and s,
the closest is taken in which these are more than two standard deviations from zero. Damping never drives a
joint, since d + b v + c v² is a sum of 1, v, v² and (v − v_k)² with weights of at least zero.
Source: Canudas de Wit et al., *A new model for control of systems with friction* (1995).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls
from torch import Tensor

from forcegp.forces.priors.memory import DISTANCES
from forcegp.forces.term import NEAR_REST

Array = NDArray[np.float64]
PARAMETERS = ("damping", "quadratic", "cubic", "friction", "stribeck", "stribeck_velocity", "bristle")
"""The parameters d, b, c, f, s, v_s and σ₀."""
RATE = 4.0
"""Ratio of acceleration to speed of the motions [1/s]."""
COUNT, LEVELS = 16, (3, 6, 9, 12, 15)
"""Number of speeds, and those among them that are the largest of a motion."""
SLOWEST_SPEED = 2.0 * NEAR_REST
"""Smallest speed [rad/s, m/s]. Below it, learned dry friction is smoothed."""
PHASES = 200
"""Steps in which a bristle is followed from one reversal to the next."""
DETERMINED_STDS = 2.0
"""Number of standard deviations from zero of memory, and of (b, c) and s, that count as determined."""
GRID, WIDER = 7, 1.0
"""Number of starting values of δ, s/f and v_s, and how far the search may leave their range [log]."""
EXCESS = (0.05, 3.0)
"""Range of s/f at the start of the search."""


@dataclass(frozen=True)
class Reversals:
    """States of all joints in harmonic motions, at the same speeds before and after reversals.

    Attributes:
        speeds: `(k, nq)`, those of one direction from the slowest to the fastest [rad/s, m/s].
        index: of the speed of each state among −`speeds` in reverse order and `speeds`, `(n,)`.
        level: of the largest speed of its motion, `(n,)`. The first half of the states moves backwards.
        late: whether the state is before a reversal and not after one, `(n,)`.
    """

    speeds: Tensor
    index: Tensor
    level: Tensor
    late: Tensor

    @classmethod
    def of(cls, fastest: Tensor) -> Reversals:
        """Return the states for the fastest speeds `(nq,)`."""
        slowest = torch.minimum(torch.full_like(fastest, SLOWEST_SPEED), 0.25 * fastest)
        share = torch.linspace(0.0, 1.0, COUNT).to(fastest)[:, None]
        rows = [(k, m, late) for m in LEVELS for k in range(m + 1) for late in (0, 1)]
        k, m, late = torch.tensor(rows, device=fastest.device).T
        index = torch.cat([COUNT - 1 - k, COUNT + k])
        return cls(slowest * (fastest / slowest) ** share, index, m.repeat(2), late.bool().repeat(2))

    @property
    def both(self) -> Tensor:
        """Speeds of both directions, `(2 k, nq)`."""
        return torch.cat([-self.speeds.flip(0), self.speeds])

    @property
    def qd(self) -> Tensor:
        """Velocities `(n, nq)`."""
        return self.both[self.index]

    def phases(self) -> Tensor:
        """Return the phases since the last reversal `(n, nq)`, from 0 to π."""
        rising = torch.asin((self.qd.abs() / self.speeds[self.level]).clamp(max=1.0))
        return torch.where(self.late[:, None], math.pi - rising, rising)

    def history(self) -> Tensor:
        """Return the states of bristles `(n, nq, 2 k)` after many periods; see `memory.bristles`."""
        half = self.speeds[self.level] / RATE
        travel = half * (1.0 - torch.cos(self.phases()))
        delta = half.new_tensor(DISTANCES)
        z = 1.0 - (1.0 + torch.tanh(half[..., None] / delta)) * torch.exp(-travel[..., None] / delta)
        z = z * self.qd.sign()[..., None]
        return torch.cat([z, torch.zeros_like(z)], dim=-1)


@dataclass(frozen=True)
class Laws:
    """Friction laws of all joints, for the posterior mean and for samples.

    Attributes:
        values: `PARAMETERS` `(1 + samples, nq, 7)`; σ₀ is zero without memory.
        left: RMS friction that the law of the mean does not explain, `(nq,)` [N m, N].
    """

    values: Array
    left: Array

    @property
    def has_memory(self) -> NDArray[np.bool_]:
        """Whether each joint has memory, `(nq,)`."""
        return self.values[0, :, 6] > 0.0


class _Joint:
    """States of one joint, with what its bristle does there."""

    def __init__(self, at: Reversals, j: int) -> None:
        self.v, self.phase = at.qd[:, j].cpu().numpy(), at.phases()[:, j].cpu().numpy()
        self.peaks, self.level = at.speeds[list(LEVELS), j].cpu().numpy(), at.level.cpu().numpy()

    def direction(self, delta: Array, excess: Array, speed: Array) -> Array:
        """Return σ₀ z / f `(g, n)` for δ = f/σ₀, s/f and v_s, `(g,)` each; δ = 0 is no memory."""
        if not delta.any():
            gamma = 1.0 + excess[:, None] * np.exp(-((self.v / speed[:, None]) ** 2))
            return gamma * np.sign(self.v)
        phase = np.linspace(0.0, np.pi, PHASES + 1)
        middle = 0.5 * (phase[1:] + phase[:-1])
        v = self.peaks[:, None] * np.sin(middle)
        travel = self.peaks[:, None] / RATE * -np.diff(np.cos(phase))
        gamma = 1.0 + excess[:, None, None] * np.exp(-((v / speed[:, None, None]) ** 2))
        a = np.exp(-travel / (delta[:, None, None] * gamma))
        # ζ⁺ = a ζ + (1 − a) γ, and ζ is −ζ after half a period
        slope, path = np.ones(a.shape[:2]), np.zeros((*a.shape[:2], PHASES + 1))
        for k in range(PHASES):
            path[..., k + 1] = a[..., k] * path[..., k] + (1.0 - a[..., k]) * gamma[..., k]
            slope = slope * a[..., k]
        first = -path[..., -1] / (1.0 + slope)
        path += first[..., None] * np.concatenate([np.ones_like(a[..., :1]), np.cumprod(a, axis=-1)], axis=-1)
        at = np.empty((len(delta), len(self.v)))
        place = self.phase / np.pi * PHASES
        low = np.minimum(place.astype(int), PHASES - 1)
        for m, level in enumerate(LEVELS):
            at_level = self.level == level
            before, after = path[:, m, low[at_level]], path[:, m, low[at_level] + 1]
            at[:, at_level] = before + (place - low)[at_level] * (after - before)
        return at * np.sign(self.v)

    def powers(self, curved: bool) -> Array:
        """Return the columns of d, or of d, b and c, and of an offset, `(n, p + 1)`."""
        v = self.v
        columns = [v, np.abs(v) * v, v**3] if curved else [v]
        return np.stack([*columns, -np.ones_like(v)], axis=1)

    def best(self, y: Array, powers: Array, bends: bool, peaked: bool) -> tuple[float, float, float]:
        """Return the δ, s/f and v_s of the closest law for any d, b, c, f and offset, found from a grid."""
        Q, _ = np.linalg.qr(powers)
        rest = y - Q @ (Q.T @ y)
        fast = max(SLOWEST_SPEED, 0.5 * np.abs(self.v).max())
        ranges = np.log([(DISTANCES[0] / 3.0, 3.0 * DISTANCES[-1]), EXCESS, (0.5 * SLOWEST_SPEED, fast)])
        free = np.array([bends, peaked, peaked])
        if not free.any():
            return 0.0, 0.0, 1.0

        def residual(x: Array) -> Array:
            """Return what the laws with logarithms x `(g, k)` leave of the friction, `(g, n)`."""
            shape = np.tile([0.0, 0.0, 1.0], (len(x), 1))
            shape[:, free] = np.exp(x)
            bend = self.direction(*shape.T)
            bend = bend - (bend @ Q) @ Q.T
            return rest - np.maximum(bend @ rest, 0.0)[:, None] / (bend**2).sum(-1, keepdims=True) * bend

        grid = np.array(list(product(*(np.linspace(low, high, GRID) for low, high in ranges[free]))))
        start = grid[(residual(grid) ** 2).sum(-1).argmin()]
        bounds = tuple((ranges[free] + [-WIDER, WIDER]).T)
        parameters = np.array([0.0, 0.0, 1.0])
        parameters[free] = np.exp(least_squares(lambda x: residual(x[None])[0], start, bounds=bounds).x)
        return tuple(parameters.tolist())

    def law(self, y: Array, bends: bool, curved: bool, peaked: bool) -> tuple[Array, float]:
        """Return the closest law to friction y `(n,)`, and the RMS of what it does not explain."""
        powers = self.powers(curved)
        shape = self.best(y, powers, bends, peaked)
        bend = self.direction(*(np.array([x]) for x in shape))[0]
        # d + b v + c v² ≥ 0
        size, cone = np.abs(self.v), [(1.0, 0.0, 0.0)]
        if curved:
            cone += [(0.0, 1.0, 0.0)]
            cone += [(p * p, -2.0 * p, 1.0) for p in size.max() * np.linspace(0.0, 2.0, 2 * COUNT)]
        rays = np.array(cone)
        columns = (rays @ np.stack([np.ones_like(size), size, size**2]) * self.v).T
        # The states are those of both directions, so an offset is the mean of the friction.
        weights, _ = nnls(np.column_stack([columns, bend]), y - y.mean())
        dry, (delta, excess, speed) = weights[-1], shape
        stiffness = dry / delta if delta else 0.0
        law = np.array([*(weights[:-1] @ rays), dry, excess * dry, speed, stiffness])
        return law, _rms(y - y.mean() - np.column_stack([columns, bend]) @ weights)

    def sampled(self, law: Array, y: Array, bends: bool, curved: bool, peaked: bool) -> Array:
        """Return the laws of the samples `(samples, 7)`, to first order in their distance from the mean."""
        dry = ((3,), (4, 5) if peaked else (), (6,) if bends else ()) if law[3] > 0.0 else ()
        free = [0, *((1, 2) if curved else ()), *sum(dry, ())]
        logarithms = [i for i in free if i > 4]

        def force(x: Array) -> Array:
            values = law.copy()
            values[free] = x
            values[logarithms] = np.exp(values[logarithms])
            d, b, c, f, s, speed, stiffness = values
            shape = f / stiffness if stiffness else 0.0, s / f if f else 0.0, speed
            bend = self.direction(*(np.array([x]) for x in shape))[0]
            size = np.abs(self.v)
            return (d + b * size + c * size**2) * self.v + f * bend

        start, law_logs = law[free].copy(), np.log(law[logarithms])
        start[[free.index(i) for i in logarithms]] = law_logs
        step = 1e-4 * np.maximum(np.abs(start), 1e-3)
        slopes = [(force(start + e) - force(start - e)) / (2.0 * e.sum()) for e in np.diag(step)]
        J = np.column_stack([*slopes, -np.ones_like(self.v)])
        scale = np.sqrt((J**2).sum(0))
        scale[scale == 0.0] = 1.0  # v_s below all speeds has no effect
        change = ((y[1:] - y[0]) @ np.linalg.pinv(J / scale, rcond=1e-6).T / scale)[:, :-1]
        values = np.tile(law, (len(change), 1))
        values[:, free] = start + change
        values[:, logarithms] = np.exp(values[:, logarithms].clip(law_logs - WIDER, law_logs + WIDER))
        values[:, [0, 2, 3, 4]] = values[:, [0, 2, 3, 4]].clip(min=0.0)
        values[:, 1] = np.maximum(values[:, 1], -2.0 * np.sqrt(values[:, 0] * values[:, 2]))
        return values


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _distance(x: Array, samples: Array) -> float:
    """Return √(xᵀ C⁻¹ x / k) for the covariance C of samples `(n, k)`, without numbers that are fixed."""
    std = samples.std(0)
    x, samples, std = x[std > 0.0], samples[:, std > 0.0], std[std > 0.0]
    if not len(x):
        return 0.0
    inverse = np.linalg.pinv(np.atleast_2d(np.cov(samples.T / std[:, None])), hermitian=True)
    return float(np.sqrt(x / std @ inverse @ (x / std) / len(x)))


def laws_of(at: Reversals, sliding: Tensor, memory: Tensor | None = None, *, static: bool = True) -> Laws:
    """Fit the law of each joint.

    Args:
        at: the states.
        sliding: friction at the speeds of both directions without a past, of the posterior mean and of
            samples, `(1 + samples, 2 k, nq)` [N m, N].
        memory: the odd part that depends on the past, at the states that move forwards, `(1 + samples, n/2,
            nq)`; `None` without.
        static: whether s may differ from zero without memory, which no robot file supports.

    Returns:
        The laws. A joint has memory if its RMS is above two standard deviations.
    """
    laws, residuals = [], []
    for j in range(sliding.shape[-1]):
        joint, y, bends = _Joint(at, j), sliding[:, at.index, j].cpu().numpy(), False
        if memory is not None:
            past = memory[..., j].cpu().numpy()
            past = np.concatenate([-past, past], axis=1)
            bends = _rms(past[0]) > DETERMINED_STDS * _rms(past[1:] - past[0])
            y = y + past if bends else y
        candidates = []
        for curved, peaked in product((False, True), repeat=2):
            if static or bends or not peaked:
                law, rest = joint.law(y[0], bends, curved, peaked)
                samples = joint.sampled(law, y, bends, curved, peaked)
                extra = [*((1, 2) if curved else ()), *((4,) if peaked else ())]
                if _distance(law[extra], samples[:, extra]) > DETERMINED_STDS or not extra:
                    candidates.append((rest, np.concatenate([law[None], samples])))
        rest, values = min(candidates, key=lambda each: each[0])
        laws.append(values)
        residuals.append(rest)
    return Laws(np.stack(laws, axis=1), np.array(residuals))
