"""Joint forces from a force sensor and the accelerations together, as one measurement."""

from __future__ import annotations

import torch

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.forces.measurements import Observation
from forcegp.forces.quantities import states_at
from forcegp.models.sensed import SENSOR, has_sensor

LEAST_FORCE = 1e-3
"""Minimum noise of a sensed joint force, relative to its magnitude."""


@torch.no_grad()
def with_sensed_forces(data: Dataset, system: ConstrainedSystem, force_std: float) -> list[Observation]:
    """Return joint forces computed from a force sensor and the accelerations, Q̄ = M q̈ − J_Eᵀ F.

    Both contain the same torque errors, which two separate measurements would count twice. Fit these forces
    without the contact, `StructuredGP(ConstrainedSystem(system.robot), …)`, since its force is measured.

    Args:
        data: a log with `F_sensor`; no force acts while the contact is open.
        system: robot with a single surface contact.
        force_std: standard deviation of each force component [N].

    Raises:
        ModelError: the log has no sensor force.
    """
    (contact,) = system.contacts
    if not has_sensor(data, system):
        raise ModelError(
            f"the log has no sensor force at contact {contact.name!r}",
            expected=f"columns {SENSOR}.{contact.name}.x, .y, .z",
        )
    closed = data.active([contact.name])
    at, _ = states_at(system, data.q, data.qd, data.tau, closed)
    J, M = at.eom.contact_points[contact.name].jacobian, at.eom.M
    F = data.contact_extras[SENSOR][contact.name] * closed
    Q = (M @ data.qdd[..., None])[..., 0] - (J.mT @ F[..., None])[..., 0]
    qdd_std = torch.full_like(Q, data.header.noise_std or 0.0)
    qdd_std = data.extras.get("qdd_std", qdd_std)
    # Σ = σ² J_EᵀJ_E + M Σ_q̈ M
    variance = force_std**2 * J.square().sum(-2) * closed + (M.square() @ qdd_std[..., None] ** 2)[..., 0]
    std = (variance + (LEAST_FORCE * Q.square().mean(0).sqrt()) ** 2).sqrt()
    return [Observation(data.replace(extras={**data.extras, "Q": Q}), "joint_force", std)]
