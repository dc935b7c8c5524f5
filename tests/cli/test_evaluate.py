"""`forcegp evaluate` on the log that a model with identified inertia was fitted to."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

from typer.testing import CliRunner

import forcegp
from forcegp.cli import app
from forcegp.data import RobotMismatchWarning
from logs import random_log


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
