"""From a CSV in degrees and milliseconds to a contact force by commands alone, against MuJoCo's force."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from benchmarks.foreign_log import mapping_of, rows_of, write_foreign_log
from forcegp.cli import app
from forcegp.data import Dataset
from forcegp.scene import load_scene
from forcegp.simulate import simulate

pytest.importorskip("mujoco")

MODEL = """
[model]
name = "sgp"
sensor_noise_std = 0.5
[model.learning]
max_evaluations = 40
"""


def run(*arguments: object) -> str:
    """Output of a command that succeeds."""
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.stdout


@pytest.mark.slow
def test_the_force_of_a_wiping_robot_by_commands_alone(tmp_path: Path) -> None:
    scene = load_scene("ur5_wiping")
    system = scene.system()
    truth = simulate(system, replace(scene.simulation, duration=14.4, lift_probability=0.0)).data
    csv, mapping, config = tmp_path / "run.csv", tmp_path / "mapping.toml", tmp_path / "model.toml"
    write_foreign_log(csv, truth, system)
    mapping.write_text(mapping_of(system, "wrench").replace('"wrench"', '"always"'))
    config.write_text(MODEL)
    log, train, rest = (tmp_path / f"{name}.parquet" for name in ("log", "train", "rest"))

    run("import", csv, "--scene", "ur5_wiping", "--mapping", mapping, "--out", log)
    said = json.loads(run("check", "--scene", "ur5_wiping", "--data", log, "--json"))
    assert said["usable"]
    assert "friction-undeclared" in {finding["kind"] for finding in said["findings"]}
    run("select", log, "-n", 100, "--split", "stretches", "--out", train, "--rest", rest)
    fit = ("fit", "--scene", "ur5_wiping", "--data", train)
    run(*fit, "--config", config, "--out", tmp_path / "model")
    # Derivatives of exact angles have a noise of 1e-6 rad/s², which is rounding beside any joint force.
    run(*fit, "--model", "sgp-mean-se", "--noise-std", 0.1, "--out", tmp_path / "plain")

    test = Dataset.read(rest)
    rows = rows_of(Dataset.read(log), truth)[torch.searchsorted(Dataset.read(log).t, test.t)]
    force = truth.contact_extras["multiplier"]["table"][rows]
    error = {}
    for name in ("model", "plain"):
        out = tmp_path / f"{name}.parquet"
        run("predict", "--model", tmp_path / name, "--data", rest, "-q", "multiplier", "--out", out)
        error[name] = Dataset.read(out).contact_extras["predicted_multiplier"]["table"] - force
    # The robot file does not declare the friction of the joints, which biases the force by several newtons;
    # the model for measured robots learns it.
    assert float(error["model"].mean().abs()) < 1.5
    assert float(error["model"].abs().median()) < 0.5 * float(error["plain"].abs().median())
