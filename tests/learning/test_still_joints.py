"""A joint that does not move shows nothing of its friction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import forcegp
from forcegp.forces.measurements import observations_of
from forcegp.learning.specification import at_rest, still_joints
from planted_faults import free_log

STILL = 4
STATIC = 0.6
"""Torque that static friction holds [N m]."""


def log(speed_noise: float) -> forcegp.Dataset:
    """Free motion of a UR5 whose joint 5 rests, with friction, torque noise and noise of all sensors."""
    robot = forcegp.load_robot("ur5")
    free, random = free_log(robot, seconds=8.0), np.random.default_rng(1)
    q, qd, qdd = (x.copy() for x in (free.q, free.qd, free.qdd))
    q[:, STILL], qd[:, STILL], qdd[:, STILL] = q[0, STILL], 0.0, 0.0
    states = [torch.from_numpy(x) for x in (q, qd, qdd)]
    friction = 3.0 * np.tanh(qd / 0.01) + qd
    friction[:, STILL] = STATIC
    tau = forcegp.dynamics.inverse_dynamics(robot, *states).numpy() + friction
    noisy = (x + s * random.standard_normal(x.shape) for x, s in ((q, 1e-5), (qd, speed_noise), (tau, 0.1)))
    q, qd, tau = (torch.from_numpy(x) for x in noisy)
    data = forcegp.Dataset(
        t=torch.from_numpy(free.t),
        q=q,
        qd=qd,
        qdd=torch.from_numpy(qdd),
        tau=tau,
        joint_names=robot.joint_names,
        segment=torch.zeros(len(q), dtype=torch.long),
        header=free.header,
    )
    return data[::2]


@pytest.mark.parametrize("speed_noise", [1e-5, 1e-3])
def test_friction_of_a_still_joint_stays_at_its_prior(speed_noise: float) -> None:
    """Noise of its velocity is neither its friction nor a sign that it has none."""
    system = forcegp.ConstrainedSystem(forcegp.load_robot("ur5"))
    fit = forcegp.StructuredGP(system, "analytical").fit(log(speed_noise))
    name = system.robot.joint_names[STILL]
    own = {p.name: p for p in fit.parameters() if p.name.endswith(f" of {name}")}
    names = [f"joint_friction.{part} of {name}" for part in ("velocity", "coulomb_0", "coulomb_1")]
    names += [f"bristles.z_{k} of {name}" for k in range(4)]
    for one in (own[each] for each in names):
        assert one.value == 0.0 and not one.determined and 0.01 < one.std < STATIC
    offset = own[f"joint_friction.offset of {name}"]
    assert offset.value == pytest.approx(-STATIC, abs=0.1)
    assert any("do not move" in doubt and name in doubt for doubt in fit.result.warnings)
    for one in fit.robot_parameters():
        if one.name.endswith("friction") and one.of == name:
            assert not one.determined
        elif one.name == "fast friction":
            assert one.determined and one.std is not None and one.speed is not None
            assert abs(one.value - 3.0 - one.speed) < 4.0 * one.std


def test_samples_of_a_still_joint_are_forgotten_as_they_were_learned() -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("ur5"))
    data = log(1e-3)
    fit = forcegp.StructuredGP(system, "analytical").fit(data[:600])
    back = fit.update(data[600:700]).forget(data[600:700])
    rows = data[700:710]
    ours, theirs = (one.predict(rows.q, rows.qd, rows.tau) for one in (fit, back))
    torch.testing.assert_close(ours.mean, theirs.mean, rtol=1e-6, atol=1e-6)


def test_still_joints_are_those_within_the_least_distance() -> None:
    data = log(1e-3)
    assert still_joints(observations_of(data)) == [j == STILL for j in range(6)]
    moved = data.q.clone()
    moved[:, STILL] += torch.linspace(0.0, 0.004, len(data))
    assert not any(still_joints(observations_of(data.replace(q=moved))))
    rested = at_rest(data, [j == STILL for j in range(6)])
    assert not rested.qd[:, STILL].any() and torch.equal(rested.qd[:, :STILL], data.qd[:, :STILL])


def test_a_streamed_log_learns_the_same_of_a_still_joint(tmp_path: Path) -> None:
    data = log(1e-3)
    data.write(tmp_path / "log.parquet")
    system = forcegp.ConstrainedSystem(forcegp.load_robot("ur5"))
    stream = forcegp.StreamedDataset((tmp_path / "log.parquet",))
    fits = [forcegp.StructuredGP(system, "analytical").fit(x) for x in (data, stream)]
    ours, theirs = ({p.name: p for p in fit.parameters()} for fit in fits)
    name = system.robot.joint_names[STILL]
    for part in ("velocity", "coulomb_0"):
        one = theirs[f"joint_friction.{part} of {name}"]
        assert one.value == 0.0 and one.std == pytest.approx(ours[one.name].std, rel=1e-6)
