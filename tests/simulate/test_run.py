"""Whole runs: the surface is kept, our equations of motion explain every sample, and the log is complete."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import forcegp
from forcegp import ConstrainedSystem, Plane, SurfaceContact, kinematics
from forcegp.constraints import Baumgarte, Cylinder, Sphere
from forcegp.constraints.surface import Surface
from forcegp.errors import ForceGPError, NumericalError
from forcegp.simulate import Gains, SimulationConfig, SimulationResult, simulate

DRIFT = 3e-4
"""Largest distance from the surface [m] that the task allows."""
ACCELERATIONS = 1e-6
"""Largest difference of accelerations [rad/s²] that the task allows."""
TRACKING = 0.01
"""Friction of 1 N s/m at 0.6 m/s against a stiffness of some hundred N/m [m]."""
FRAME, POINT = "lbr_iiwa_link_7", (0.0, 0.0, 0.1)
ROBOT = forcegp.load_robot("kuka_iiwa", base_position=(0, 0, 0.05), gravity=(0, 0, -9.8))


def _system(surface: Surface) -> ConstrainedSystem:
    return ConstrainedSystem(ROBOT, [SurfaceContact("table", FRAME, POINT, surface)], Baumgarte())


TABLE = _system(Plane((0, 0, 1), 0.055))


@pytest.fixture(scope="module")
def sliding() -> SimulationResult:
    return simulate(TABLE, SimulationConfig(duration=2.0))


@pytest.fixture(scope="module")
def lifting() -> SimulationResult:
    # With this seed the first line is on the table, the second leaves it, the third comes back.
    config = SimulationConfig(
        duration=2.4,
        travel_time=0.6,
        max_acceleration=8.0,
        lift_probability=0.5,
        lift_height=(0.02, 0.05),
        seed=7,
    )
    return simulate(TABLE, config)


def test_the_tip_stays_on_the_table_and_presses(sliding: SimulationResult) -> None:
    multiplier = sliding.data.contact_extras["multiplier"]["table"]
    assert float(sliding.c.abs().max()) < DRIFT
    assert bool(sliding.data.contact["table"].all())
    # Where the reference keeps to the surface, λ becomes the pressing force but for the error of tracking.
    low, high = SimulationConfig().pressing_force
    assert low - 0.5 < float(multiplier.min()) < float(multiplier.max()) < high + 0.5
    assert sliding.saturated == 0 and sliding.beyond_limits == 0
    assert float((sliding.position - sliding.reference.position).norm(dim=-1).max()) < TRACKING
    assert 0.3 < float(sliding.velocity.norm(dim=-1).max()) < 1.0


def test_our_equations_of_motion_explain_every_sample(sliding: SimulationResult) -> None:
    data = sliding.data
    eom = TABLE.equations(data.q, data.qd)
    ours = eom.acceleration(data.tau + eom.Q_K + data.Q_z)
    assert float((ours - data.qdd_clean).abs().max()) < ACCELERATIONS
    assert 0.0 < sliding.acceleration_mismatch < ACCELERATIONS
    torch.testing.assert_close(data.Q, data.tau + eom.Q_K, atol=1e-10, rtol=0.0)
    torch.testing.assert_close(eom.constraint_force(data.Q + data.Q_z), data.Q_I, atol=1e-9, rtol=0.0)
    # Without friction they do not, so there is something to learn.
    assert float((eom.acceleration(data.Q) - data.qdd_clean).abs().max()) > 0.1


def test_the_log_is_what_the_engine_did(sliding: SimulationResult) -> None:
    data, dt = sliding.data, 1.0 / 240.0
    torch.testing.assert_close(data.qd.diff(dim=0) / dt, data.qdd_clean[:-1], atol=1e-9, rtol=0.0)
    torch.testing.assert_close(data.q.diff(dim=0) / dt, data.qd[1:], atol=1e-10, rtol=0.0)
    noise = data.qdd - data.qdd_clean
    # 3360 draws: the standard deviation is known to 1.2 %, the mean to 0.0017.
    assert float(noise.std()) == pytest.approx(0.1, rel=0.06)
    assert abs(float(noise.mean())) < 5 * 0.0017
    assert data.header.robot_fingerprint == ROBOT.fingerprint
    assert data.header.noise_std == 0.1 and data.header.dt == pytest.approx(dt)
    assert data.t.shape == (480,) and data.joint_names == ROBOT.joint_names


def test_the_tool_stays_perpendicular_to_the_table(sliding: SimulationResult) -> None:
    rotation, _ = kinematics.frame_pose(ROBOT, sliding.data.q, FRAME)
    tilt = torch.linalg.vector_norm(rotation[:, :2, 2], dim=-1)
    assert float(tilt.max()) < 0.02 and float(rotation[:, 2, 2].max()) < 0.0


def test_the_elbow_swings_and_the_tool_does_not_mind(sliding: SimulationResult) -> None:
    still = simulate(TABLE, SimulationConfig(duration=2.0, elbow_swing=0.0, engine="mujoco"))
    joint_3 = ROBOT.joint_index("lbr_iiwa_joint_3")
    assert float(sliding.data.q[:, joint_3].std()) > 2.0 * float(still.data.q[:, joint_3].std())
    # The draws of the elbow come after those of the waypoints, so that both runs have one reference.
    assert torch.equal(still.reference.position, sliding.reference.position)
    assert float((still.position - sliding.position).abs().max()) < 0.005


def test_the_seed_decides() -> None:
    short = SimulationConfig(duration=0.1)
    first, again, other = (simulate(TABLE, c).data for c in (short, short, replace(short, seed=1)))
    assert torch.equal(first.qdd, again.qdd) and torch.equal(first.q, again.q)
    assert not torch.equal(first.q, other.q)


def test_both_engines_give_the_same_motion() -> None:
    pytest.importorskip("pybullet")
    runs = [simulate(TABLE, SimulationConfig(duration=0.4, engine=name)) for name in ("pybullet", "mujoco")]
    torch.testing.assert_close(runs[0].data.q, runs[1].data.q, atol=1e-9, rtol=0.0)
    assert all(run.acceleration_mismatch < ACCELERATIONS for run in runs)


def test_the_contact_opens_and_closes_and_never_pulls(lifting: SimulationResult) -> None:
    closed = lifting.data.contact["table"]
    multiplier = lifting.data.contact_extras["multiplier"]["table"]
    changes = closed.int().diff()
    assert int((changes == 1).sum()) >= 1 and int((changes == -1).sum()) >= 1
    assert float(multiplier.min()) >= 0.0
    assert float(multiplier[~closed].abs().max()) == 0.0
    assert float(lifting.data.Q_z[~closed].abs().max()) == 0.0
    assert float(lifting.c[~closed].max()) > 0.01
    assert float(lifting.c.min()) > -DRIFT
    assert float(lifting.c[closed].abs().max()) < DRIFT
    assert lifting.acceleration_mismatch < ACCELERATIONS


@pytest.mark.parametrize(
    "surface",
    [
        Sphere((0.5, 0.0, -0.5), 0.6),
        Cylinder((0.5, 0.0, -0.3), (0.0, 1.0, 0.0), 0.4),
        Plane((-0.3, 0.0, 1.0), 0.0),
    ],
    ids=["sphere", "cylinder", "tilted"],
)
def test_other_surfaces(surface: Surface) -> None:
    result = simulate(_system(surface), SimulationConfig(duration=0.8, travel_time=0.8, size=(0.2, 0.3)))
    assert float(result.c.abs().max()) < DRIFT
    assert bool(result.data.contact["table"].all())
    assert float((result.position - result.reference.position).norm(dim=-1).max()) < TRACKING
    assert result.acceleration_mismatch < ACCELERATIONS


def test_free_motion() -> None:
    config = SimulationConfig(
        duration=0.8, center=(0.5, 0.0, 0.3), lift_probability=1.0, point=POINT, viscous_friction=5.0
    )
    result = simulate(ConstrainedSystem(ROBOT), config)
    assert not result.data.contact and result.c.shape == (192, 0)
    assert float(result.data.Q_I.abs().max()) == 0.0 and float(result.data.Q_z.abs().max()) == 0.0
    assert float((result.position - result.reference.position).norm(dim=-1).max()) < TRACKING
    assert result.acceleration_mismatch < ACCELERATIONS
    assert "multiplier_min_N" not in result.summary()


def test_torque_limits_hold_and_are_counted() -> None:
    limit = (40.0, 25.0, 40.0, 40.0, 40.0, 40.0, 40.0)
    result = simulate(TABLE, SimulationConfig(duration=0.5, torque_limit=limit))
    assert bool((result.data.tau.abs() <= torch.tensor(limit)).all())
    assert result.saturated > 0 and result.summary()["saturated_samples"] == result.saturated
    assert result.acceleration_mismatch < ACCELERATIONS


def test_a_diverging_run_names_time_and_state() -> None:
    wild = SimulationConfig(duration=2.0, gains=Gains(position_stiffness=1e7))
    with pytest.raises(NumericalError, match=r"diverges at t = 0\.\d+ s(.|\n)*q = \["):
        simulate(TABLE, wild)


def test_a_rectangle_out_of_reach_is_named() -> None:
    with pytest.raises(NumericalError, match="rectangle"):
        simulate(TABLE, SimulationConfig(center=(2.0, 0.0, 0.0)))


def test_an_interrupt_ends_the_run_and_closes_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    from forcegp.simulate.engines import MuJoCoEngine

    closed = []
    monkeypatch.setattr(MuJoCoEngine, "close", lambda engine: closed.append(engine.dt))

    def interrupt(done: int, _: int) -> None:
        if done > 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(TABLE, SimulationConfig(engine="mujoco"), progress=interrupt)
    assert len(closed) == 1


def test_progress_counts_up_to_the_end() -> None:
    seen: list[tuple[int, int]] = []
    simulate(TABLE, SimulationConfig(duration=0.21), progress=lambda done, total: seen.append((done, total)))
    assert [done for done, _ in seen] == [24, 48, 50] and {total for _, total in seen} == {50}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("duration", -1.0),
        ("noise_std", float("nan")),
        ("pressing_force", (5.0, 1.0)),
        ("lift_probability", 2.0),
    ],
)
def test_settings_out_of_range_are_named(field: str, value: object) -> None:
    with pytest.raises(ForceGPError, match=field):
        SimulationConfig(**{field: value})  # type: ignore[arg-type]
