"""Angles are judged by where they place the tip in contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from forcegp.checks import Log, log_of
from forcegp.checks.contact import check_contacts
from forcegp.checks.placement import check_placement, leaves_surface
from forcegp.constraints import ConstrainedSystem, Plane
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


@pytest.fixture(scope="module")
def unlabelled() -> tuple[ConstrainedSystem, Log]:
    """Motion in contact of which labels by distance say nothing, as when the surface lies elsewhere."""
    scene = load_scene("kuka_plane")
    log = log_of(simulate(scene.system(), replace(scene.simulation, duration=4.0)).data)
    return scene.system(), log.replace(contact={"table": np.zeros(len(log), bool)})


@pytest.mark.parametrize(("height", "severity"), [(5e-3, "error"), (-5e-3, "warning")])
def test_a_tip_that_slides_beside_a_surface_that_it_never_touches(
    unlabelled: tuple[ConstrainedSystem, Log], height: float, severity: str
) -> None:
    system, log = unlabelled
    table = replace(system.contacts[0], surface=Plane(offset=0.055 + height))  # type: ignore[type-var]
    findings, _ = check_contacts(ConstrainedSystem(system.robot, [table]), log)
    (found,) = (finding for finding in findings if finding.kind == "contact-far")
    assert found.severity == severity and "--fit-surface" in found.message
    assert f"slides {-1e3 * height - 0.006:.3g} ± " in found.message
    assert float(found.evidence["offset_m"]) == pytest.approx(-height, abs=1e-4)


def test_exchanged_joints_of_a_log_whose_labels_were_lost_with_the_tip(
    unlabelled: tuple[ConstrainedSystem, Log],
) -> None:
    system, log = unlabelled
    order = [0, 2, 1, 3, 4, 5, 6]
    swapped = log.replace(**{name: getattr(log, name)[:, order] for name in ("q", "qd", "qdd", "tau")})
    (found,), corrected = check_placement(system, swapped)
    assert found.kind == "joint-order" and (corrected.q == log.q).all()
    assert found.severity == "error" and found.joints == ("lbr_iiwa_joint_2", "lbr_iiwa_joint_3")
    assert "mm from the surface of 'table'" in found.message


@pytest.mark.parametrize(("names", "kind"), [(("q", "qd", "qdd"), "joint-sign"), (("q",), "encoder-offset")])
def test_angles_of_a_log_whose_labels_were_lost_with_the_tip(
    unlabelled: tuple[ConstrainedSystem, Log], names: tuple[str, ...], kind: str
) -> None:
    """The torque tells whether its sign is right; an offset of 11° moves the tip by centimetres."""
    system, log = unlabelled
    j = np.arange(7) == 3
    wrong = {"q": log.q + 0.2 * j}
    if kind == "joint-sign":
        wrong = {name: getattr(log, name) * np.where(j, -1.0, 1.0) for name in names}
    (found,), corrected = check_placement(system, log.replace(**wrong))
    assert found.kind == kind and found.joints == ("lbr_iiwa_joint_4",)
    assert "never closed" in found.message and corrected.contact["table"].mean() > 0.5
    np.testing.assert_allclose(corrected.q, log.q, atol=2e-3)
    assert (corrected.tau == log.tau).all()


def test_free_motion_is_not_taken_for_a_displaced_tip(unlabelled: tuple[ConstrainedSystem, Log]) -> None:
    system, log = unlabelled
    t = log.t[:, None]
    q = log.q[:1] + 0.3 * np.sin(t * np.linspace(1.0, 2.0, 7)) - 0.3 * (np.arange(7) == 1)
    free = log.replace(q=q, qd=np.gradient(q, log.dt, axis=0), qdd=0.0 * q)
    assert check_placement(system, free)[0] == []
