"""Published logs of each kind from its files to a check and a fit, as a newcomer would: one command each."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from forcegp.cli import app
from forcegp.data import Dataset
from log_files import REAL, real_logs
from robots import example_data
from slow import slow_except

UR = example_data() / "ur_description/urdf"
IIWA = REAL / "kuka_iiwa14"
PENDULUM = REAL / "double_pendulum/design_C.1"
LOGS = {
    "iiwa": (IIWA / "motion_a", IIWA / "iiwa14.urdf", "iiwa14_txt"),
    **{
        f"pendulum {run}": (
            PENDULUM / f"20230629-{run}.csv",
            PENDULUM / "model_1.1.urdf",
            "double_pendulum_csv",
        )
        for run in (143339, 143704)
    },
    "ur3 bag": (REAL / "ur3/id1.bag", UR / "ur3_robot.urdf", "ur3_bag"),
    "ur3 mat": (REAL / "ur3/id2.mat", UR / "ur3_robot.urdf", "ur3_mat"),
    "ur10": (REAL / "ros2/ur10_exciting_trajectory.db3", UR / "ur10_robot.urdf", None),
}


def run(*arguments: object) -> str:
    """Standard output of a command that succeeds."""
    done = CliRunner().invoke(app, [*map(str, arguments)])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.stdout


@real_logs
@pytest.mark.parametrize("name", slow_except(LOGS, "pendulum 143339"))
def test_a_published_log_is_imported_and_stops_at_no_check(name: str, tmp_path: Path) -> None:
    log, robot, mapping = LOGS[name]
    out = tmp_path / "log.parquet"
    told = run("import", log, "--robot", robot, *(["-m", mapping] if mapping else []), "-o", out)
    assert "logged" in told and str(out) in told
    found = json.loads(run("check", "--robot", robot, "--data", out, "--json"))
    kinds = {finding["kind"] for finding in found["findings"] if finding["severity"] != "note"}
    # None of these is true of any of the logs: signs, orders and units are those of the mappings.
    assert not kinds & {"degrees", "torque-sign", "joint-sign", "torque-order", "joint-order", "time-unit"}
    assert not kinds & {"noise-filtered", "noise-overstated", "torque-delay"} and not found["skipped"]
    assert Dataset.read(out).header.filtered == (not name.startswith("iiwa"))


@real_logs
@pytest.mark.slow
def test_a_published_log_is_fitted_by_a_command(tmp_path: Path) -> None:
    log, robot, mapping = LOGS["pendulum 143704"]
    out = tmp_path / "log.parquet"
    run("import", log, "--robot", robot, "-m", mapping, "-o", out)
    told = run("fit", "--robot", robot, "-d", out, "-o", tmp_path / "model")
    # What the fit warns of is printed once, and no list as Python writes it.
    assert (
        "('" not in told
        and "friction [N m], slow and fast motion" in told
        and (tmp_path / "model.safetensors").is_file()
    )
