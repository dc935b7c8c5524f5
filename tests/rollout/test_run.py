"""Inputs, divergence, shapes, progress: what a rollout does besides integrating."""

import pytest
import torch

from forcegp.constraints import Baumgarte
from forcegp.control.plan import make_plan
from forcegp.data import Dataset
from forcegp.errors import DataError, ForceGPError, ModelError, ShapeError, UnknownNameError
from forcegp.rollout import DivergedError, Feedback, ForceLaw, RolloutOptions, TaskSpaceControl, rollout
from forcegp.simulate import SimulationConfig
from rollout_cases import ANALYTICAL, arm, simulated, slider


def free_fall(tau: object, seconds: float, tmp_path, **options):
    system = slider(tmp_path)
    start = torch.tensor([0.0, 1.0], dtype=torch.float64)
    closed = torch.zeros(1, dtype=torch.bool)
    return rollout(
        ANALYTICAL, system, start, 0.0 * start, tau, seconds, active=closed, options=RolloutOptions(**options)
    )


def test_held_and_interpolated_torques(tmp_path) -> None:
    """The carriage and block, 3 kg, along x, driven by a ramp: held samples lag by half a sample."""
    tau = torch.stack([3.0 * torch.arange(11), torch.zeros(11)], dim=-1).double()
    held = free_fall(tau, 1.0, tmp_path, dt=0.1, method="rk4")
    linear = free_fall(tau, 1.0, tmp_path, dt=0.1, method="rk4", interpolation="linear")
    t = held.t
    assert torch.allclose(linear.qd[:, 0], 10.0 * t**2 / 2.0, atol=1e-12)
    assert torch.allclose(held.qd[:, 0], 10.0 * t**2 / 2.0 - 0.5 * t, atol=1e-12)
    assert torch.equal(held.tau[:, 0], tau[:, 0])


