"""Angles are judged by where they place the tip in contact."""

from __future__ import annotations

from dataclasses import replace

import pytest

from forcegp.checks import Log, log_of
from forcegp.checks.placement import leaves_surface
from forcegp.constraints import ConstrainedSystem
from forcegp.scene import load_scene
from forcegp.simulate import simulate


@pytest.fixture(scope="module")
def case() -> tuple[ConstrainedSystem, Log]:
    scene = load_scene("pendulum_wire")
    return scene.system(), log_of(simulate(scene.system(), replace(scene.simulation, duration=4.0)).data)


@pytest.mark.parametrize(("offset", "leaves"), [(0.0, False), (0.001, False), (0.2, True)])
def test_an_offset_that_takes_the_tip_off_its_surface(
    case: tuple[ConstrainedSystem, Log], offset: float, leaves: bool
) -> None:
    system, log = case
    assert leaves_surface(system, log, log.replace(q=log.q + offset)) == leaves


def test_a_tip_that_was_off_its_surface_before_cannot_leave_it(case: tuple[ConstrainedSystem, Log]) -> None:
    system, log = case
    off = log.replace(q=log.q + 0.2)
    assert not leaves_surface(system, off, log) and not leaves_surface(
        system, off, log.replace(q=log.q + 0.3)
    )


def test_torques_move_no_tip(case: tuple[ConstrainedSystem, Log]) -> None:
    system, log = case
    assert not leaves_surface(system, log, log.replace(tau=2.0 * log.tau))
