"""Samples in contact whose measured acceleration does not keep to the surface: impacts, wrong flags.

In contact A q̈ = b. Where a measurement departs from it by far more than the usual noise, the multiplier is
not that of a contact that persists, and the other directions of q̈ are wrong with it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.measurements import Measurement, Training
from forcegp.robust import MAD_TO_STD

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
    left_out = sum(len(m.q) - len(rows) for m, rows in zip(training.measurements, kept, strict=True))
    return (training.of_rows(kept), left_out) if left_out else (training, 0)


def _persists(system: ConstrainedSystem, m: Measurement, std: Tensor) -> Tensor:
    """Whether |A q̈ − b| of each sample is within the usual, `(n,)` bool; free motion always is."""
    eom = system.equations(m.q, m.qd, m.active)
    apart = (eom.A @ m.values[..., None])[..., 0] - eom.b
    noise = (eom.A.square() @ std.expand_as(m.values)[..., None].square())[..., 0].sqrt()
    closed = noise > 0.0
    ratio = torch.where(closed, apart.abs() / torch.where(closed, noise, 1.0), 0.0)
    good = torch.ones(len(m.q), dtype=torch.bool, device=m.q.device)
    for row in range(ratio.shape[-1]):
        own = closed[:, row]
        if bool(own.any()):
            scale = max(1.0, MAD_TO_STD * float(ratio[own, row].median()))
            good &= ratio[:, row] <= FAR * scale
    return good