def test_torques_are_held_for_their_period_whatever_the_step(tmp_path) -> None:
    tau = torch.randn(4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = free_fall(tau, 0.4, tmp_path, dt=0.1, method="dop853")
    impulse = torch.cat([torch.zeros(1, dtype=torch.float64), (0.1 * tau[:, 0]).cumsum(0)])
    assert torch.allclose(found.qd[:, 0], impulse / 3.0, atol=1e-9)


def test_the_period_of_the_torques_comes_from_the_log_or_is_required(tmp_path) -> None:
    """A ramp logged at 500 Hz takes as long as it was logged, not as at 240 Hz."""
    t = 0.002 * torch.arange(101, dtype=torch.float64)
    tau = torch.stack([30.0 * t, torch.zeros_like(t)], dim=-1)
    log = Dataset(t=t, q=0.0 * tau, qd=0.0 * tau, tau=tau, qdd=0.0 * tau, joint_names=("along", "up"))
    found = free_fall(log, 0.2, tmp_path)
    assert found.t.shape == (101,) and float(found.t[-1]) == pytest.approx(0.2)
    assert torch.allclose(found.tau[:, 0], 30.0 * found.t, atol=1e-12)
    coarse = free_fall(log, 0.2, tmp_path, dt=0.01)
    assert torch.allclose(coarse.tau[:, 0], 30.0 * coarse.t, atol=1e-12), "the step is not the period"
    with pytest.raises(ModelError, match=r"sampling period of an array of torques(.|\n)*RolloutOptions\(dt="):
        free_fall(tau, 0.2, tmp_path)
    constant = free_fall(tau[1:2], 0.1, tmp_path)
    assert torch.equal(constant.tau, tau[1:2].expand_as(constant.tau))
    for broken in (log[torch.tensor([0, 1, 2, 5, 6])], log[:1], log[torch.tensor([3, 1, 2])]):
        with pytest.raises(DataError, match="cannot be replayed"):
            free_fall(broken, 0.1, tmp_path)


def test_a_diverging_run_keeps_what_was_computed(tmp_path) -> None:
    def runaway(t: torch.Tensor, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor:
        return 40.0 * qd + 5.0

    with pytest.raises(
        DivergedError, match=r"1 of 1 trajectories diverge, the first at t = 0\.\d+ s"
    ) as error:
        free_fall(runaway, 5.0, tmp_path)
    kept = error.value.rollout
    (first,) = kept.diverged
    assert float(kept.t[-1]) == pytest.approx(first.t)
    assert torch.isfinite(kept.q).all()
    assert kept.q[-1].tolist() == first.q
    assert "expected" in str(error.value) and "hint" in str(error.value)


def test_members_that_diverge_do_not_disturb_the_others(tmp_path) -> None:
    gains = torch.tensor([[0.0], [60.0]], dtype=torch.float64)
    system = slider(tmp_path)
    start = torch.tensor([[0.0, 1.0], [0.0, 1.0]], dtype=torch.float64)
    law = Feedback(lambda t, q, qd: gains * qd)
    closed = torch.zeros(1, dtype=torch.bool)
    options = RolloutOptions(on_divergence="keep")
    both = rollout(ANALYTICAL, system, start, start, law, 1.0, active=closed, options=options)
    alone = rollout(
        ANALYTICAL,
        system,
        start[0],
        start[0],
        torch.zeros(1, 2).double(),
        1.0,
        active=closed,
        options=options,
    )
    assert [d.row for d in both.diverged] == [1]
    assert torch.allclose(both.q[0], alone.q)
    assert not bool(torch.isfinite(both.q[1, -1]).any())
    assert len(both.t) == 241


def test_the_task_space_controller_follows_its_plan() -> None:
    """Closed loop, the rollout is the simulation: same controller, same step."""
    reference, system = simulated(), arm(Baumgarte())
    config = SimulationConfig(duration=1.2, seed=3, viscous_friction=0.0, noise_std=0.0)
    plan = make_plan(system, config, torch.Generator().manual_seed(config.seed))
    law = TaskSpaceControl(system, plan, config.dt, config.gains)
    data = reference.data
    found = rollout(ANALYTICAL, system, data.q[0], data.qd[0], law, 0.5)
    assert float((found.q - data.q[:121]).abs().max()) < 1e-8
    assert float((found.tau - data.tau[:121]).abs().max()) < 1e-5


def test_progress_reaches_the_end(tmp_path) -> None:
    seen: list[tuple[int, int]] = []
    system, start = slider(tmp_path), torch.zeros(2, dtype=torch.float64)
    rollout(
        ANALYTICAL,
        system,
        start,
        start,
        start[None],
        0.05,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen == [(k, 12) for k in range(1, 13)]


def test_a_singular_law_stops_the_run_with_its_reason(tmp_path) -> None:
    from forcegp.errors import NumericalError

    def fails(system, at):
        if float(at.q[0, 1]) < 0.9:
            raise NumericalError("too low")
        return at.eom.Q_K

    start = torch.tensor([0.0, 1.0], dtype=torch.float64)
    closed = torch.zeros(1, dtype=torch.bool)
    with pytest.raises(DivergedError, match="too low") as error:
        rollout(ForceLaw(fails), slider(tmp_path), start, 0 * start, start[None], 1.0, active=closed)
    assert float(error.value.rollout.q[-1, 1]) >= 0.9


@pytest.mark.parametrize("shape", [(7,), (3, 10, 7), (0, 7)])
def test_torques_of_the_wrong_shape_are_refused(shape: tuple[int, ...]) -> None:
    data = simulated().data
    with pytest.raises(ShapeError, match="torques do not match"):
        rollout(ANALYTICAL, arm(), data.q[0], data.qd[0], torch.zeros(shape, dtype=torch.float64), 0.1)


def test_options_are_checked() -> None:
    with pytest.raises(ForceGPError, match="dt is out of range"):
        RolloutOptions(dt=0.0)
    data = simulated().data
    for option in ("interpolation", "stabilization"):
        with pytest.raises(UnknownNameError, match=option):
            rollout(
                ANALYTICAL,
                arm(),
                data.q[0],
                data.qd[0],
                data,
                0.1,
                options=RolloutOptions(**{option: "?"}),
            )
