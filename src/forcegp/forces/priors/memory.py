"""Dry friction with memory: bristles that bend before a joint slides.

If friction is a function of velocity, it jumps when a joint reverses. Real friction develops over a distance
δ. In Dahl's model, it is proportional to the state z of a bristle, with dz/dt = q̇/δ − |q̇| z/δ (Dahl 1976,
*Solid friction damping of mechanical vibrations*). Along a log in time order, z follows from the velocities.

A single state has no past, and there z is unknown. The columns are therefore z̃ = z − E[z | q̇], the part of z
that the velocity does not explain in the training log. Without a past, z̃ = 0, and its variance is that of an
unknown force. After a travel s since the start of a log, z depends on its initial value by a factor
a = e^{−s/δ}, and z̃ = z − (1 − a) E[z | q̇].
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from forcegp.data.fields import in_time
from forcegp.forces.term import FORCE, SPEEDS, Array, JointState, JointTerm, Units, constants
from forcegp.gp.kernels import Columns, Kernel

DISTANCES = (0.003, 0.01, 0.03, 0.1)
"""Distances δ over which dry friction develops [rad, m]: those of harmonic drives and of bearings. Columns of
neighbouring distances are nearly collinear, so more of them change nothing."""
RIDGE = 1e-3
"""Ridge penalty on the coefficients of E[z | q̇], per sample; slow joints have nearly collinear functions."""
PAST = "bristle_"
"""Start of the names of the states of bristles in the extras of a piece of a log, `(n, nq)` each."""
LONGEST_STEP = 0.05
"""Longest time between samples over which the state of a bristle can be followed [s]."""


@dataclass(frozen=True)
class BristlePrior(JointTerm):
    """A prior on the part of dry friction that depends on the past, Q_i = Σ_δ w_iδ z̃_iδ.

    Args:
        kernel: covariance of each component.
        name: prefix of the hyperparameters.
        expected: coefficients e of E[z | q̇]_iδ = Σ_v e_ivδ tanh(q̇_i/v) for each joint, speed v in `SPEEDS`
            and distance δ, from the training log. By default, they are zero.

    Example:
        >>> BristlePrior().name
        'bristles'
    """

    kernel: Kernel = field(default_factory=Columns)
    name: str = "bristles"
    expected: tuple[tuple[tuple[float, ...], ...], ...] = ()

    remembers = True
    units: ClassVar[Units] = {"z_": FORCE}

    def columns(self, x: JointState) -> dict[str, Array]:
        count = len(DISTANCES)
        if x.history is None:
            return {f"z_{k}": x.qd * 0.0 for k in range(count)}
        z, unknown = x.history[:count], x.history[count:]
        if not self.expected:
            return {f"z_{k}": column for k, column in enumerate(z)}
        e, functions = constants(x.qd, self.expected), [*map(x.direction, SPEEDS)]
        columns = {}
        for k in range(count):
            mean = torch.stack([e[:, v, k] * f for v, f in enumerate(functions)]).sum(0)
            columns[f"z_{k}"] = z[k] - (1.0 - unknown[k]) * mean.clamp(-1.0, 1.0)
        return columns

    def expecting(self, qd: Tensor, history: Tensor) -> BristlePrior:
        """Return the prior with E[z | q̇] of a training log.

        Args:
            qd: velocities of samples in motion `(n, nq)` [rad/s, m/s].
            history: states of bristles at these samples, as returned by `bristles`.
        """
        z, unknown = history.transpose(0, 1).chunk(2, dim=-1)
        X = torch.stack([torch.tanh(qd / speed) for speed in SPEEDS], dim=-1).transpose(0, 1)
        fits = []
        for k in range(z.shape[-1]):
            known = (1.0 - unknown[..., k])[..., None] * X
            gram = known.mT @ known + RIDGE * len(qd) * torch.eye(len(SPEEDS)).to(X)
            fits.append(torch.linalg.solve(gram, known.mT @ z[..., k, None]))
        e = torch.cat(fits, dim=-1)
        return replace(self, expected=tuple(tuple(map(tuple, joint)) for joint in e.tolist()))


@dataclass(frozen=True)
class Past:
    """The last row of a piece of a log.

    Attributes:
        t, qd, segment: its time `(1,)`, velocities `(1, nq)` and trajectory number `(1,)`.
        history: states of its bristles `(1, nq, 2 k)`.
    """

    t: Tensor
    qd: Tensor
    segment: Tensor
    history: Tensor


def bristles(t: Tensor, qd: Tensor, segment: Tensor, past: Past | None = None) -> Tensor:
    """Return z and a `(n, nq, 2 k)`, first z and then a for each distance δ in `DISTANCES`, along a log.

    z is zero at the start of each trajectory, and a = e^{−s/δ} after a travel s.

    Args:
        t: time of each sample `(n,)` [s].
        qd: velocities `(n, nq)` [rad/s, m/s].
        segment: trajectory number of each sample `(n,)`.
        past: the row before this piece of a log, if its trajectory may continue.
    """
    if past is not None:
        t, qd, segment = torch.cat([past.t, t]), torch.cat([past.qd, qd]), torch.cat([past.segment, segment])
        return _followed(t, qd, segment, past.history)[1:]
    return _followed(t, qd, segment)


def _followed(t: Tensor, qd: Tensor, segment: Tensor, begin: Tensor | None = None) -> Tensor:
    """Return the states of bristles, given those of the first row; see `bristles`."""
    order = in_time(t, segment)
    t, qd, segment = t[order], qd[order], segment[order]
    starts = segment.diff(prepend=segment[:1] - 1) != 0
    # Unlike position differences, velocities are not noisier at a higher sampling rate.
    step = t.diff(prepend=t[:1])[:, None] * 0.5 * (qd + qd.roll(1, 0))
    step[starts] = 0.0
    travel = step.abs().cumsum(0)
    number = starts.cumsum(0) - 1
    travel = travel - travel[starts][number]
    # z⁺ = a z + b with a = exp(−|Δq|/δ), b = (1 − a) sgn Δq, composed over 1, 2, 4, … steps
    delta = qd.new_tensor(DISTANCES)
    a = torch.exp(-step[..., None].abs() / delta)
    b = (1.0 - a) * step[..., None].sign()
    a[starts] = 0.0
    z, unknown = (None, None) if begin is None else begin.chunk(2, dim=-1)
    if z is not None:
        b[:1] = z
    lag = 1
    while lag < len(a):
        b[lag:] = b[lag:] + a[lag:] * b[:-lag].clone()
        a[lag:] = a[lag:] * a[:-lag].clone()
        lag *= 2
    decay = torch.exp(-(travel[..., None] / delta).clamp(max=300.0))
    if unknown is not None:
        decay = torch.where((number == 0)[:, None, None], decay * unknown, decay)
    result = torch.empty(*qd.shape, 2 * len(DISTANCES), dtype=qd.dtype, device=qd.device)
    result[order] = torch.cat([b, decay], dim=-1)
    return result
