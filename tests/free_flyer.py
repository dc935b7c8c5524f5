"""A free base as engines describe it, and a hopping robot for MuJoCo."""

from __future__ import annotations

import torch
from torch import Tensor

HOPPER = """<mujoco><default><joint damping="0.3" armature="0.01"/></default><worldbody>
<geom type="plane" size="1 1 .1"/>
<body name="trunk" pos="0 0 1" euler="20 0 30"><freejoint name="root"/>
<inertial pos=".02 0 .01" mass="3" fullinertia=".05 .06 .04 .002 .001 .003"/>
<body name="thigh" pos=".1 0 0"><joint name="hip" axis="0 1 0"/>
<inertial pos="0 0 -.1" mass=".5" diaginertia=".002 .002 .0005"/>
<body name="shank" pos="0 0 -.2"><joint name="knee" axis="0 1 0"/>
<inertial pos="0 0 -.1" mass=".3" diaginertia=".001 .001 .0002"/><site name="foot" pos="0 0 -.2"/>
</body></body></body></worldbody></mujoco>"""


def turn(q: Tensor) -> Tensor:
    """R_z(yaw) R_y(pitch) R_x(roll)."""
    rotations = []
    for angle, (i, j) in zip(q[3:6], ((0, 1), (2, 0), (1, 2)), strict=True):
        generator = torch.zeros(3, 3, dtype=q.dtype)
        generator[i, j], generator[j, i] = -1.0, 1.0
        unit = torch.eye(3, dtype=q.dtype)
        rotations.append(unit + angle.sin() * generator + (1.0 - angle.cos()) * generator @ generator)
    return rotations[0] @ rotations[1] @ rotations[2]


def body_velocity(q: Tensor, qd: Tensor) -> Tensor:
    """Velocities of a free-flyer in its own axes, linear before angular, and of the joints."""
    R, rate = torch.func.jvp(turn, (q,), (qd,))
    spin = R.mT @ rate
    return torch.cat([R.mT @ qd[:3], torch.stack([spin[2, 1], spin[0, 2], spin[1, 0]]), qd[6:]])
