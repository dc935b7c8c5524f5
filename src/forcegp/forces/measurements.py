"""Values of quantities at states, all that a posterior is conditioned on, and which samples are impacts.

In contact A q̈ = b. Where a measurement departs from it by far more than the usual noise (an impact, a wrong
flag), the multiplier is not that of a contact that persists, and the other directions of q̈ are wrong with it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import farthest_points, standardized
from forcegp.forces.quantities import States, states
from forcegp.gp.features import Standardization
from forcegp.robust import MAD_TO_STD


@dataclass(frozen=True)
class Measurement:
    """Values of one quantity at states.

    Attributes:
        quantity: name, as in `QUANTITIES`.
        q, qd, tau: `(n, nq)` states.
        active: `(n, n_contacts)` bool.
        values: `(n, d)`.
        segment: `(n,)` trajectory of each sample; one trajectory by default.
        t: `(n,)` time of each sample [s]; zero by default.
    """

    quantity: str
    q: Tensor
    qd: Tensor
    tau: Tensor
    active: Tensor
    values: Tensor
    segment: Tensor = None  # pyright: ignore[reportAssignmentType]  # filled in below
    t: Tensor = None  # pyright: ignore[reportAssignmentType]  # filled in below

    def __post_init__(self) -> None:
        if self.segment is None:
            zero = torch.zeros(self.q.shape[:1], dtype=torch.int64, device=self.q.device)
            object.__setattr__(self, "segment", zero)
        if self.t is None:
            object.__setattr__(self, "t", torch.zeros_like(self.q[:, 0]))

    @property
    def states(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """q, q̇, τ, and which contacts are closed."""
        return self.q, self.qd, self.tau, self.active

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """q, q̇, τ, which contacts are closed, and the values."""
        return (*self.states, self.values)

    def at(self, system: ConstrainedSystem) -> States:
        """The equations of motion at the states, with the acceleration where it was measured."""
        time = torch.stack([self.t, self.segment.to(self.t)], dim=-1)
        return states(system, *self.states, qdd=self.values if self.quantity == "qdd" else None, time=time)

    def __getitem__(self, rows: Tensor) -> Measurement:
        """The values at some of the states."""
        return Measurement(self.quantity, *(part[rows] for part in (*self.tensors, self.segment, self.t)))


@dataclass(frozen=True)
class Training:
    """What a posterior is conditioned on.

    Attributes:
        measurements: the values.
        noise_std: of each measurement, `(d,)` or `(n, d)`.
        scales: standardization of the inputs of each prior.
        part_of: number of samples that are conditioned on, of which these are a part; 0 where these are all.
        period: sampling period of the log that these are from [s]; 0 where its rows are not in order.
        filter_span: of the filter that computed the accelerations [s]; 0 where the log does not state it.
        weights: of the samples of each measurement `(n,)`, which their noise variance is divided by; `None`
            for one.
        slopes: G = dz/d(q, q̇) `(n, d, 2 nq)` of each measurement with learned forces, `None` for a quantity
            without; `None` for those of the robot file (`forces/noise.py`).
    """

    measurements: tuple[Measurement, ...]
    noise_std: tuple[Tensor, ...]
    scales: tuple[Standardization, ...]
    part_of: int = 0
    period: float = 0.0
    filter_span: float = 0.0
    weights: tuple[Tensor, ...] | None = None
    slopes: tuple[Tensor | None, ...] | None = None

    @property
    def samples(self) -> int:
        """Number of samples in all measurements."""
        return sum(len(m.q) for m in self.measurements)

    @property
    def all_samples(self) -> int:
        """Number of samples that are conditioned on, of which these may be a part."""
        return self.part_of or self.samples

    def pieces(self, samples: int) -> Iterator[Training]:
        """The same samples in pieces of about this many, each with its share of every measurement."""
        count = max(1, math.ceil(self.samples / samples))
        parts = [torch.arange(len(m.q), device=m.q.device).tensor_split(count) for m in self.measurements]
        yield from (self.of_rows(rows) for rows in zip(*parts, strict=True))

    @property
    def quantities(self) -> tuple[str, ...]:
        """What was measured."""
        return tuple(m.quantity for m in self.measurements)

    def thinned(self, samples: int) -> Training:
        """About this many samples: the farthest points among the distinct states of each measurement."""
        share = samples / self.samples
        return self.of_rows([_spread(m, math.ceil(share * len(m.q))) for m in self.measurements])

    def evenly(self, samples: int) -> Training:
        """At most this many samples, evenly spaced in each measurement."""
        step = max(1, math.ceil(self.samples / samples))
        return self.of_rows([torch.arange(0, len(m.q), step, device=m.q.device) for m in self.measurements])

    def without(self, measurement: int, rows: Tensor) -> Training:
        """All samples but some rows of one measurement."""
        kept = [torch.ones(len(m.q), dtype=torch.bool, device=m.q.device) for m in self.measurements]
        kept[measurement][rows] = False
        return self.of_rows([mask.nonzero()[:, 0] for mask in kept])

    def of_rows(self, rows: Sequence[Tensor]) -> Training:
        """Some rows of each measurement."""
        return dataclasses.replace(
            self,
            part_of=0,
            measurements=tuple(m[index] for m, index in zip(self.measurements, rows, strict=True)),
            noise_std=tuple(
                std[index] if std.ndim == 2 else std for std, index in zip(self.noise_std, rows, strict=True)
            ),
            weights=None
            if self.weights is None
            else tuple(w[index] for w, index in zip(self.weights, rows, strict=True)),
            slopes=None
            if self.slopes is None
            else tuple(None if G is None else G[index] for G, index in zip(self.slopes, rows, strict=True)),
        )

    def joined(self, more: Training, noise_std: Sequence[Tensor]) -> Training:
        """These and further measurements, with the noise of the latter; slopes are of both."""
        weights, slopes = self.weights, self.slopes
        if weights is not None:
            weights = (*weights, *(torch.ones_like(m.t) for m in more.measurements))
        if slopes is not None and more.slopes is not None:
            slopes = (*slopes, *more.slopes)
        return dataclasses.replace(
            self,
            measurements=(*self.measurements, *more.measurements),
            noise_std=(*self.noise_std, *noise_std),
            weights=weights,
            slopes=slopes,
        )

    def moving(self, speed: float) -> Training:
        """The samples in which a joint moves faster than a speed [rad/s, m/s]."""
        fast = [(m.qd.abs().amax(-1) > speed).nonzero()[:, 0] for m in self.measurements]
        return self.of_rows(fast)


def _spread(m: Measurement, count: int) -> Tensor:
    """Rows of distinct states that are far from each other, at most `count`."""
    x = standardized(torch.cat([m.q, m.qd, m.tau], dim=-1))
    return farthest_points(x, min(count, len(x.unique(dim=0))))


FAR = 6.0
"""Robust standard deviations of A q̈ − b beyond which a sample is not in persistent contact."""


def without_impacts(training: Training, system: ConstrainedSystem) -> tuple[Training, int]:
    """The samples without impacts, and how many were left out.

    Args:
        training: measured accelerations among others.
        system: robot and contacts.
    """
    if not system.m:
        return training, 0
    kept = []
    for m, std in zip(training.measurements, training.noise_std, strict=True):
        every = torch.ones(len(m.q), dtype=torch.bool, device=m.q.device)
        good = _persists(system, m, std) if m.quantity == "qdd" else every
        kept.append(good.nonzero()[:, 0])
    dropped = sum(len(m.q) - len(rows) for m, rows in zip(training.measurements, kept, strict=True))
    return (training.of_rows(kept), dropped) if dropped else (training, 0)


def _persists(system: ConstrainedSystem, m: Measurement, std: Tensor) -> Tensor:
    """Whether |A q̈ − b| of each sample is within the usual, `(n,)` bool; free motion always is."""
    eom = system.equations(m.q, m.qd, m.active)
    violation = (eom.A @ m.values[..., None])[..., 0] - eom.b
    noise = (eom.A.square() @ std.expand_as(m.values)[..., None].square())[..., 0].sqrt()
    closed = noise > 0.0
    ratio = torch.where(closed, violation.abs() / torch.where(closed, noise, 1.0), 0.0)
    good = torch.ones(len(m.q), dtype=torch.bool, device=m.q.device)
    for row in range(ratio.shape[-1]):
        in_contact = closed[:, row]
        if bool(in_contact.any()):
            scale = max(1.0, MAD_TO_STD * float(ratio[in_contact, row].median()))
            good &= ratio[:, row] <= FAR * scale
    return good
