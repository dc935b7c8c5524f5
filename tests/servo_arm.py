"""An arm with three drives in MuJoCo, for logs of commands and of currents."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

ARM = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody>
<body pos="0 0 .5"><joint name="a" axis="0 1 0"/><inertial pos="0 0 .2" mass="1.5" diaginertia=".02 .02 .01"/>
<body pos="0 0 .4"><joint name="b" axis="0 1 0"/>
<inertial pos="0 0 .15" mass=".8" diaginertia=".01 .01 .002"/>
<body pos="0 0 .2"><joint name="c" axis="0 0 1"/>
<inertial pos="0 0 .05" mass=".2" diaginertia="1e-4 1e-4 1e-4"/>
</body></body></body></worldbody></mujoco>"""
STIFFNESS, DAMPING = np.array([150.0, 60.0, 20.0]), np.array([9.0, 3.0, 0.8])
ARMATURE, FRICTION, VISCOUS = (
    np.array([0.08, 0.04, 0.02]),
    np.array([1.2, 0.6, 0.2]),
    np.array([0.8, 0.4, 0.1]),
)


def engine(armature: Any = 0.0, friction: Any = 0.0, viscous: Any = 0.0) -> Any:
    """MuJoCo's model of the arm."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.dof_armature[:], model.dof_frictionloss[:], model.dof_damping[:] = armature, friction, viscous
    return model


def commanded(seed: int, t: float) -> np.ndarray:
    """Commands at a time, which begin at zero."""
    random = np.random.default_rng(seed)
    size, w, phase = (
        random.uniform(0.1, 0.3, (5, 3)),
        random.uniform(0.6, 6.0, (5, 3)),
        random.uniform(0, 6, (5, 3)),
    )
    return (size * (np.sin(w * t + phase) - np.sin(phase))).sum(0)
