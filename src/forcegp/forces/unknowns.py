"""Tangential forces of contacts that are not functions of the state, which are unknowns of single rows.

Friction of a contact that slides is a function of the state. The tangential force u of a contact at rest is
not: it balances the other forces. Friction also scatters while the contact slides. What the laws do not
explain is therefore drawn anew in each row, at the tip as at a joint:

    u ~ N(0, (σ² + s² k) (1 − n nᵀ)),  k = e^{−(v/v_s)²}

for the tangential speed v of the contact point. It acts on the joints through J_Eᵀ. A large s is the same as
projecting the direction out. Rest is found by speed. Errors of the velocities give a point at rest a speed,
whose size follows from the normal speed of closed contacts, which is zero in truth.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.forces.external_wrench import FORCE_STD
from forcegp.forces.posterior import RELATIVE
from forcegp.forces.priors.base import NOISE
from forcegp.forces.quantities import States
from forcegp.forces.term import NEAR_REST
from forcegp.robust import MAD_TO_STD

DETERMINED = 1e-6
"""Smallest part 1 − R_ii of a multiplier that the motion determines, up to rounding."""
AXES = 3
"""Components of a tangential force in world axes, of which the surface leaves two."""
LARGEST_COEFFICIENT = 1.0
"""Stated ratio of s to the typical normal force: friction at rest is at most μ λ, with μ ≤ 1 for most dry
materials. It holds if fewer than ten independent samples are at rest (`learning/scales.py`)."""
NORMAL_SPEED_STDS = 3.0
"""Ratio of v_s to the standard deviation of the normal speed of a closed contact. A real leg has an apparent
normal speed of .03 to .04 m/s. Its fore-aft errors are 1.55 times those of the equations of motion with 1,
1.11 with 2, 1.00 with 3, and .96 with 5. Simulated contacts have no normal speed."""


class TipKeys(NamedTuple):
    """Names of the logarithms of σ and s [N] and of v_s [m/s] of a contact."""

    slides: str
    rests: str
    speed: str


def tip_keys(contact: str) -> TipKeys:
    """Return the names of the parameters of the unknown tangential force at a contact."""
    slides, rests = (f"{NOISE}.{state}.{contact}.log_noise_std" for state in ("slide", "tip"))
    return TipKeys(slides, rests, f"{NOISE}.tip.{contact}.log_speed")


def free_tips(system: ConstrainedSystem) -> list[str]:
    """Return the surface contacts whose tangential force at rest is not a multiplier."""
    surfaces = (each for each in system.contacts if isinstance(each, SurfaceContact))
    return [each.name for each in surfaces if each.stick_speed is None]


def learned_tips(system: ConstrainedSystem, tensors: Mapping[str, Tensor]) -> list[str]:
    """Return the contacts with an unknown tangential force of learned or stated size."""
    return [name for name in free_tips(system) if tip_keys(name).rests in tensors]


def share_at_rest(tensors: Mapping[str, Tensor], at: States, contact: str) -> Tensor:
    """Return k `(n,)`, which is 1 while a contact with a stated stick speed sticks."""
    point, speed = at.eom.contact_points[contact], tensors.get(tip_keys(contact).speed)
    k = torch.exp(-point.sliding[1].square().sum(-1) / (NEAR_REST if speed is None else speed.exp()) ** 2)
    return k if point.sticks is None else k.masked_fill(point.sticks, 1.0)


def tip_variance(tensors: Mapping[str, Tensor], at: States, contact: str) -> Tensor:
    """Return σ² + s² k `(n,)` of a contact with an unknown tangential force [N²]."""
    keys = tip_keys(contact)
    slides, rests = ((2.0 * tensors[key]).exp() for key in (keys.slides, keys.rests))
    return slides + rests * share_at_rest(tensors, at, contact)


def unknown_tip(tensors: Mapping[str, Tensor], contact: str) -> tuple[float, float, float]:
    """Return σ², s² [N²] and v_s [m/s] of a contact with an unknown force.

    Unless the size is learned, σ = 0 and s is `FORCE_STD`.
    """
    keys = tip_keys(contact)
    speed = float(tensors[keys.speed].exp()) if keys.speed in tensors else NEAR_REST
    if keys.rests not in tensors:
        return 0.0, FORCE_STD**2, speed
    slides, rests = (float((2.0 * tensors[key]).exp()) for key in (keys.slides, keys.rests))
    return slides, rests, speed


def tip_operator(system: ConstrainedSystem, at: States, contact: str) -> Tensor:
    """Return J_Eᵀ (1 − n nᵀ) `(n, nq, 3)` of a contact, zero while it is open."""
    closed = at.active[:, system.contact_names.index(contact)]
    return at.eom.contact_points[contact].sliding[0].mT.masked_fill(~closed[:, None, None], 0.0)


def tip_factor(tensors: Mapping[str, Tensor], system: ConstrainedSystem, at: States) -> Tensor | None:
    """Return N `(n, nq, 3 c)` such that unknown tangential forces of contacts have the covariance N Nᵀ."""
    parts = []
    for name in learned_tips(system, tensors):
        std = tip_variance(tensors, at, name).sqrt()
        parts.append(std[:, None, None] * tip_operator(system, at, name))
    return torch.cat(parts, dim=-1) if parts else None


@torch.no_grad()
def stated_tips(system: ConstrainedSystem, states: Iterable[States]) -> dict[str, Tensor]:
    """Return initial values for each contact, from normal forces at states under the robot file and τ.

    Contacts that share a load have λ_i/√(1 − R_ii) with the projector R onto Aᵀμ = 0, so that the variance of
    their common tangential force is that of one contact. v_s is at least `NORMAL_SPEED_STDS` times the
    standard deviation of the speed along the normal.
    """
    tips, loads, normal = {}, list[tuple[Tensor, Tensor]](), dict[str, list[Tensor]]()
    for at in states:
        part = 1.0 - at.eom.hidden.diagonal(dim1=-2, dim2=-1)
        force = at.eom.multiplier(at.eom.Q_K + at.tau).clamp(min=0.0)
        loads.append(
            (at.active, torch.where(part > DETERMINED, force / part.clamp(min=DETERMINED).sqrt(), 0.0))
        )
        for name, closed in zip(system.contact_names, at.active.unbind(-1), strict=True):
            if (point := at.eom.contact_points.get(name)) is not None:
                speed = torch.linalg.vecdot(point.unit_normal, point.velocity)[closed]
                normal.setdefault(name, []).append(speed)
    for name in free_tips(system):
        index, row = system.contact_names.index(name), system.rows[name].start
        load = torch.cat([force[active[:, index], row] for active, force in loads])
        if len(load) and bool((load > 0.0).any()):
            s = LARGEST_COEFFICIENT * float(load.square().mean().sqrt())
            speed = NORMAL_SPEED_STDS * MAD_TO_STD * float(torch.cat(normal[name]).abs().median())
            stated = RELATIVE * s, s, max(NEAR_REST, speed)
            values = (system.robot.mass.new_tensor(math.log(x)) for x in stated)
            tips |= dict(zip(tip_keys(name), values, strict=True))
    return tips
