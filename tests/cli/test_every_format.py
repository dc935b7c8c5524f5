"""From a log in each format to the verdict of a check and a fitted model, by commands alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import forcegp
from forcegp import dynamics
from forcegp.cli import app
from forcegp.data import Dataset
from log_files import WRITERS, Motion
from slow import slow_except

FREQUENCY, AMPLITUDE = np.array([[2.0, 3.0], [4.1, 1.3]]), np.array([[0.8, 0.9], [0.3, 0.5]])
NOISE = 0.02
"""Of the torque [N m]."""


def driven_motion(n: int = 400, dt: float = 0.01) -> Motion:
    """The double pendulum on sums of sines, with the torque that this takes."""
    robot, t = forcegp.load_robot("double_pendulum"), np.arange(n) * dt
    phase = t[:, None, None] * FREQUENCY + np.array([0.3, 1.1])
    q, qd, qdd = (
        (AMPLITUDE * wave).sum(axis=1)
        for wave in (np.sin(phase), FREQUENCY * np.cos(phase), -(FREQUENCY**2) * np.sin(phase))
    )
    state = [torch.from_numpy(x) for x in (q, qd, qdd)]
    tau = dynamics.inverse_dynamics(robot, *state) - dynamics.damping_force(robot, state[1])
    return Motion(t, q, qd, tau.numpy() + NOISE * np.random.default_rng(0).normal(size=q.shape))


def write_foreign_csv(folder: Path, m: Motion) -> tuple[Path, str]:
    """Degrees, milliseconds, a decimal comma, and headings in German."""
    head = "Zeit_ms;Winkel1 [deg];Winkel2 [deg];Drehzahl1 [deg/s];Drehzahl2 [deg/s];Drehmoment1;Drehmoment2"
    columns = [1e3 * m.t, *np.degrees(m.q).T, *np.degrees(m.qd).T, *m.tau.T]
    rows = [";".join(repr(float(x)).replace(".", ",") for x in row) for row in zip(*columns, strict=True)]
    (folder / "run.csv").write_text("\n".join([head, *rows]), encoding="utf-8")
    return folder / "run.csv", ""


def write_columns(folder: Path, m: Motion) -> tuple[Path, str]:
    """Text columns without headings, as `numpy.savetxt` writes them."""
    np.savetxt(folder / "run.dat", np.column_stack([m.t, m.q, m.qd, m.tau]))
    return folder / "run.dat", ""


def write_array(folder: Path, m: Motion) -> tuple[Path, str]:
    """One NumPy array."""
    np.save(folder / "run.npy", np.column_stack([m.t, m.q, m.qd, m.tau]))
    return folder / "run.npy", ""


FORMATS = WRITERS | {"foreign csv": write_foreign_csv, "columns": write_columns, "array": write_array}


def run(*arguments: object) -> str:
    """Output of a command that succeeds."""
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.stdout


@pytest.mark.parametrize("kind", slow_except(FORMATS, "mcap"))
def test_a_log_becomes_a_model(kind: str, tmp_path: Path) -> None:
    """The guessed mapping is right as it stands, so that confirming it is all that is left to the user."""
    m = driven_motion()
    log, _ = FORMATS[kind](tmp_path, m)
    mapping, data, scene = (tmp_path / name for name in ("mapping.toml", "log.parquet", "scene.toml"))
    scene.write_text('[robot]\nmodel = "double_pendulum"\n')
    run("import", log, "--scene", scene, "--guess", mapping)
    lines = mapping.read_text(encoding="utf-8").splitlines()
    mapping.write_text("\n".join(x for x in lines if not x.startswith("# CHECK")), encoding="utf-8")
    run("import", log, "--scene", scene, "--mapping", mapping, "--out", data)
    read = Dataset.read(data)
    # Degrees cost one multiplication and one division; the last digits of text are kept.
    for name in ("q", "qd"):
        np.testing.assert_allclose(getattr(read, name).numpy(), getattr(m, name), rtol=0.0, atol=1e-13)
    said = json.loads(run("check", "--scene", scene, "--data", data, "--json"))
    # Accelerations come from a filter, which the check notes; nothing else is wrong with the log.
    assert said["usable"], said["findings"]
    assert {f["kind"] for f in said["findings"] if f["severity"] != "note"} <= {"noise-filtered"}
    run("fit", "--scene", scene, "--data", data, "--model", "analytical", "--out", tmp_path / "model")
    fitted = forcegp.load_model(tmp_path / "model")
    mean = fitted.predict(read.q, read.qd, read.tau, quantity="qdd").mean
    assert float((mean - read.qdd).abs().median()) < 0.1 * float(read.qdd.abs().median())
