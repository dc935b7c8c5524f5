"""Ripple: a torque that is periodic in the angle of a joint, from the teeth of gears and poles of motors.

The wave numbers k of a joint are not in a robot file. They are read off the residual torque e of a log, whose
periodogram over the angle is P(k) = |Σ e exp(−i k q)|². Without ripple, P is exponentially distributed around
a level that varies slowly with k, whatever the correlation of e in time. A ripple is a line above this level
(Fisher, *Tests of significance in harmonic analysis*, 1929).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.forces.term import Array, JointState, JointTerm, constants, cos, sin
from forcegp.gp.kernels import Columns, Kernel

MOST_WAVES = 4
"""Maximum number of wave numbers of a joint: two sources, each with a harmonic."""
SHORTEST = 640.0
"""Largest wave number [1/rad, 1/m]: two per input turn of the largest harmonic drives, of ratio 320."""
FEWEST_PERIODS = 5.0
"""Number of periods below which a wave is not told from a smooth function of the angle. Gears with 20 teeth
are found if a joint moves by a quarter turn."""
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
    reach, waves, left = float(q.max() - q.min()), [], residual - residual.mean()
    while len(waves) < MOST_WAVES and reach > 0.0:
        k, power = _periodogram(q, left, reach)
        known = torch.tensor([abs(wave) for wave in waves]).to(k)
        # A line is as wide as one over the angle, and strong lines have side lobes.
        fresh = ((k[:, None] - known).abs() > 2.0 * math.pi / reach).all(-1)
        if not bool(fresh.any()):
            break
        excess = torch.where(fresh, power / _level(power), 0.0)
        i = int(excess.argmax())
        if float(excess[i]) < math.log(len(k) / OVERSAMPLING) + CERTAIN:
            break
        waves.append(_refined(q, left, float(k[i]), reach))
        X = torch.stack([f(wave * q) for wave in waves for f in (torch.sin, torch.cos)], dim=-1)
        left = residual - residual.mean() - X @ torch.linalg.lstsq(X, residual[:, None]).solution[:, 0]
    return tuple(waves)


def _periodogram(q: Tensor, e: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """Return wave numbers and |Σ e exp(−i k q)|²."""
    width = 2.0 * math.pi / BINS
    size = max(2, math.ceil(OVERSAMPLING * reach / width))
    binned = e.new_zeros(size).index_add(0, ((q - q.min()) / width).long(), e)
    power = torch.fft.rfft(binned).abs().square()
    k = torch.arange(len(power)).to(power) * (BINS / size)
    used = (k >= FEWEST_PERIODS * 2.0 * math.pi / reach) & (k <= SHORTEST)
    return k[used], power[used]


def _level(power: Tensor) -> Tensor:
    """Return the expected power at each wave number: a running median over ln 2, as it is exponential."""
    half = OVERSAMPLING * NEIGHBOURS // 2
    if len(power) <= 2 * half:
        return power.median().expand_as(power).clamp(min=1e-300) / math.log(2.0)
    padded = torch.cat([power[:half].flip(0), power, power[-half:].flip(0)])
    median = padded.unfold(0, 2 * half, OVERSAMPLING // 2).median(-1).values
    return median.repeat_interleave(OVERSAMPLING // 2)[: len(power)].clamp(min=1e-300) / math.log(2.0)


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
