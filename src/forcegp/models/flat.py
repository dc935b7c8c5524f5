"""States of any batch shape as one list."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem


class FlatStates(NamedTuple):
    """States as a list, and the batch shape that they had.

    Attributes:
        q, qd, tau: `(n, nq)`.
        active: `(n, n_contacts)` bool.
        batch: shape whose product is n.
    """

    q: Tensor
    qd: Tensor
    tau: Tensor
    active: Tensor
    batch: torch.Size


def flat_states(
    system: ConstrainedSystem, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor | None
) -> FlatStates:
    """Broadcast states `(*batch, nq)` against each other and flatten them; all contacts closed by default.

    Raises:
        ShapeError: a state does not fit the robot.
    """
    system.robot.check_state(q=q, qd=qd, tau=tau)
    batch = torch.broadcast_shapes(q.shape[:-1], qd.shape[:-1], tau.shape[:-1])
    q, qd, tau = (x.expand(*batch, x.shape[-1]).reshape(-1, x.shape[-1]) for x in (q, qd, tau))
    n_contacts = len(system.contacts)
    if active is None:
        active = torch.ones(n_contacts, dtype=torch.bool, device=q.device)
    return FlatStates(q, qd, tau, active.expand(*batch, n_contacts).reshape(len(q), n_contacts), batch)
