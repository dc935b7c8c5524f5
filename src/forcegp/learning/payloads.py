"""Payloads that differ between the recordings of a log, identified together with links and drives.

In free motion, r = C δ + Y_k p_r + Φ w + ε (`inverse_dynamics.py`), with the mass and first moment p_r [kg,
kg m] that the last link k carries in recording r and not in the first one. Only differences are determined: a
payload of all recordings is part of the link. Without the columns of p_r, identified links would contain the
mean payload. Like links, payloads are accepted if they predict torques on held-out blocks of the log better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.measurements import Training
from forcegp.forces.priors.base import ForceMean
from forcegp.forces.priors.constants import PerRecording, shares
from forcegp.forces.priors.inertial import PER_PAYLOAD, InertialPrior, PayloadPrior
from forcegp.forces.quantities import States
from forcegp.forces.term import JointTerm
from forcegp.learning.inertia import (
    GAIN,
    drive_scale,
    inertia_at,
    links_at,
    over_widths,
    with_delay,
    with_ripple,
)
from forcegp.learning.inverse_dynamics import free_rows, held_out, is_less, products

SAMPLES = 2000
"""Maximum number of samples. With the 4000 from which links are identified, the step takes 10 to 15 % of the
time of a fit whose recordings have the same payload."""


@dataclass(frozen=True)
class Payloads:
    """Payloads of the recordings of a log.

    Attributes:
        prior: prior on the payload of each recording but the first.
        weights: their weights in units of the prior `(4, recordings)`.
    """

    prior: PerRecording
    weights: Tensor

    def carried(self, mean: ForceMean) -> ForceMean:
        """Return a prior mean of Q plus the force of the payloads."""
        unknown = self.weights.new_zeros(len(self.weights), 1)
        w = torch.cat([self.weights, unknown], dim=-1).flatten()

        def total(system: ConstrainedSystem, at: States) -> Tensor:
            return mean(system, at) + self.prior.operator(system, at) @ w

        return total


@torch.no_grad()
def payloads_of(
    system: ConstrainedSystem,
    laws: Sequence[JointTerm],
    mean: ForceMean,
    training: Training,
    recordings: Sequence[str],
) -> Payloads | None:
    """Return the payloads of recordings relative to the first one, or `None` if the log does not show any.

    They must have positive evidence, and reduce the torque errors on held-out blocks significantly.

    Args:
        system: robot and contacts of the robot file.
        laws: friction of joints, and offsets of recordings.
        mean: prior mean of Q, including the motor torque.
        training: samples in motion.
        recordings: names of two or more recordings.
    """
    robot, payload = system.robot, PayloadPrior(measured=True, rigid=True)
    rows = with_ripple(robot, free_rows(system, laws, mean, training, SAMPLES).with_memory())
    M, size = inertia_at(robot, rows.q), drive_scale(robot, rows.q)
    Y, first = links_at(robot, rows), PER_PAYLOAD * payload.link(robot)
    load = Y[..., first : first + PER_PAYLOAD] * payload.units(Y)
    each = shares(recordings, rows.recording[:, None])[1:-1]
    columns = [size * torch.diag_embed(rows.qdd), Y * InertialPrior().scale(robot)]
    columns = torch.cat([*columns, *(torch.as_tensor(x)[..., None] * load for x in each)], dim=-1)
    regression, n, last = next(over_widths(rows, columns, M)), robot.nq, columns.shape[-1]
    delay, first = regression.clear_delay(), last - PER_PAYLOAD * len(each)
    without, everything = (torch.cat([torch.arange(stop), delay]) for stop in (first, last))
    h, precision, _ = regression.normal()
    V = torch.linalg.inv(precision[everything][:, everything])
    w, V = (V @ h[everything])[first:last], V[first:last, first:last]
    # Log evidence of the payloads over their absence
    worth = 0.5 * float(w @ torch.linalg.solve(V, w)) + 0.5 * float(torch.logdet(V))
    if worth <= 0.0:
        return None
    judged = products(rows, with_delay(rows, columns))
    before, after = (
        held_out(regression.by_stretch, lambda rest, kept=kept: regression.estimate(rest, kept, n), judged)
        for kept in (without, everything)
    )
    unit = before.mean(0).maximum(regression.noise**2)
    if not is_less(((after - before) / unit).mean(-1)):
        return None
    w = regression.estimate(regression.by_stretch.total(), everything, n)[first:last].view(len(each), -1)
    variance = regression.read(last, everything)[1][first:last].view(len(each), -1)
    spread = (variance + (GAIN * w).square()).sqrt() * payload.units(w)
    prior = PerRecording(payload, tuple(recordings[1:]), recordings[0], tuple(map(tuple, spread.tolist())))
    return Payloads(prior, w.mT)
