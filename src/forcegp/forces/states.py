"""A batch of robot states with the equations of motion there: what priors, means and quantities read."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, Equations
from forcegp.errors import ShapeError


@dataclass(frozen=True)
class States:
    """A batch of robot states with what the equations of motion say there.

    Attributes:
        q, qd, tau: `(n, nq)`.
        active: `(n, n_contacts)` bool.
        eom: the equations of motion at these states.
    """

    q: Tensor
    qd: Tensor
    tau: Tensor
    active: Tensor
    eom: Equations


def states(system: ConstrainedSystem, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor) -> States:
    """Evaluate the equations of motion at a batch of states."""
    return States(q, qd, tau, active, system.equations(q, qd, active))


def states_at(
    system: ConstrainedSystem, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor | None
) -> tuple[torch.Size, States]:
    """The common batch of states `(*batch, nq)`, and the states in one row of it; all contacts by default.

    Raises:
        ShapeError: an argument does not fit the system, or is not finite.
    """
    given = {"q": q, "qd": qd, "tau": tau}
    system.robot.check_state(**given)
    for name, x in given.items():
        if not bool(torch.isfinite(x).all()):
            raise ShapeError(f"{name} holds values that are not finite", expected="finite numbers")
    try:
        batch = torch.broadcast_shapes(*(x.shape[:-1] for x in given.values()))
    except RuntimeError as cause:
        got = {name: tuple(x.shape) for name, x in given.items()}
        raise ShapeError(
            "q, qd and tau are not one batch", expected="shapes that broadcast", got=got
        ) from cause
    contacts = len(system.contacts)
    if active is None:
        active = torch.ones(contacts, dtype=torch.bool, device=q.device)
    system.active_rows(active, batch)
    rows = batch.numel()
    q, qd, tau = (x.expand(*batch, x.shape[-1]).reshape(rows, x.shape[-1]) for x in given.values())
    return batch, states(system, q, qd, tau, active.expand(*batch, contacts).reshape(rows, contacts))
