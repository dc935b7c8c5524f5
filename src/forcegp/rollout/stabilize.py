"""What keeps a rollout on the surface: nothing, Baumgarte's terms, or projection after each step."""

from __future__ import annotations

import dataclasses

import torch

from forcegp.constraints import Baumgarte, ConstrainedSystem
from forcegp.constraints.projection import project_state
from forcegp.errors import UnknownNameError
from forcegp.rollout.problem import State

STABILIZATIONS = ("none", "baumgarte", "projection")


def stabilized_system(
    system: ConstrainedSystem, stabilization: str | Baumgarte
) -> tuple[ConstrainedSystem, bool]:
    """The system with the stabilization of its right-hand side, and whether steps are projected.

    Args:
        system: robot and contacts.
        stabilization: `"none"`; `"baumgarte"`, the system's own terms or else the default ones; other
            Baumgarte terms; or `"projection"` of q and q̇ onto the manifold after each step, without any.

    Raises:
        UnknownNameError: no such stabilization.
    """
    if isinstance(stabilization, Baumgarte):
        return dataclasses.replace(system, baumgarte=stabilization), False
    if stabilization not in STABILIZATIONS:
        raise UnknownNameError("stabilization", stabilization, STABILIZATIONS)
    if stabilization == "baumgarte":
        return dataclasses.replace(system, baumgarte=system.baumgarte or Baumgarte()), False
    return dataclasses.replace(system, baumgarte=None), stabilization == "projection"


def projected(system: ConstrainedSystem, state: State, alive: torch.Tensor) -> State:
    """The state with q and q̇ on the manifold, in the rows `(n,)` that are still alive."""
    q, qd = project_state(system, state.q, state.qd, state.active & alive[:, None])
    return State(state.t, q, qd, state.active)
