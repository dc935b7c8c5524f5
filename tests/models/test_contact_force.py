"""The force of a contact that sticks and slides along a log of MuJoCo, without a stick speed."""

from __future__ import annotations

import dataclasses
from functools import cache

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.quantities import states
from forcegp.forces.unknowns import (
    NORMAL_SPEED_STDS,
    share_at_rest,
    stated_tips,
    tip_factor,
    tip_keys,
    tip_operator,
    tip_variance,
)
from forcegp.models.structured_fit import StructuredFit
from forcegp.scene import load_scene
from forcegp.simulate import simulate

SECONDS, RESTS = 16.0, 0.02
"""Length of a log [s]; tangential speed below which MuJoCo's soft contact creeps [m/s]."""
FORCES = ("fx", "fy", "fz")
SAME = 1e-9
"""Relative agreement of two exact formulas through small factorisations."""


@cache
def logs() -> dict[str, forcegp.Dataset]:
    """Logs of a UR5 with friction that its file lacks, whose tip slides, or sticks while it is pulled at."""
    scene = load_scene("ur5_wiping")
    config = dataclasses.replace(scene.simulation, duration=SECONDS, seed=3)
    solver = dataclasses.replace(config.solver, friction=3.0)
    sticks = dataclasses.replace(config, seed=4, size=(0.03, 0.03), solver=solver)
    return {name: simulate(scene.system(), c).data for name, c in (("slides", config), ("sticks", sticks))}


