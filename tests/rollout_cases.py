"""Systems and motions that the rollout tests share."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from functools import cache

import torch
from torch import Tensor

import forcegp
from forcegp.constraints import Baumgarte, ConstrainedSystem, Plane, SurfaceContact, project_state
from forcegp.control.plan import make_plan
from forcegp.data import Dataset
from forcegp.forces.priors.joint import AnalyticalMean
from forcegp.rollout import ForceLaw
from forcegp.simulate import SimulationConfig, SimulationResult, make_engine, simulate
from forcegp.simulate.result import make_result
from forcegp.simulate.run import _follow as follow

SLIDER_MASS = 2.0
GRAVITY = 9.81
ANALYTICAL = ForceLaw(AnalyticalMean())
"""The equations of motion of the robot file."""

_SLIDER = """
<robot name="slider">
  <link name="world"/>
  <link name="carriage"><inertial><mass value="1.0"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="block"><inertial><mass value="2.0"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="along" type="prismatic"><parent link="world"/><child link="carriage"/><axis xyz="1 0 0"/>
    <limit lower="-100" upper="100" effort="1e6" velocity="1e3"/></joint>
  <joint name="up" type="prismatic"><parent link="carriage"/><child link="block"/><axis xyz="0 0 1"/>
    <limit lower="-100" upper="100" effort="1e6" velocity="1e3"/></joint>
</robot>
"""


def slider(folder, baumgarte: Baumgarte | None = None) -> ConstrainedSystem:
    """A block of `SLIDER_MASS` on two straight guides above the plane z = 0: everything in closed form."""
    path = folder / "slider.urdf"
    path.write_text(_SLIDER)
    contact = SurfaceContact("floor", "block", (0.0, 0.0, 0.0), Plane())
    return ConstrainedSystem(forcegp.load_robot(path), [contact], baumgarte=baumgarte)


def arm(baumgarte: Baumgarte | None = None) -> ConstrainedSystem:
    """The bundled arm with its tip on the table."""
    robot = forcegp.load_robot("kuka_iiwa", base_position=(0.0, 0.0, 0.05))
    table = SurfaceContact(
        "table", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), Plane(normal=(0.0, 0.0, 1.0), offset=0.055)
    )
    return ConstrainedSystem(robot, [table], baumgarte=baumgarte)


@cache
def simulated(viscous_friction: float = 0.0, seconds: float = 1.2, seed: int = 3) -> SimulationResult:
    """A motion of the arm over the table, with Baumgarte's terms as the simulator has them."""
    config = SimulationConfig(duration=seconds, seed=seed, viscous_friction=viscous_friction, noise_std=0.0)
    return simulate(arm(Baumgarte()), config)


def on_manifold(system: ConstrainedSystem, seed: int, speed: float = 0.5) -> tuple[Tensor, Tensor]:
    """A state of the arm near its working posture with c = 0 and A q̇ = 0."""
    generator = torch.Generator().manual_seed(seed)
    q = simulated().data.q[10 * seed] + 0.02 * torch.randn(7, dtype=torch.float64, generator=generator)
    return project_state(system, q, speed * torch.randn(7, dtype=torch.float64, generator=generator))


@cache
def pulled_off(viscous_friction: float = 0.0) -> Dataset:
    """The arm pressed on the table, ever less and then pulled: contact is lost gradually."""
    system, config = (
        arm(Baumgarte()),
        SimulationConfig(duration=0.7, seed=3, viscous_friction=viscous_friction, noise_std=0.0),
    )
    generator = torch.Generator().manual_seed(config.seed)
    plan = make_plan(system, config, generator)
    ramp = torch.linspace(40.0, -30.0, config.steps, dtype=torch.float64)
    plan = dataclasses.replace(plan, targets=plan.targets._replace(push=ramp))
    with torch.no_grad(), closing(make_engine(system.robot, config.dt)) as engine:
        log = follow(system, config, plan, engine, None)
        return make_result(system, config, plan, log, engine.name, generator).data
