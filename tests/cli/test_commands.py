"""The command line as a user meets it: files in, files out, one message where something is wrong."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

import forcegp
from forcegp.cli import app, main
from forcegp.cli.common import rounded
from forcegp.cli.fit import _listed
from forcegp.data import Dataset
from forcegp.models.robot_parameters import RobotParameter
from logs import JOINTS, random_log
from planted_faults import free_log

COMMANDS = ("simulate", "select", "fit", "predict", "evaluate", "rollout", "import")


def run(*arguments: object) -> str:
    """Output of a command that succeeds."""
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.stdout


Fail = Callable[..., str]


@pytest.fixture
def fail(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Fail:
    """Runs a command that is to fail, and gives its message."""

    def run_and_fail(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["forcegp", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capfd.readouterr()
        assert ended.value.code == 2
        assert out == ""
        return err

    return run_and_fail


@pytest.fixture
def log(tmp_path: Path) -> Path:
    random_log(480).write(tmp_path / "run.parquet")
    return tmp_path / "run.parquet"


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_examples(command: str) -> None:
    text = run(command, "--help")
    assert "Examples" in text and f"forcegp {command}" in text


@pytest.mark.parametrize("command", ["check", "excite", "export", "sweep", "view", *COMMANDS])
def test_help_fills_the_lines_of_a_narrow_terminal(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    prose = run(command, "--help").partition("\u256d")[0].splitlines()
    for line, following in pairwise(prose):
        first = following.split()[0] if line.strip() and following.strip() else " " * 80
        assert len(line.rstrip()) + 1 + len(first) > 79, line


def test_help_keeps_brackets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert "predicted_<quantity> and" in run("predict", "--help") and "[m]" in run("excite", "--help")


def test_version() -> None:
    assert run("--version").startswith("forcegp 0.")
    module = subprocess.run([sys.executable, "-m", "forcegp", "--version"], capture_output=True, text=True)
    assert module.stdout == run("--version")


def test_select_writes_both_parts_and_their_provenance(log: Path, tmp_path: Path) -> None:
    train, rest = tmp_path / "train.parquet", tmp_path / "rest.parquet"
    result = json.loads(run("select", log, "-n", 50, "--out", train, "--rest", rest, "--json"))
    assert result == {
        "training_points": 50,
        "training_file": str(train),
        "test_points": 430,
        "test_file": str(rest),
    }
    chosen, kept = Dataset.read(train), Dataset.read(rest)
    assert not chosen.header.ordered and kept.header.ordered
    assert "selected 50 training points of 480 rows by farthest points" in chosen.header.provenance[-1]
    assert torch.equal(torch.cat([chosen.t, kept.t]).sort().values, Dataset.read(log).t)
    again = tmp_path / "again.parquet"
    run("select", log, "-n", 10, "--out", again)
    assert torch.equal(Dataset.read(again).q, chosen.q[:10])


def test_select_says_that_random_rows_have_no_order(log: Path, tmp_path: Path) -> None:
    for method in ("random", "even"):
        result = json.loads(
            run("select", log, "-n", 50, "--method", method, "-o", tmp_path / "a.parquet", "--json")
        )
        assert ("--method even" in result.get("note", "")) == (method == "random")


def test_select_holds_out_stretches(log: Path, tmp_path: Path) -> None:
    train, rest = tmp_path / "train.parquet", tmp_path / "rest.parquet"
    options = ("--split", "stretches", "--stretch", 0.2, "--seed", 4, "--json")
    result = json.loads(run("select", log, "-n", 50, "-o", train, "--rest", rest, *options))
    assert len(result["held_out_rows"]) == 2
    assert result["test_points"] == sum(b - a for a, b in result["held_out_rows"])
    held = set(Dataset.read(rest).t.tolist())
    assert not held & set(Dataset.read(train).t.tolist())
    # A block is a trajectory, which a rollout can follow; adjacent blocks are one.
    steps, segment = Dataset.read(rest).t.diff(), Dataset.read(rest).segment
    assert torch.equal(segment.diff() > 0, steps > 1.5 * steps.median())
    (first, last), (second, _) = result["held_out_rows"]
    assert first < last < second and int(segment[last - first - 1]) == 0 and int(segment[-1]) == 1


def rename(log: Path, old: str, new: str) -> None:
    import pyarrow.parquet as pq

    table = pq.read_table(log)
    pq.write_table(table.rename_columns([new if c == old else c for c in table.column_names]), log)


def test_a_wrong_joint_name_is_one_message(fail: Fail, log: Path, tmp_path: Path) -> None:
    rename(log, "tau.elbow", "tau.elbwo")
    message = fail("select", log, "-n", 5, "-o", tmp_path / "out.parquet")
    assert message.startswith(f"error: {log}: column 'tau.elbow' is missing\n")
    assert "hint: did you mean column 'tau.elbwo'?" in message
    assert not (tmp_path / "out.parquet").exists()


def test_a_nan_is_one_message(fail: Fail, log: Path, tmp_path: Path) -> None:
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(log)
    values = np.zeros(480)
    values[17] = np.nan
    pq.write_table(table.set_column(table.column_names.index("qd.wrist"), "qd.wrist", pa.array(values)), log)
    message = fail("select", log, "-n", 5, "-o", tmp_path / "out.parquet")
    assert "column 'qd.wrist' holds nan in row 17" in message and str(log) in message


def test_a_log_of_another_robot_is_one_message(fail: Fail, log: Path, tmp_path: Path) -> None:
    message = fail("fit", "--scene", "kuka_plane", "--data", log, "--out", tmp_path / "model")
    assert "joint 'lbr_iiwa_joint_1' of robot 'kuka_iiwa' is not in the data" in message
    assert ", ".join(JOINTS) in message


@pytest.mark.parametrize("content", ["<robot", "not xml at all", ""])
def test_an_unreadable_robot_file_is_one_message(fail: Fail, tmp_path: Path, content: str) -> None:
    (tmp_path / "arm.urdf").write_text(content)
    (tmp_path / "scene.toml").write_text('[robot]\nmodel = "arm.urdf"\n')
    message = fail("simulate", "--scene", tmp_path / "scene.toml", "--out", tmp_path / "run.parquet")
    assert message.startswith(f"error: {tmp_path / 'scene.toml'}:1: robot: ")
    assert "arm.urdf" in message


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("select", "missing.parquet", "-n", "5", "-o", "out.parquet"), "missing.parquet: no such file"),
        (("simulate", "--scene", "kuka_plain", "--out", "run.parquet"), "did you mean 'kuka_plane'?"),
        (("select", "missing.parquet"), "Missing option"),
        (("selekt",), "No such command"),
    ],
)
def test_what_is_not_there_is_one_message(
    fail: Fail, arguments: tuple[str, ...], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert expected in fail(*arguments)


def test_a_place_that_cannot_be_written_is_one_message(fail: Fail, log: Path) -> None:
    message = fail("select", log, "-n", 5, "-o", f"{log}/out.parquet")
    assert message.startswith("error: ") and "run.parquet" in message


def test_the_program_ends_without_a_traceback(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from forcegp.cli import main; main()", "simulate", "-s", "kuka_plain"]
    done = subprocess.run([*command, "-o", str(tmp_path / "x.parquet")], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: kuka_plain: no such scene") and "Traceback" not in done.stderr


@pytest.mark.slow
def test_from_simulation_to_evaluation(fail: Fail, tmp_path: Path) -> None:
    log, train, test = (tmp_path / f"{name}.parquet" for name in ("run", "train", "test"))
    figures = json.loads(
        run("simulate", "-s", "kuka_plane", "--duration", 1.0, "--seed", 3, "--out", log, "--json")
    )
    assert figures["samples"] == 240 and figures["file"] == str(log)
    data = Dataset.read(log)
    assert len(data) == 240 and data.header.seed == 3 and data.header.noise_std == 0.1
    run("select", log, "-n", 20, "-o", train, "--rest", test)

    model = tmp_path / "model"
    fitted = json.loads(run("fit", "-s", "kuka_plane", "-d", train, "-m", "sgp-mean", "-o", model, "--json"))
    assert fitted["model"] == "sgp-mean" and fitted["training_points"] == 20
    for quantity, width in (("qdd", 7), ("multiplier", None)):
        predicted = tmp_path / f"{quantity}.parquet"
        run("predict", "-m", model, "-d", test, "-q", quantity, "-o", predicted)
        values = getattr(Dataset.read(predicted), f"predicted_{quantity}")
        std = getattr(Dataset.read(predicted), f"predicted_{quantity}_std")
        if width is None:
            values, std = values["table"], std["table"]
        assert values.shape == ((220, width) if width else (220,))
        assert bool((std > 0.0).all())
        run("predict", "-m", model, "-d", test, "-q", quantity, "-o", predicted, "--no-noise")
        quiet = getattr(Dataset.read(predicted), f"predicted_{quantity}_std")
        # Noise of accelerations is known; that of a force sensor is not, and the torque has none here.
        assert torch.equal(std, quiet["table"]) if width is None else bool((std > quiet).all())
    figures = json.loads(run("evaluate", "-m", model, "-d", test, "-o", tmp_path / "figures", "--json"))
    # Mean error over noise of 0.1; the analytical mean alone knows the motion up to the contact's friction.
    assert 0.05 < figures["noisy_mae"] < 0.3
    assert json.loads(Path(figures["file"]).read_text())["samples"] == 220

    motion = tmp_path / "motion"
    path = json.loads(
        run("rollout", "-m", model, "-d", log, "-o", motion, "--start", 24, "--duration", 0.25, "--json")
    )
    assert "an input of this command" in fail("rollout", "-m", model, "-d", log, "-o", tmp_path)
    # Open loop for a quarter of a second, with a model that knows all but the friction at the contact.
    assert path["duration_s"] == pytest.approx(0.25) and path["largest_joint_error"] < 0.01
    assert path["largest_constraint_error_m"] < 1e-3
    rolled = Dataset.read(path["file"])
    assert torch.equal(rolled.q_logged, data.q[24:85]) and torch.equal(rolled.q[0], data.q[24])
    assert "in time order" in fail("rollout", "-m", model, "-d", train, "-o", motion)
    assert "constant sampling period" in fail("rollout", "-m", model, "-d", test, "-o", motion)

    assert "did you mean 'multiplier'?" in fail(
        "predict", "-m", model, "-d", test, "-q", "multiplyer", "-o", log
    )
    assert "did you mean 'sgp-mean'?" in fail(
        "fit", "-s", "kuka_plane", "-d", train, "-m", "sgp-men", "-o", model
    )
    assert "is not a saved model" in fail("evaluate", "-m", tmp_path, "-d", test)


def test_fit_prints_what_an_engineer_reads_and_the_rest_on_request(tmp_path: Path) -> None:
    """Friction, drives and noise of each joint; JSON has the same numbers and those of the computation."""
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    free = free_log(system.robot, seconds=10.0)
    columns = {name: torch.from_numpy(getattr(free, name)) for name in ("t", "q", "qd", "qdd")}
    tau = torch.from_numpy(free.tau) + 0.5 * torch.tanh(columns["qd"] / 0.02) + 0.1 * columns["qd"]
    joints, header = system.robot.joint_names, free.header
    data = Dataset(**columns, tau=tau, joint_names=joints, header=header)
    data.write(tmp_path / "log.parquet")
    arguments = ["fit", "--robot", "double_pendulum", "--data", tmp_path / "log.parquet"]
    text = run(*arguments, "--out", tmp_path / "text")
    for internal in ("jitter", "objective", "evidence", "nats", "force_correlation"):
        assert internal not in text and internal not in text.replace(" ", "_")
    assert len(text.splitlines()) <= 10
    assert "held-out torque error" in text and "open loop: off by" in text and "undetermined" in text
    found = json.loads(run(*arguments, "--out", tmp_path / "json", "--json"))
    assert found["jitter"] == 0.0 and found["seconds"] > 0.0
    shown = {joint: list[str]() for joint in joints}
    for name, joint in ((name, joint) for name in ("slow friction", "fast friction") for joint in joints):
        (one,) = (p for p in found["robot_parameters"] if (p["name"], p["of"]) == (name, joint))
        assert abs(one["value"] - 0.5 - 0.1 * one["speed"]) < 4.0 * one["std"] + 0.02
        std = max(
            p["std"] for p in found["robot_parameters"] if p["of"] == joint and p["name"].endswith("friction")
        )
        shown[joint].append(rounded(one["value"], std).split(" ± ")[0])
    for words in shown.values():
        assert " ".join(words) in " ".join(text.split())
    verbose = run(*arguments, "--out", tmp_path / "verbose", "--verbose")
    for one in (p for p in found["robot_parameters"] if p["name"].endswith("friction")):
        assert f"{rounded(one['value'], one['std'])} at {one['speed']:.2g}" in verbose
    assert "jitter" in verbose and f"joint_friction of {joints[0]}" in verbose


def test_a_friction_that_only_a_prior_states_is_not_printed() -> None:
    """Standard deviations that are those of the prior, in the table and in the lists."""
    known = RobotParameter("drive inertia", "a", 0.3, 0.04, "kg m²", True)
    unknown = RobotParameter("drive inertia", "b", 0.4, 0.2, "kg m²", False)
    assert _listed([known, unknown], {"a": "joint 1"}) == ("drive inertia [kg m²] joint 1 0.30 ± 0.04", "b")
    assert _listed([unknown], {}) == ("", "all")
    assert _listed([RobotParameter("link mass·x", "a", 0.01, 0.01, "kg m", True)], {}) == ("", "")
    many = [RobotParameter("torque offset", str(k), 1.0 + k, 0.1, "N m", True) for k in range(6)]
    assert _listed(many, {})[0] == "torque offset [N m] 5 6.00 ± 0.10, 4 5.00 ± 0.10, 3 4.00 ± 0.10, 3 more"
