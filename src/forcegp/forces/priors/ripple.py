"""Ripple: a torque that is periodic in the angle of a joint, from the teeth of gears and poles of motors.

The wave numbers k of a joint are not in a robot file. They are read off the residual torque e of a log, whose
periodogram over the angle is P(k) = |Σ e exp(−i k q)|². Without ripple, P is exponentially distributed around
a level that varies slowly with k, whatever the correlation of e in time. A ripple is a line above this level
(Fisher, *Tests of significance in harmonic analysis*, 1929).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import max_pool1d

from forcegp.forces.term import FORCE, Array, JointState, JointTerm, Units, constants, cos, sin
from forcegp.gp.kernels import Columns, Kernel

MOST_WAVES = 4
"""Maximum number of wave numbers of a joint: two sources, each with a harmonic."""
SHORTEST = 640.0
"""Largest wave number [1/rad, 1/m]: two per input turn of the largest harmonic drives, of ratio 320."""
FEWEST_PERIODS = 3.0
"""Number of periods below which a wave is not told from a smooth function of the angle. Of 40 waves of
simulated arms, 37 are found (31 with 5 periods), and none is false. Twelve logs without ripple have two false
lines, of more than 80 periods."""
CERTAIN = 5.0
"""Log probability against a line among all wave numbers in noise with an even level [nats], as `DECISIVE` for
columns. If the level is steep, as of strongly correlated noise, a few percent of joints get a false line."""
OVERSAMPLING, NEIGHBOURS = 4, 64
"""Wave numbers per resolved line, and number of resolved lines from which the level is computed."""
BINS = 16384
"""Bins of the angle per turn. A wave of the largest wave number has 25 bins."""


@dataclass(frozen=True)
class RipplePrior(JointTerm):
    """A prior on ripple, Q_i = Σ_k (a_ik sin k q_i + b_ik cos k q_i).

    Args:
        waves: wave numbers k of each joint [1/rad, 1/m], the same number for each joint; zero for none. An
            automatic fit determines them from the log.
        kernel: covariance of each component.
        name: prefix of the hyperparameters.

    Example:
        >>> RipplePrior(waves=((30.0,), (0.0,))).name
        'ripple'
    """

    waves: tuple[tuple[float, ...], ...] = ()
    kernel: Kernel = field(default_factory=Columns)
    name: str = "ripple"

    units: ClassVar[Units] = {"sin_": FORCE, "cos_": FORCE}

    def columns(self, x: JointState) -> dict[str, Array]:
        columns = {}
        for i, k in enumerate(zip(*self.waves, strict=True)):
            angle, exists = x.q * constants(x.qd, k), constants(x.qd, [float(each != 0.0) for each in k])
            columns |= {f"sin_{i}": sin(angle), f"cos_{i}": exists * cos(angle)}
        return columns


def ripple_of(q: Tensor, residual: Tensor) -> RipplePrior | None:
    """Return the ripple of a log, or `None` if there is none.

    Args:
        q: angles `(n, nq)` [rad, m].
        residual: torques that nothing else explains `(n, nq)` [N m, N].
    """
    waves = [waves_of(*pair) for pair in zip(q.T, residual.T, strict=True)]
    most = max(map(len, waves))
    if not most:
        return None
    return RipplePrior(waves=tuple((*each, *(most - len(each)) * (0.0,)) for each in waves))


def waves_of(q: Tensor, residual: Tensor) -> tuple[float, ...]:
    """Return the wave numbers of the ripple of one joint, the strongest first; see `ripple_of`."""
    reach, waves, remaining = float(q.max() - q.min()), [], _without(q, residual, [])
    while len(waves) < MOST_WAVES and reach > 0.0:
        k, power = _periodogram(q, remaining, reach)
        known, width = torch.tensor([abs(wave) for wave in waves]).to(k), 2.0 * math.pi / reach
        # Everything else is a side lobe of a line, or the slope of a smooth function.
        fresh = ((k[:, None] - known).abs() > width).all(-1) & _is_highest(power)
        fresh &= k >= FEWEST_PERIODS * width
        excess = torch.where(fresh, power / _level(power), 0.0)
        i = int(excess.argmax())
        if float(excess[i]) < math.log(len(k) / OVERSAMPLING) + CERTAIN:
            break
        waves.append(_refined(q, remaining, float(k[i]), reach))
        # A wave shifts the estimates of the others, so each is refined again without the others.
        for m, wave in enumerate(waves[:-1]):
            waves[m] = _refined(q, _without(q, residual, waves[:m] + waves[m + 1 :]), wave, reach)
        remaining = _without(q, residual, waves)
    return tuple(waves)


def _without(q: Tensor, residual: Tensor, waves: list[float]) -> Tensor:
    """Return what waves and a constant leave of a residual, by least squares."""
    X = [f(wave * q) for wave in waves for f in (torch.sin, torch.cos)]
    X = torch.stack([*X, torch.ones_like(q)], dim=-1)
    return residual - X @ torch.linalg.lstsq(X, residual[:, None]).solution[:, 0]


def _periodogram(q: Tensor, e: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """Return wave numbers and |Σ e exp(−i k q)|²."""
    width = 2.0 * math.pi / BINS
    size = max(2, math.ceil(OVERSAMPLING * reach / width))
    binned = e.new_zeros(size).index_add(0, ((q - q.min()) / width).long(), e)
    power = torch.fft.rfft(binned).abs().square()
    k = torch.arange(len(power)).to(power) * (BINS / size)
    return k[k <= SHORTEST], power[k <= SHORTEST]


def _is_highest(power: Tensor) -> Tensor:
    """Return whether the power at each wave number is the highest within the width of a resolved line."""
    highest = max_pool1d(power[None], 2 * OVERSAMPLING + 1, 1, OVERSAMPLING)
    return power == highest[0]


def _level(power: Tensor) -> Tensor:
    """Return the expected power at each wave number: the median of its neighbours over ln 2.

    The level may be steep at small wave numbers. There, fewer neighbours are used, as many on either side,
    since the median of a monotone function over a symmetric interval is its value in the middle.
    """
    half = OVERSAMPLING * NEIGHBOURS // 2
    padded = torch.cat([power, power[-half - 1 : -1].flip(0)])
    median = [padded[:1], *(padded[: 2 * i + 1].median()[None] for i in range(1, min(half, len(power))))]
    if len(power) > half:
        rest = padded.unfold(0, 2 * half + 1, OVERSAMPLING // 2).median(-1).values
        median.append(rest.repeat_interleave(OVERSAMPLING // 2)[: len(power) - half])
    return torch.cat(median).clamp(min=1e-300) / math.log(2.0)


def _refined(q: Tensor, e: Tensor, k: float, reach: float) -> float:
    """Return the wave number near k of the wave that explains most, by least squares."""
    step = 2.0 * math.pi / reach / OVERSAMPLING
    for _ in range(3):
        near = k + step * torch.linspace(-1.0, 1.0, 21).to(q)
        angle = near[:, None] * q
        X = torch.stack([angle.sin(), angle.cos(), torch.ones_like(angle)], dim=-1)
        right = X.mT @ e
        explained = (right * torch.linalg.solve(X.mT @ X, right[..., None])[..., 0]).sum(-1)
        k, step = float(near[explained.argmax()]), 0.2 * step
    return k
