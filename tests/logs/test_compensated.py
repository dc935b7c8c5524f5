"""Torques from which a driver has subtracted gravity or a model of the robot; Pinocchio is the oracle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import forcegp
from forcegp.errors import MappingError
from forcegp.logs import guess, import_log, parse_mapping
from forcegp.logs.compensated import Compensated, subtracted
from pinocchio_oracle import Oracle
from planted_faults import free_log
from robots import ARMS

UR5 = next(arm for arm in ARMS if arm.name == "ur5")
COMPENSATED: tuple[Compensated, ...] = ("gravity", "model")
DT = 1.0 / 240.0


def oracle_torque(how: str, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """The torque of Pinocchio's model that balances gravity, or that the motion needs."""
    pinocchio = Oracle(UR5, UR5.load())
    if how == "gravity":
        qd, qdd = np.zeros_like(qd), np.zeros_like(qdd)
    return np.array([pinocchio.inverse_dynamics(*row) for row in zip(q, qd, qdd, strict=True)])


def motion(seconds: float = 5.0) -> dict[str, np.ndarray]:
    """Columns of a UR5 in free motion with friction that its file lacks."""
    log = free_log(UR5.load(), seconds=seconds, noise=0.0)
    friction = (3.0 * np.tanh(log.qd / 0.02) + 2.0 * log.qd) * np.array([4.0, 4.0, 2.0, 1.0, 1.0, 1.0])
    noise = 0.02 * np.random.default_rng(0).standard_normal(log.q.shape)
    return {"q": log.q, "qd": log.qd, "qdd": log.qdd, "tau": log.tau + friction + noise}


def written(folder: Path, tau: np.ndarray, log: dict[str, np.ndarray]) -> Path:
    joints = range(tau.shape[1])
    names = ["t", *(f"{s}{j}" for s in ("position", "velocity", "effort") for j in joints)]
    table = np.column_stack([DT * np.arange(len(tau)), log["q"], log["qd"], tau])
    np.savetxt(folder / "log.csv", table, delimiter=",", header=",".join(names), comments="", fmt="%.12g")
    return folder / "log.csv"


def mapping(more: str = "") -> forcegp.logs.Mapping:
    joints = ", ".join(f'{name} = "{k}"' for k, name in enumerate(UR5.load().joint_names))
    text = f"""
    time = {{ column = "t" }}
    joints = {{ {joints} }}
    position = {{ column = "position{{joint}}", unit = "rad" }}
    velocity = {{ column = "velocity{{joint}}", unit = "rad/s" }}
    torque = {{ column = "effort{{joint}}", unit = "Nm"{more} }}
    """
    return parse_mapping(text.encode(), "mapping")


@pytest.mark.parametrize("how", COMPENSATED)
def test_what_a_driver_subtracts_is_that_of_pinocchio(how: Compensated) -> None:
    log = motion(0.2)
    states = log["q"], log["qd"], log["qdd"]
    ours, theirs = subtracted(UR5.load(), how, *states), oracle_torque(how, *states)
    assert np.abs(ours - theirs).max() < 1e-10 * np.abs(theirs).max()


@pytest.mark.parametrize("how", COMPENSATED)
def test_an_import_adds_what_the_driver_has_subtracted(how: Compensated, tmp_path: Path) -> None:
    log = motion()
    plain = import_log(written(tmp_path, log["tau"], log), UR5.load(), mapping()).data
    less = log["tau"] - oracle_torque(how, log["q"], log["qd"], log["qdd"])
    found = import_log(written(tmp_path, less, log), UR5.load(), mapping(f', compensated = "{how}"'))
    error = (found.data.tau - plain.tau).abs().max()
    # The filter smooths what is subtracted; accelerations come from filtered velocities.
    assert float(error) < (0.002 if how == "gravity" else 0.02) * float(plain.tau.abs().max())
    assert any("as the driver subtracts it" in step for step in found.report.steps)


def test_torques_that_are_not_measured_stay_zero(tmp_path: Path) -> None:
    log = motion(1.0)
    last = UR5.load().joint_names[-1]
    more = f', compensated = "gravity", unmeasured = ["{last}"]'
    data = import_log(written(tmp_path, log["tau"], log), UR5.load(), mapping(more)).data
    assert not data.tau[:, -1].any() and data.tau[:, 1].any()


def test_another_kind_of_compensation_is_refused() -> None:
    with pytest.raises(MappingError, match="compensated") as caught:
        mapping(', compensated = "friction"')
    assert "gravity" in str(caught.value) and "model" in str(caught.value)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("how", [None, *COMPENSATED])
def test_a_proposed_mapping_says_what_is_subtracted(
    how: Compensated | None, sign: float, tmp_path: Path
) -> None:
    """External torques, which a model of the robot leaves, often have the opposite sign."""
    log, robot = motion(), UR5.load()
    less = 0.0 if how is None else oracle_torque(how, log["q"], log["qd"], log["qdd"])
    path = written(tmp_path, sign * (log["tau"] - less), log)
    draft = guess.guess_mapping(path, forcegp.ConstrainedSystem(robot))
    torque = parse_mapping(draft.toml().encode(), "proposed mapping").sections.torque
    assert torque.compensated == how and torque.sign == sign
    assert how is None or any("seems to subtract" in doubt for doubt in draft.doubts)
    data = import_log(path, robot, parse_mapping(draft.toml().encode(), "proposed mapping")).data
    kinds = {finding.kind for finding in forcegp.check(forcegp.ConstrainedSystem(robot), data).findings}
    assert not {kind for kind in kinds if kind.startswith(("torque-without", "torque-sign"))}
