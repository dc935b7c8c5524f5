"""A legged robot in MuJoCo: its base has no motor and no friction, and its feet are read along a log."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

import forcegp
from forcegp.forces.noise import EXACT, TORQUE_NOISE
from forcegp.forces.posterior import MEMORY
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.quantities import states
from forcegp.models.structured_fit import StructuredFit
from forcegp.robot.free_base import BASE_JOINTS
from forcegp.storage.system import pack_system, unpack_system
from robots import example_data

pytest.importorskip("mujoco")
import legs


@cache
def solo() -> legs.Legged:
    return legs.Legged("solo12", "coulomb", 3)


@cache
def walking() -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset, forcegp.Dataset, float]:
    """A Solo12 that sways and trots, then walks, and the mass that its trunk has above the file."""
    legged = solo()
    trot, walk = legs.gaits(legged).values()
    parts = [legs.dataset(legged, legged.record(*part)) for part in ((legged.sway(), 4.0), (trot, 6.0))]
    test = legs.dataset(legged, legged.record(walk, 4.0))
    added = float(legged.true.body_mass[legged.trunk] - legged.nominal.body_mass[legged.trunk])
    return legs.system_of(legged), forcegp.Dataset.concatenate(parts)[::5], test[::10], added


@cache
def fitted() -> StructuredFit:
    """A default fit."""
    system, train, _, _ = walking()
    return forcegp.StructuredGP(system).fit(train)


def test_a_free_base_has_no_joint_forces() -> None:
    robot = forcegp.load_robot(example_data() / "solo_description/robots/solo12.urdf", base="free")
    assert robot.driven.tolist() == [False] * 6 + [True] * 12
    assert unpack_system(*pack_system(forcegp.ConstrainedSystem(robot)), "here").robot.undriven == BASE_JOINTS
    system = forcegp.ConstrainedSystem(robot)
    q = torch.randn(3, robot.nq, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    at, prior = states(system, q, q, q, torch.ones(3, 0, dtype=torch.bool)), JointFrictionPrior()
    E = prior.operator(system, at)
    torch.testing.assert_close(E, torch.diag(robot.driven.double()).expand_as(E))
    B = torch.randn(3, 4, robot.nq, dtype=torch.float64)
    torch.testing.assert_close(prior.applied(B, system, at), B @ E)


def test_a_drive_may_have_the_name_of_a_joint_of_the_base(tmp_path: Path) -> None:
    text = (example_data() / "ur_description/urdf/ur5_robot.urdf").read_text()
    (tmp_path / "arm.urdf").write_text(text.replace('"shoulder_pan_joint"', '"base_yaw"'))
    robot = forcegp.load_robot(tmp_path / "arm.urdf")
    assert robot.joint_names[0] == "base_yaw" and bool(robot.driven.all())


@pytest.mark.slow
def test_feet_of_a_walking_robot() -> None:
    system, train, test, _ = walking()
    read = fitted().contact_force(test)
    assert read.mean.shape == (len(test), 12) and list(read.parts) == list(system.contact_names)
    assert read.std is not None
    force, std = ({f: x[:, own] for f, own in read.parts.items()} for x in (read.mean, read.std))
    own = legs.score(solo(), test, read.mean, read.covariance)
    plain = legs.score(solo(), test, legs.Plain(system, train, False).forces(test))
    alone = legs.score(solo(), test, legs.of_legs(solo(), system, test))
    sizes = [float(np.linalg.norm(x["rmse_N"])) for x in (own, plain, alone)]
    assert sizes[0] < 0.6 * sizes[1] and sizes[0] < 0.4 * sizes[2]
    assert np.mean(own["coverage"]) > 0.75
    for foot, x in force.items():
        open_ = ~test.contact[foot]
        assert bool((x[open_] == 0.0).all()) and bool((std[foot][open_] == 0.0).all())
    one = fitted().contact_force(test, system.contact_names[2])
    torch.testing.assert_close(one.mean, force[system.contact_names[2]], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_touch_down_and_lift_off_are_found_in_an_imported_log(monkeypatch: pytest.MonkeyPatch) -> None:
    gaits = legs.gaits
    monkeypatch.setattr(legs, "gaits", lambda legged: {"trot": gaits(legged)["trot"]})
    monkeypatch.setitem(legs.SECONDS, "labels", 10.0)
    exact, estimated = legs.touchdown("solo12", "dahl", 3)
    assert exact["switches"] > 100 and min(exact["found"], estimated["found"]) > 0.98


@pytest.mark.slow
def test_the_base_has_exact_torques_and_the_trunk_is_weighed() -> None:
    _, train, _, added = walking()
    fit = fitted()
    noise = fit.hyperparameters[TORQUE_NOISE].exp()
    assert noise[:6].tolist() == pytest.approx([EXACT] * 6)
    # Beside the noise of accelerations, the log does not show that of each joint.
    stated = legs.TORQUE * float(train.tau.abs().max())
    assert 0.5 < float(noise[6:].square().mean().sqrt()) / stated < 2.0
    assert float(fit.hyperparameters[MEMORY][:6].exp().max()) < 1e-9
    found = {each.name: each for each in fit.parameters()}
    assert not any("base" in name for name in found if not name.startswith("inertial."))
    assert not any(name.startswith("inertial.drive of base") for name in found)
    robot = {(each.name, each.of): each for each in fit.robot_parameters()}
    mass = robot["link mass", "base_roll"]
    assert mass.determined and mass.std is not None and abs(mass.value - added) < 2.0 * mass.std
    assert not any("too few to check the masses" in text for text in fit.result.warnings)
    # The robot of the fit includes what was learned.
    assert abs(float(fit.system.robot.mass[5] - solo().robot.mass[5]) - mass.value) < 1e-9
    drives, true = fit.system.robot.armature[6:], torch.from_numpy(solo().true.dof_armature[6:])
    assert float((drives / true).log().abs().median()) < 0.25


@pytest.mark.slow
def test_accelerations_of_a_walking_robot_follow_from_torques() -> None:
    """Drives of a leg exceed its links, so that a force −d q̈ with q̈ of the file would diverge."""
    system, _, test, _ = walking()
    state, active = (test.q, test.qd, test.tau, "qdd"), test.active(system.contact_names)
    predicted, file = (
        fitted().predict(*state, active=active),
        forcegp.AnalyticalModel(system).nominal().predict(*state, active=active),
    )
    assert predicted.std is not None
    sizes = [(each.mean - test.qdd).square().mean(0).sqrt() for each in (predicted, file)]
    assert float((sizes[0] / sizes[1]).log().mean().exp()) < 0.8
    inside = (predicted.mean - test.qdd).abs() <= 2.0 * predicted.std
    assert float(inside.double().mean()) > 0.9
