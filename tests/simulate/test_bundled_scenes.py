"""Every bundled scene runs as it stands: the robot follows its motion within its limits, in contact."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch

from forcegp.scene import BUNDLED, load_scene
from forcegp.simulate import SimulationResult, simulate

SECONDS = 2.4
"""Two lines of each motion."""
TRACKING = 0.02
"""Undeclared friction of joints and contact against the stiffness of the controller [m]."""
RIGID, SOFT = 3e-4, 4e-4
"""What the tip leaves a surface: drift of the integration; what MuJoCo's contact gives way [m]."""
ACCELERATIONS = {"rigid": 1e-6, "solver": 1e-4}
"""Largest difference of the engine's accelerations to ours under its forces [rad/s²]."""


@cache
def run(name: str) -> SimulationResult:
    scene = load_scene(name)
    if scene.simulation.contact == "solver":
        pytest.importorskip("mujoco")
    return simulate(scene.system(), replace(scene.simulation, duration=SECONDS, lift_probability=0.0))


@pytest.mark.parametrize("name", BUNDLED)
def test_the_motion_is_followed_within_the_limits_of_the_robot(name: str) -> None:
    result, world = run(name), load_scene(name).simulation.contact
    assert float((result.position - result.reference.position).norm(dim=-1).max()) < TRACKING
    assert float(result.velocity.norm(dim=-1).max()) > 0.05
    assert result.saturated == 0 and result.beyond_limits == 0
    assert result.acceleration_mismatch < ACCELERATIONS[world]


@pytest.mark.parametrize("name", [name for name in BUNDLED if not name.endswith("_free")])
def test_the_tip_stays_on_the_surface_and_presses_on_it(name: str) -> None:
    result, config = run(name), load_scene(name).simulation
    closed = torch.stack(list(result.data.contact.values()), -1)
    assert float(closed.double().mean()) > 0.9
    assert float(result.c[closed].abs().max()) < (SOFT if config.contact == "solver" else RIGID)
    low, high = config.pressing_force
    for force in result.data.contact_extras["multiplier"].values():
        assert low / 2 < float(force.median()) < 2 * high


def test_both_feet_press_with_the_force_of_the_motion() -> None:
    config = load_scene("kuka_two_points").simulation
    front, back = run("kuka_two_points").data.contact_extras["multiplier"].values()
    for force in (front, back):
        # The controller does not know the friction at the feet, whose moment loads one more than the other.
        assert float(force.min()) > config.pressing_force[0] - 2.0
        assert float(force.max()) < config.pressing_force[1] + 2.0