@cache
def fitted() -> StructuredFit:
    halves = forcegp.Dataset.concatenate([log[: len(log) // 2] for log in logs().values()])
    return forcegp.StructuredGP(load_scene("ur5_wiping").system()).fit(halves[::4])


def judged(name: str) -> tuple[forcegp.Dataset, Tensor, Tensor]:
    """Rows of the second half in contact that stick or slide, the true force, and the tangential speed."""
    log = logs()[name]
    log = log[len(log) // 2 :: 5]
    speed = fitted().system.equations(log.q, log.qd).contact_points["table"].sliding[1].norm(dim=-1)
    rows = log.contact["table"]
    rows &= (speed < RESTS) if name == "sticks" else (speed > 2.0 * RESTS)
    log = log[rows]
    return log, log.contact_extras["F_I"]["table"] + log.contact_extras["F_z"]["table"], speed[rows]


def plain(log: forcegp.Dataset) -> Tensor:
    """The force by equations of motion with the robot file `(n, 3)`."""
    eom = load_scene("ur5_wiping").system().equations(log.q, log.qd)
    left = (eom.M @ log.qdd[..., None])[..., 0] - eom.Q_K - log.tau
    return torch.linalg.lstsq(eom.contact_points["table"].jacobian.mT, left[..., None]).solution[..., 0]


@pytest.mark.parametrize("name", ["slides", "sticks"])
def test_the_force_along_a_log(name: str) -> None:
    log, true, _ = judged(name)
    assert len(log) > 100
    found = fitted().contact_force(log)
    assert found.std is not None and found.mean.shape == true.shape
    error = found.mean - true
    rmse, before = (float(e.square().sum(-1).mean().sqrt()) for e in (error, plain(log) - true))
    covered = float((error.abs() <= 2.0 * found.std).double().mean())
    assert rmse < 0.25 * before, (rmse, before)
    assert covered > 0.85
    assert float(found.std.square().sum(-1).sqrt().median()) < 3.0 * rmse


def test_the_tangential_force_at_rest_has_the_size_of_the_log() -> None:
    """A tip that is pulled at has a large unknown force at rest and a small one while it slides."""
    values, true = fitted().hyperparameters, judged("sticks")[1]
    slides, rests = (float(values[key].exp()) for key in tip_keys("table")[:2])
    pulled = float(true[:, :2].square().mean().sqrt())
    assert 0.2 * pulled < rests < 5.0 * pulled
    assert slides < 0.2 * rests


def test_the_coefficient_is_that_of_the_log_that_slides() -> None:
    """Friction of a contact at rest is no evidence of the coefficient of one that slides."""
    [law] = fitted().posterior.process.coulomb
    assert float(law.coefficient) == pytest.approx(
        load_scene("ur5_wiping").simulation.solver.friction, rel=0.15
    )


def test_it_is_the_external_wrench_with_the_same_prior() -> None:
    """At rest, the force of a contact is a wrench without moments: one least-squares problem."""
    fit, (log, _, _) = fitted(), judged("sticks")
    still = log.replace(qd=torch.zeros_like(log.qd))
    force = fit.contact_force(still, "table", prior_std=(30.0, 30.0))
    open_ = still.replace(contact={"table": torch.zeros(len(still), dtype=torch.bool)})
    contact = fit.system.contact("table")
    assert isinstance(contact, forcegp.SurfaceContact)
    at = {"axes": FORCES, "point": tuple(contact.point), "prior_std": (30.0, 5.0)}
    wrench = fit.external_wrench(open_, contact.frame, **at)
    assert force.covariance is not None and wrench.covariance is not None
    torch.testing.assert_close(force.mean, wrench.mean, rtol=SAME, atol=SAME * 30.0)
    torch.testing.assert_close(force.covariance, wrench.covariance, rtol=SAME, atol=SAME * 900.0)


def test_no_force_while_the_contact_is_open() -> None:
    log = judged("sticks")[0][:5]
    found = fitted().contact_force(log.replace(contact={"table": torch.zeros(5, dtype=torch.bool)}))
    assert found.covariance is not None
    assert not bool(found.mean.any()) and not bool(found.covariance.any())


def test_the_covariance_of_the_unknown_force() -> None:
    """(σ² + s² e^{−(v/v_s)²}) J_Eᵀ (1 − n nᵀ) J_E, zero while the contact is open."""
    system = load_scene("ur5_wiping").system()
    log = judged("sticks")[0][:4]
    values = {
        key: torch.tensor(x, dtype=torch.float64).log()
        for key, x in zip(tip_keys("table"), (0.5, 4.0, 0.05), strict=True)
    }
    closed = torch.tensor([[True], [True], [True], [False]])
    at = states(system, log.q, log.qd, log.tau, closed)
    N = tip_factor(values, system, at)
    assert N is not None
    point = at.eom.contact_points["table"]
    n, v = point.unit_normal, point.sliding[1].norm(dim=-1)
    variance = 0.25 + 16.0 * torch.exp(-((v / 0.05) ** 2))
    torch.testing.assert_close(tip_variance(values, at, "table"), variance)
    along = torch.eye(3, dtype=torch.float64) - n[..., None] * n[..., None, :]
    expected = variance[:, None, None] * point.jacobian.mT @ along @ point.jacobian
    expected[3] = 0.0
    torch.testing.assert_close(N @ N.mT, expected)
    assert not bool(tip_operator(system, at, "table")[3].any())
    assert bool((share_at_rest({}, at, "table") < share_at_rest(values, at, "table")).all())


def test_rest_is_told_by_the_speed_along_the_normal() -> None:
    """A closed contact has no normal speed, so that its apparent one is an error of velocities."""
    system, wrong = load_scene("ur5_wiping").system(), 0.05
    log = judged("sticks")[0]
    closed = torch.ones(len(log), 1, dtype=torch.bool)
    point = system.equations(log.q, log.qd).contact_points["table"]
    up = torch.linalg.pinv(point.jacobian) @ point.unit_normal[..., None]
    noise = torch.randn(len(log), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    speeds = []
    for size in (0.0, wrong):
        at = states(system, log.q, log.qd + size * noise[:, None] * up[..., 0], log.tau, closed)
        speeds.append(float(stated_tips(system, [at])[tip_keys("table").speed].exp()))
    assert speeds[0] == pytest.approx(0.02)
    assert speeds[1] == pytest.approx(NORMAL_SPEED_STDS * wrong, rel=0.15)


def test_contacts_that_cannot_be_read() -> None:
    log = judged("sticks")[0][:2]
    with pytest.raises(UnknownNameError, match="contact 'floor'"):
        fitted().contact_force(log, "floor")
    free = dataclasses.replace(fitted(), system=forcegp.ConstrainedSystem(fitted().system.robot))
    with pytest.raises(ModelError, match="no contact with a surface"):
        free.contact_force(log)
