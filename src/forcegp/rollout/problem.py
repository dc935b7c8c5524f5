"""The state of a rollout and the right-hand side of its differential equation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.forces.quantities import States
from forcegp.rollout.inputs import Inputs, Reached
from forcegp.rollout.law import Law


class State(NamedTuple):
    """Where n trajectories are; events within a step let their times differ.

    Attributes:
        t: `(n, 1)` [s].
        q, qd: `(n, nq)`.
        active: `(n, n_contacts)` bool, closed contacts.
    """

    t: Tensor
    q: Tensor
    qd: Tensor
    active: Tensor

    def where(self, rows: Tensor, other: State) -> State:
        """This state in some rows `(n,)`, another one elsewhere."""
        return State(*(torch.where(rows[:, None], a, b) for a, b in zip(self, other, strict=True)))


class Evaluation(NamedTuple):
    """The motion at a state.

    Attributes:
        tau, qdd: `(n, nq)` motor torque and acceleration.
        multiplier, c, cd: `(n, m)` λ, constraint error and its rate.
    """

    tau: Tensor
    qdd: Tensor
    multiplier: Tensor
    c: Tensor
    cd: Tensor


@dataclass(frozen=True)
class Problem:
    """q̈ = law(q, q̇, τ(t, q, q̇)) on a constrained system.

    Args:
        system: robot and contacts, with the stabilization of the rollout.
        law: what gives the acceleration.
        inputs: what gives the torque.
        unilateral: whether contacts with a surface can open and close.
    """

    system: ConstrainedSystem
    law: Law
    inputs: Inputs
    unilateral: bool

    def evaluate(self, state: State, end: Tensor) -> Evaluation:
        """The motion at a state, within a step that ends at `end` `(n, 1)`."""
        eom = self.system.equations(state.q, state.qd, state.active)
        tau = self.inputs.torque(state.t, end, Reached(self.system, eom, state.q, state.qd))
        at = States(state.q, state.qd, tau, state.active, eom)
        qdd, multiplier = self.law.motion(self.system, at)
        return Evaluation(tau, qdd, multiplier, eom.c, eom.cd)

    def by_contact(self, rows: Tensor) -> Tensor:
        """`(n, n_contacts)` bool from `(n, m)` bool: whether any row of each contact is set."""
        parts = rows.split([contact.rows for contact in self.system.contacts], dim=-1)
        return torch.stack([part.any(-1) for part in parts], dim=-1) if parts else rows

    @property
    def can_open(self) -> Tensor:
        """`(n_contacts,)` bool: contacts with a surface; other constraints hold both ways."""
        flags = [isinstance(contact, SurfaceContact) for contact in self.system.contacts]
        return torch.tensor(flags, dtype=torch.bool, device=self.system.robot.device)
