"""The mechanics of single states are those of the functions for batches, compiled or not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from forcegp import Baumgarte, ConstrainedSystem, Plane, PointConnection, Sphere, SurfaceContact, load_robot
from forcegp.constraints.unilateral import contact_forces, land, sliding_friction
from forcegp.control.plan import make_plan
from forcegp.control.task_space import control_torque
from forcegp.kinematics import point_motion
from forcegp.simulate import SimulationConfig
from forcegp.simulate.mechanics import Mechanics

SOLVED = 1e-10
"""Linear solves with the mass matrix, of forces up to hundreds, in another order of operations."""
ROBOT = load_robot(
    "kuka_iiwa", base_position=(0.1, 0.0, 0.05), base_rpy=(0.0, 0.0, 0.3), gravity=(0.3, 0.0, -9.8)
)
FRAME, POINT = "lbr_iiwa_link_7", (0.0, 0.0, 0.1)
TABLE = SurfaceContact("table", FRAME, POINT, Plane((0.1, 0.0, 1.0), 0.055))
BALL = SurfaceContact("ball", "lbr_iiwa_link_5", (0.0, 0.1, 0.0), Sphere((0.5, 0.0, -0.5), 0.4))
HOOK = PointConnection("hook", FRAME, POINT, "lbr_iiwa_link_0", (0.4, 0.1, 0.2))
SYSTEMS = {"free": (), "table": (TABLE,), "both": (TABLE, BALL), "hook": (HOOK, BALL)}


def _draw(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=7)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("name", SYSTEMS)
def test_equations_of_one_state_are_those_of_a_batch(
    name: str, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not compiled:
        monkeypatch.setenv("CXX", "no-such-compiler")
    system = ConstrainedSystem(ROBOT, SYSTEMS[name], Baumgarte())
    config = SimulationConfig(duration=0.1, frame=FRAME, point=POINT)
    free = ConstrainedSystem(ROBOT)
    plan = make_plan(free, config, torch.Generator().manual_seed(0))
    mechanics = Mechanics(system, plan)
    assert mechanics.compiled == compiled
    q, qd, force = _draw(1), _draw(2), 10.0 * _draw(3)
    active = np.array([True, False][: len(system.contacts)], dtype=bool)
    state = torch.from_numpy(q), torch.from_numpy(qd)
    eom = system.equations(*state, active=torch.from_numpy(active))
    one = mechanics.equations(q, qd, active)
    for field in ("M", "A", "b", "c", "cd", "Q_C", "Q_D", "Q_K", "L"):
        np.testing.assert_allclose(getattr(one, field), getattr(eom, field).numpy(), rtol=0.0, atol=SOLVED)
    expected = eom.multiplier(torch.from_numpy(force)).numpy()
    np.testing.assert_allclose(one.multiplier(force), expected, rtol=SOLVED, atol=1e-8)
    tool = point_motion(ROBOT, eom.poses, eom.motion, state[1], FRAME, POINT)
    for mine, theirs in zip(one.tool, tool, strict=True):
        np.testing.assert_allclose(mine, theirs.numpy(), rtol=0.0, atol=SOLVED)
    friction = sliding_friction(system, eom, torch.from_numpy(active), 2.0).numpy()
    np.testing.assert_allclose(sliding_friction(mechanics, one, active, 2.0), friction, rtol=0.0, atol=SOLVED)


def test_contact_mechanics_and_control_agree_in_both_kinds_of_arrays() -> None:
    system = ConstrainedSystem(ROBOT, (TABLE,), Baumgarte())
    config = SimulationConfig(duration=0.1)
    plan = make_plan(system, config, torch.Generator().manual_seed(0))
    mechanics = Mechanics(system, plan)
    q = plan.start + 1e-3 * torch.from_numpy(_draw(4))
    qd = torch.from_numpy(_draw(5))
    eom = system.equations(q, qd)
    target = plan.targets._replace(**{k: v[3] for k, v in plan.targets._asdict().items()})
    one = mechanics.equations(q.numpy(), qd.numpy())
    tool = point_motion(ROBOT, eom.poses, eom.motion, qd, plan.frame, plan.point)
    ours = control_torque(tool, eom, q, qd, target, plan.press(eom), config.gains)
    arrays = type(target)(*(x.numpy() for x in target))
    theirs = control_torque(one.tool, one, q.numpy(), qd.numpy(), arrays, plan.press(one), config.gains)
    np.testing.assert_allclose(theirs, ours.numpy(), rtol=SOLVED, atol=SOLVED)
    for closed in (True, False):
        flags = torch.tensor([closed])
        found = contact_forces(system, q, qd, land(system, q, qd, flags), ours, 1.0)
        landing = land(mechanics, q.numpy(), qd.numpy(), flags.numpy())
        same = contact_forces(mechanics, q.numpy(), qd.numpy(), landing, theirs, 1.0)
        for a, b in zip(found, same, strict=True):
            np.testing.assert_allclose(b, a.numpy(), rtol=1e-9, atol=1e-8)
