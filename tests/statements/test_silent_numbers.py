"""Forces on faulty logs of the wiping UR5: the bars hold, or the fit refuses.

Cases that are false today are expected to fail.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.dynamics import gravity_force, inverse_dynamics
from forcegp.errors import ForceGPError
from statements.wiping import CSV, HELD_OUT, Force, fitted, imported, log, normal_force, simulated, system

LEAST_COVERAGE = 0.8
"""Fraction of true forces within ±2σ, nominally 0.95; residuals of a log are correlated."""

Fault = Callable[[forcegp.Dataset], forcegp.Dataset]


def holds(train: forcegp.Dataset, test: forcegp.Dataset, truth: Tensor) -> bool:
    """Whether the error bars hold, or the fit or the prediction raises a typed error."""
    try:
        force = normal_force(fitted(train), test, truth)
    except ForceGPError:
        return True
    return force.coverage >= LEAST_COVERAGE


def gain(factor: float) -> Fault:
    """Torques of a sensor, or of a torque constant, that is wrong by a factor."""
    return lambda data: data.replace(tau=factor * data.tau)


def by_the_model(data: forcegp.Dataset) -> forcegp.Dataset:
    """Torques that the controller computes from the robot file, with a noise of 1 %."""
    tau = inverse_dynamics(system().robot, data.q, data.qd, data.qdd)
    noise = torch.randn(tau.shape, generator=torch.Generator().manual_seed(0), dtype=tau.dtype)
    return data.replace(tau=tau + 0.01 * tau.std(0) * noise)


def without_gravity(data: forcegp.Dataset) -> forcegp.Dataset:
    """Torques from which the controller subtracts those of gravity, and which are as noisy otherwise."""
    return data.replace(tau=data.tau + gravity_force(system().robot, data.q))


def stuck(data: forcegp.Dataset) -> forcegp.Dataset:
    """One torque that does not change for four seconds."""
    tau = data.tau.clone()
    tau[:1000, 1] = tau[0, 1]
    return data.replace(tau=tau)


def row(text: str, *values: object) -> object:
    """A case that is expected to fail, with the row of the list of silent numbers as its reason."""
    return pytest.param(*values, marks=pytest.mark.xfail(strict=True, reason=text), id=text.split(":")[0])


def parts() -> tuple[forcegp.Dataset, forcegp.Dataset, Tensor]:
    """Training rows, held-out rows and their true force."""
    data, cell = log()
    return data[: HELD_OUT.start : 3], data[HELD_OUT], cell[HELD_OUT]


def test_the_bars_hold_on_the_log_without_a_fault() -> None:
    """The measure of this file: it holds where nothing is wrong."""
    train, test, truth = parts()
    force: Force = normal_force(fitted(train), test, truth)
    assert force.coverage >= LEAST_COVERAGE and force.rmse < 2.0


@pytest.mark.parametrize(
    "fault",
    [
        row("torques × 1.3: 35.1 N for 26.8 N, σ 1.8, ±2σ holds 1 %", gain(1.3)),
        row("torques × 0.9: 24.4 N for 26.8 N, σ 1.0, ±2σ holds 25 %", gain(0.9)),
        row("torques × 0.5: 14.3 N for 26.8 N, σ 0.8, ±2σ holds 0 %", gain(0.5)),
        pytest.param(by_the_model, id="torques of the controller's model"),
    ],
)
def test_bars_hold_or_the_fit_refuses_wrong_torques(fault: Fault) -> None:
    train, test, truth = parts()
    assert holds(fault(train), fault(test), truth)


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.0, 1.3])
def test_check_names_the_gain_of_all_torques(factor: float) -> None:
    """`check` states the correction 1/factor, although an offset of one joint explains part of it."""
    data = log()[0]
    found = [f for f in forcegp.check(system(), gain(factor)(data)).findings if "torque-gain" in f.kinds]
    if factor == 1.0:
        assert not found
    elif factor == 0.5:  # joint by joint, as the friction of the file differs
        assert found
    else:
        (finding,) = found
        assert finding.kind == "torque-gain" and "all torques" in finding.message
        assert float(finding.evidence["factor"]) == pytest.approx(1.0 / factor, abs=0.05)
        assert {"torque-offset"} <= set(finding.kinds)


@pytest.mark.parametrize(
    ("name", "lost", "kind", "text"),
    [
        ("half", lambda k: k % 2 == 1, "time-scale", "one of 2 rows"),
        ("third", lambda k: k % 3 > 0, "time-scale", "one of 3 rows"),
        ("bursts of 8", lambda k: k in {*range(1000, 1008), *range(2200, 2208)}, "time-gap", "in 2 rows"),
        ("none", lambda _: False, "", ""),
    ],
)
def test_rows_that_are_lost_and_renumbered_are_named(
    name: str, lost: Callable[[int], bool], kind: str, text: str, tmp_path: Path
) -> None:
    heading, *rows = CSV.read_text(encoding="utf-8").splitlines()
    stamps, kept = [row.split(",", 1)[0] for row in rows], [x for k, x in enumerate(rows) if not lost(k)]
    renumbered = (f"{t},{row.split(',', 1)[1]}" for t, row in zip(stamps, kept, strict=False))
    path = tmp_path / "log.csv"
    path.write_text("\n".join([heading, *renumbered]) + "\n", encoding="utf-8")
    findings = forcegp.check(system(), imported(path)[0]).findings
    named = {f.kind: f.message for f in findings if f.kind in ("time-scale", "time-gap", "rows-lost")}
    assert text in named.get(kind, "") if kind else not named, (name, named)


def test_bars_hold_while_a_torque_is_stuck() -> None:
    train, test, truth = parts()
    assert holds(train, stuck(test), truth)


@pytest.mark.xfail(reason="torques without gravity: ±2σ holds 89.4 % (required: 90 %), bias 0.99 N")
def test_gravity_that_is_missing_from_the_torques_is_no_force() -> None:
    train, test, truth = (*(without_gravity(each) for each in parts()[:2]), parts()[2])
    force = normal_force(fitted(train), test, truth)
    assert force.coverage >= 0.9 and abs(float((force.mean - force.truth).mean())) < 1.0


@pytest.mark.slow
@pytest.mark.xfail(
    strict=True, reason="2 kg picked up after training: 8.5 N for 28.0 N, σ 0.6, ±2σ holds 0 %"
)
def test_bars_hold_for_a_payload_that_is_picked_up_after_training() -> None:
    """The free motion of the new log shows the payload."""
    assert holds(simulated(0.0, 1)[0][::3], *simulated(2.0, 2))


@pytest.mark.slow
def test_evaluate_names_a_payload_that_is_picked_up_after_training() -> None:
    """2 kg in free motion of the new log, and none where nothing was picked up."""
    fit = fitted(simulated(0.0, 1)[0][::3])
    same, loaded = (forcegp.evaluate(fit, simulated(mass, 2)[0][::3]) for mass in (0.0, 2.0))
    assert same.payload is None and not any("payload" in doubt for doubt in same.doubts)
    assert loaded.payload is not None and loaded.poor
    assert abs(loaded.payload.mass - 2.0) < 2.0 * loaded.payload.std < 1.0
    assert any("the payload changed" in doubt for doubt in loaded.doubts)


@pytest.mark.slow
@pytest.mark.xfail(reason="2 kg missing and never lifted: −13.8 ± 9.1 N, ±2σ holds 76 % (required: 80 %)")
def test_bars_hold_for_a_missing_payload_that_is_never_lifted() -> None:
    """Without free motion, the prior of the masses must be wide enough for a payload."""
    assert holds(simulated(2.0, 1, 0.0)[0][::3], *simulated(2.0, 2, 0.0))


def test_a_fit_of_another_robot_is_no_start() -> None:
    train = parts()[0][::8]
    other = system().robot.replace(mass=1.5 * system().robot.mass)
    first = forcegp.StructuredGP(system().with_robot(other), "analytical").fit(train)
    with pytest.raises(ForceGPError, match="robot"):
        forcegp.StructuredGP(system(), "analytical").fit(train, after=first)
