"""Motor side and joint side, currents and torques, signs and offsets, as one factor per joint.

A reading r is y = s k (r − o): o what the sensor shows at zero, in the unit of the column; s = ±1; and k the
unit, times the torque constant K_t for a current. Through a gear of ratio N, a motor turns N times as fast as
its joint and a joint bears N times the motor's torque: q = q_m / N, τ = N τ_m.
"""

from __future__ import annotations

from collections.abc import Sequence

from forcegp.logs import units
from forcegp.logs.mapping import Mapping

QUANTITIES = ("position", "velocity", "acceleration", "torque")
"""Joint vectors of a mapping."""


def factors(mapping: Mapping, name: str, joints: Sequence[str]) -> tuple[list[float], list[float]]:
    """Factor s k and offset o of a quantity for each joint.

    Args:
        mapping: says unit, sign, side, gear ratio, torque constant and offset.
        name: `position`, `velocity`, `acceleration` or `torque`.
        joints: the robot's joints.

    Returns:
        Factors to SI on the joint side, and offsets in the unit of the column.

    Raises:
        MappingError: a joint has no number.
    """
    section = mapping.quantity(name)
    assert section is not None
    unit = units.QUANTITY[name][section.unit]
    gear = [1.0] * len(joints)
    if section.side == "motor":
        ratios = mapping.per_joint(name, "gear_ratio", joints)
        gear = [ratio if name == "torque" else 1.0 / ratio for ratio in ratios]
    constant = [1.0] * len(joints)
    if name == "torque" and mapping.sections.torque.torque_constant is not None:
        constant = mapping.per_joint(name, "torque_constant", joints)
    signs = mapping.per_joint(name, "sign", joints)
    scale = [s * unit * g * k for s, g, k in zip(signs, gear, constant, strict=True)]
    return scale, mapping.per_joint(name, "offset", joints)
