"""Projection of a state onto the constraint manifold, c(q) = 0 and A q̇ = 0, in the metric of M.

Newton's iteration q ← q − M⁻¹Aᵀ(A M⁻¹ Aᵀ)⁺ c moves along the directions in which constraint forces push;
q̇ ← q̇ − L A q̇ is the velocity on the manifold that is nearest in kinetic energy, and also the velocity
after an inelastic impact without friction, M (q̇⁺ − q̇⁻) = AᵀΛ with A q̇⁺ = 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from forcegp.constraints.gauss import Equations
from forcegp.constraints.system import ConstrainedSystem
from forcegp.errors import NumericalError
from forcegp.types import ActiveContacts, JointVector

POSITION_TOLERANCE = 1e-12
"""Largest constraint error that counts as none [m]; rounding of the kinematics of an arm leaves 1e-15."""
ROUNDING = 100.0
"""Constraint error, in units of the precision's ε, that rounding may leave; it counts in float32 only."""
MAX_ITERATIONS = 30
"""Newton doubles the digits in each iteration; a state off by a centimetre needs four."""
MAX_STEP = 0.2
"""Largest move of a joint in one iteration [rad, m]; light wrist joints are asked for more than they give."""


def project_velocity(eom: Equations, qd: JointVector) -> JointVector:
    """T q̇ = q̇ − L A q̇, the velocity after an inelastic impact on the active constraints, `(*batch, nq)`."""
    return qd - (eom.L @ (eom.A @ qd[..., None]))[..., 0]


def project_state(
    system: ConstrainedSystem, q: JointVector, qd: JointVector, active: ActiveContacts | None = None
) -> tuple[JointVector, JointVector]:
    """The state on the constraint manifold next to (q, q̇).

    Args:
        system: robot and contacts.
        q, qd: `(*batch, nq)` joint positions and velocities.
        active: `(*batch, n_contacts)` bool, which contacts are closed; default all.

    Returns:
        q with |c(q)| ≤ 1e−12 m (1e−5 m in float32) and q̇ with A q̇ = 0, for the active contacts.

    Raises:
        NumericalError: the iteration does not converge, as where the surface is out of reach.
    """
    rows = system.active_rows(active, q.shape[:-1])
    tolerance = max(POSITION_TOLERANCE, ROUNDING * torch.finfo(q.dtype).eps)
    error = torch.zeros((), dtype=q.dtype)
    for _ in range(MAX_ITERATIONS):
        eom = system.equations(q, qd, active)
        c = torch.where(rows, eom.c, 0.0)
        error = _largest(c)
        if float(error) <= tolerance:
            return q, project_velocity(eom, qd)
        move = (eom.L @ c[..., None])[..., 0]
        q = q - move * (MAX_STEP / move.detach().abs().amax(-1, keepdim=True).clamp(min=MAX_STEP))
    raise NumericalError(
        "no state on the constraint manifold is found",
        expected=f"a constraint error of at most {tolerance:g} m after {MAX_ITERATIONS} iterations",
        got=f"{float(error):.3g} m",
        hint="start nearer to the surface, and check that the arm can reach it",
    )


def _largest(c: Tensor) -> Tensor:
    return c.detach().abs().max() if c.numel() else c.new_zeros(())
