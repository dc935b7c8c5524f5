"""`forcegp evaluate` on the log that a model with identified inertia was fitted to."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from typer.testing import CliRunner

import forcegp
from forcegp.cli import app
from forcegp.data import RobotMismatchWarning
from forcegp.data.selection import outliers
from logs import random_log


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, forcegp.Dataset]:
    """The file of a fitted model, and a log of its robot."""
    folder = tmp_path_factory.mktemp("arm")
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    log = random_log(200, joints=system.robot.joint_names)
    forcegp.StructuredGP(system, "analytical", noise=0.1).fit(log[::4]).save(folder / "model")
    return folder / "model", log


def evaluated(model: Path, log: forcegp.Dataset, folder: Path) -> dict[str, Any]:
    """The scores in JSON, on stdout and in the file, without NaN or infinity."""
    log.write(folder / "log.parquet")
    words = [
        "evaluate",
        "-m",
        str(model),
        "-d",
        str(folder / "log.parquet"),
        "-o",
        str(folder / "page"),
        "--json",
    ]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, (done.output, done.exception)
    for text in (done.stdout, (folder / "page" / "evaluation.json").read_text()):
        json.loads(text, parse_constant=pytest.fail)
    return json.loads(done.stdout)


@pytest.mark.parametrize("size", [1e4, -1e18])
def test_an_impossible_acceleration_is_left_out_and_named(
    size: float, arm: tuple[Path, forcegp.Dataset], tmp_path: Path
) -> None:
    model, log = arm
    qdd = log.qdd.clone()
    qdd[37, 1] = size
    found = evaluated(model, log.replace(qdd=qdd), tmp_path)
    assert found["left_out"] == [37] and any("Row 37: left out" in text for text in found["doubts"])
    rest = evaluated(model, log[[k for k in range(200) if k != 37]], tmp_path)
    assert found["noisy_rmse"] == pytest.approx(rest["noisy_rmse"]) and rest["left_out"] == []


@pytest.mark.parametrize(("name", "size"), [("q", 1e6), ("qd", -1e8), ("tau", 1e18), ("tau", -1e6)])
def test_any_impossible_value_is_left_out_and_named(
    name: str, size: float, arm: tuple[Path, forcegp.Dataset], tmp_path: Path
) -> None:
    model, log = arm
    values = getattr(log, name).clone()
    values[37, 1] = size
    found = evaluated(model, log.replace(**{name: values}), tmp_path)
    assert found["left_out"] == [37] and any("Row 37: left out" in text for text in found["doubts"])


@pytest.mark.parametrize("rows", [1, 2, 9])
@pytest.mark.parametrize("size", [None, 1e18])
def test_few_rows_are_scored_and_compared_with_nothing(
    rows: int, size: float | None, arm: tuple[Path, forcegp.Dataset], tmp_path: Path
) -> None:
    model, log = arm
    qdd = log.qdd.clone()
    if size is not None:
        qdd[0] = size
    found = evaluated(model, log.replace(qdd=qdd)[:rows], tmp_path)
    assert found["verdict"] == "too few samples" and found["noisy_rmse"] >= 0.0


def test_accelerations_of_a_collision_are_kept() -> None:
    qdd = torch.full((500, 3), 1e-3, dtype=torch.float64)
    qdd[200, 1] = -900.0
    assert not bool(outliers(qdd).any())
    qdd[:, 1] = 50.0
    qdd[200, 1] = 4000.0
    assert not bool(outliers(qdd).any())
    qdd[[3, 5], 2] = torch.tensor([1e4, 1e18], dtype=qdd.dtype)
    assert outliers(qdd).nonzero()[:, 0].tolist() == [3, 5]


def test_a_learned_robot_is_no_other_robot(tmp_path: Path) -> None:
    """The log is of the robot that was specified, whatever inertia the fit has found."""
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    header = {"robot": system.robot.name, "robot_fingerprint": system.robot.fingerprint}
    log = random_log(400, joints=system.robot.joint_names)
    log = log.replace(header=log.header.model_copy(update=header))
    log.write(tmp_path / "log.parquet")
    fit = forcegp.AnalyticalModel(system).fit(log)
    assert fit.system.robot.fingerprint != system.robot.fingerprint
    fit.save(tmp_path / "model")
    with warnings.catch_warnings():
        warnings.simplefilter("error", RobotMismatchWarning)
        arguments = ["--model", str(tmp_path / "model"), "--data", str(tmp_path / "log.parquet"), "--json"]
        done = CliRunner().invoke(app, ["evaluate", *arguments])
    assert done.exit_code == 0, (done.output, done.exception)
    found = json.loads(done.stdout)
    assert found["verdict"].startswith("The model explains") and "is" in found["comparison"]
