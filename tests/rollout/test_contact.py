"""Unilateral contact: lift-off and landing where closed forms say, impacts, no false loss."""

import math
from functools import cache

import pytest
import torch

from forcegp.constraints import Baumgarte
from forcegp.data import Dataset, select_points
from forcegp.errors import ModelError
from forcegp.gp.optimise import LearningOptions
from forcegp.models.registry import create
from forcegp.rollout import AccelerationLaw, RolloutOptions, contact_loss_probability, rollout
from forcegp.simulate import SimulationConfig, simulate
from rollout_cases import ANALYTICAL, GRAVITY, SLIDER_MASS, arm, pulled_off, simulated, slider

WEIGHT = SLIDER_MASS * GRAVITY
EVENT_TOLERANCE = 1e-7
"""An event is located to far less than a step of 4 ms [s]."""


def unilateral(**options) -> RolloutOptions:
    return RolloutOptions(unilateral=True, **options)


def state(along: float, up: float) -> torch.Tensor:
    return torch.tensor([along, up], dtype=torch.float64)


def ramp(t: torch.Tensor, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor:
    """A pull that reaches the weight after 0.1003 s."""
    return torch.cat([torch.zeros_like(t), WEIGHT * t / 0.1003], dim=-1)


@pytest.mark.parametrize("method", ["semi_implicit_euler", "rk4", "dop853"])
def test_lift_off_is_located_within_the_step(tmp_path, method: str) -> None:
    system = slider(tmp_path)
    dt = 0.02 if method == "dop853" else 1.0 / 240.0
    options = unilateral(method=method, stabilization="none", dt=dt)
    found = rollout(ANALYTICAL, system, state(0, 0), state(0.5, 0), ramp, 0.2, options=options)
    (event,) = found.events
    assert (event.contact, event.closed) == ("floor", False)
    assert event.t == pytest.approx(0.1003, abs=EVENT_TOLERANCE)
    # After lift-off z̈ = g (t/t₀ − 1), so z = g (t − t₀)³ / (6 t₀).
    height = GRAVITY * (found.t[-1] - 0.1003) ** 3 / (6.0 * 0.1003)
    tolerance = 1e-4 if method == "semi_implicit_euler" else 1e-8
    assert float(found.q[-1, 1]) == pytest.approx(float(height), abs=tolerance)
    before = found.t < 0.1003
    assert torch.equal(found.active[:, 0], before)
    assert torch.allclose(found.multiplier[before, 0], WEIGHT * (1.0 - found.t[before] / 0.1003))
    assert float(found.multiplier[~before].abs().max()) == 0.0


def test_landing_is_located_and_inelastic(tmp_path) -> None:
    system, height = slider(tmp_path), 0.05
    fall = math.sqrt(2.0 * height / GRAVITY)
    options = unilateral(method="rk4", stabilization="none")
    nothing = torch.zeros(1, 2, dtype=torch.float64)
    found = rollout(ANALYTICAL, system, state(0, height), state(0.5, 0), nothing, 0.2, options=options)
    (event,) = found.events
    assert event.closed
    assert event.t == pytest.approx(fall, abs=EVENT_TOLERANCE)
    assert not bool(found.active[0]) and bool(found.active[-1])
    after = found.t > fall
    assert float(found.qd[after, 1].abs().max()) < 1e-12, "no rebound"
    assert torch.allclose(found.qd[:, 0], torch.tensor(0.5, dtype=torch.float64)), "no friction"
    assert float(found.c[after].abs().max()) < 1e-9
    assert torch.allclose(found.multiplier[after], torch.tensor(WEIGHT, dtype=torch.float64))


def test_a_jump_of_the_torque_opens_the_contact_at_its_sample(tmp_path) -> None:
    tau = torch.zeros(48, 2, dtype=torch.float64)
    tau[24:, 1] = 1.5 * WEIGHT
    found = rollout(
        ANALYTICAL, slider(tmp_path), state(0, 0), state(0, 0), tau, 0.2, options=unilateral(dt=1 / 240)
    )
    (event,) = found.events
    assert event.t == pytest.approx(24 / 240)
    assert int(found.active[:, 0].sum()) == 24


def test_members_of_a_batch_lose_contact_at_their_own_times(tmp_path) -> None:
    times = torch.tensor([0.05, 0.0777, 0.111, 9.0], dtype=torch.float64)[:, None]

    def pulls(t: torch.Tensor, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor:
        return torch.cat([torch.zeros_like(t), WEIGHT * t / times], dim=-1)

    start = torch.zeros(4, 2, dtype=torch.float64)
    found = rollout(ANALYTICAL, slider(tmp_path), start, start, pulls, 0.15, options=unilateral())
    opened = {event.row: event.t for event in found.events}
    assert sorted(opened) == [0, 1, 2]
    assert [opened[i] for i in range(3)] == pytest.approx(times[:3, 0].tolist(), abs=EVENT_TOLERANCE)


def test_a_resting_contact_with_baumgarte_stays_closed_after_landing(tmp_path) -> None:
    system = slider(tmp_path, Baumgarte(10.0, 1.0))
    nothing = torch.zeros(1, 2, dtype=torch.float64)
    found = rollout(ANALYTICAL, system, state(0, 0.01), state(0, -0.3), nothing, 0.5, options=unilateral())
    assert [event.closed for event in found.events] == [True]


def test_sliding_motions_lose_no_contact() -> None:
    data = simulated().data
    found = rollout(ANALYTICAL, arm(Baumgarte()), data.q[0], data.qd[0], data, 0.5, options=unilateral())
    assert found.events == ()
    bilateral = rollout(ANALYTICAL, arm(Baumgarte()), data.q[0], data.qd[0], data, 0.5)
    assert torch.equal(found.q, bilateral.q)


@pytest.mark.usefixtures("unchecked")
def test_a_law_without_forces_cannot_lose_contact() -> None:
    data = simulated().data
    law = AccelerationLaw(None)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="predicts only accelerations cannot detect"):
        rollout(law, arm(), data.q[0], data.qd[0], data, 0.1, options=unilateral())


def test_lift_off_of_the_arm_is_the_simulator_s() -> None:
    """Pulled off ever harder in open loop, within two steps of PyBullet's loss."""
    data = pulled_off()
    closed = data.contact["table"]
    lost = int((~closed).nonzero()[0, 0])
    assert 60 < lost < 140
    start = lost - 50
    found = rollout(
        ANALYTICAL,
        arm(Baumgarte()),
        data.q[start],
        data.qd[start],
        data[start:],
        0.25,
        options=unilateral(),
    )
    (event,) = found.events
    assert not event.closed
    assert abs(event.t * 240 - 50) <= 2.0
    assert float((found.q[:60] - data.q[start : start + 60]).abs().max()) < 1e-4


@pytest.mark.parametrize("name", ["sgp-mean", "sgp-contact"])
def test_lift_off_is_learned_from_sliding(name: str) -> None:
    """Learned with noise on another motion that never lifts off, the loss is where PyBullet has it."""
    data = pulled_off(viscous_friction=1.0)
    lost = int((~data.contact["table"]).nonzero()[0, 0])
    model = create(name, arm(Baumgarte()), noise=0.1)
    model = model.fit(sliding(), options=LearningOptions(max_evaluations=40))
    for before in (24, 60):
        start = lost - before
        found = model.rollout(
            data.q[start],
            data.qd[start],
            data[start:],
            (before + 12) / 240,
            active=torch.tensor([True]),
            options=unilateral(),
        )
        opened = [event.t * 240 for event in found.events if not event.closed]
        assert len(opened) == 1
        assert abs(opened[0] - before) <= 2.0
    rows = torch.arange(lost - 10, lost + 5)
    loss = contact_loss_probability(model, data.q[rows], data.qd[rows], data.tau[rows])[:, 0]
    assert bool((loss.diff() > -1e-9).all())
    assert float(loss[0]) < 0.001
    assert float(loss[-1]) > 0.999


@cache
def sliding() -> Dataset:
    """Sixty noisy points of a motion with friction."""
    run = simulate(arm(Baumgarte()), SimulationConfig(duration=5.0, seed=1)).data
    return run[select_points(run, 60)]
