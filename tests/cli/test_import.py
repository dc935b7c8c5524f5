"""`forcegp import` as a user meets it: from a foreign log to a data set, by two commands."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from forcegp.cli import app, main
from forcegp.data import Dataset
from log_files import WRITERS, motion


def run(*arguments: object) -> str:
    """Output of a command that succeeds."""
    done = CliRunner().invoke(app, ["import", *map(str, arguments)])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.stdout


def fail(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Message of a command that fails."""
    monkeypatch.setattr(sys, "argv", ["forcegp", "import", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    out, err = capfd.readouterr()
    assert ended.value.code == 2 and out == ""
    return err


def test_a_log_in_degrees_and_milliseconds_by_two_commands(tmp_path: Path) -> None:
    m = motion()
    columns = [1e3 * m.t, *np.degrees(m.q).T, *np.degrees(m.qd).T, *m.tau.T]
    head = "stamp_ms;angle1 [deg];angle2 [deg];speed1;speed2;torque1;torque2"
    rows = [";".join(repr(float(x)).replace(".", ",") for x in row) for row in zip(*columns, strict=True)]
    log, mapping, out = tmp_path / "run.csv", tmp_path / "mapping.toml", tmp_path / "log.parquet"
    log.write_text("\n".join([head, *rows]))
    told = run(log, "--robot", "double_pendulum", "--guess", mapping)
    assert "doubt 1" in told and "--mapping" in told and not out.exists()
    told = run(log, "--robot", "double_pendulum", "--mapping", mapping, "--out", out)
    assert "300 from 300 logged" in told and "segments" in told and "Savitzky-Golay" in told
    data = Dataset.read(out)
    # One multiplication and one division by a factor.
    np.testing.assert_allclose(data.q.numpy(), m.q, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(data.qd.numpy(), m.qd, rtol=0.0, atol=1e-14)


def test_columns_that_are_not_recognised_are_left_to_fill_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    m = motion()
    rows = [",".join(map(repr, row)) for row in np.column_stack([m.t, m.q, m.tau]).tolist()]
    log, mapping, out = tmp_path / "run.csv", tmp_path / "m.toml", tmp_path / "log.parquet"
    log.write_text("\n".join(["t,foo,bar,tau1,tau2", *rows]))
    told = run(log, "--robot", "double_pendulum", "--guess", mapping)
    assert "unused columns: foo, bar" in told and f"fill in [position] in {mapping}" in told
    said = fail(monkeypatch, capfd, log, "--robot", "double_pendulum", "--mapping", mapping, "--out", out)
    assert f"{mapping}:15: position: joint 'shoulder' has no column" in said and "under columns" in said
    text = (
        mapping.read_text()
        .replace('shoulder = ""', 'shoulder = "foo"')
        .replace('elbow = ""', 'elbow = "bar"')
    )
    mapping.write_text(text)
    run(log, "--robot", "double_pendulum", "--mapping", mapping, "--out", out)
    np.testing.assert_array_equal(Dataset.read(out).q.numpy(), m.q)


def test_json_says_what_was_found(tmp_path: Path) -> None:
    log, _ = WRITERS["rosbag 2"](tmp_path, motion())
    out = tmp_path / "log.parquet"
    said = json.loads(run(log, "--robot", "double_pendulum", "--out", out, "--json"))
    assert said["rows"] == said["rows_read"] == 300 and said["format"] == "rosbag2"
    assert said["segments"] == 1 and said["period_s"] == pytest.approx(0.01)
    assert said["file"] == str(out) and {finding["kind"] for finding in said["findings"]} == {"reader"}


def test_what_is_missing_is_said_in_one_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    log, _ = WRITERS["csv"](tmp_path, motion())
    out = tmp_path / "log.parquet"
    assert "--scene or --robot" in fail(monkeypatch, capfd, log, "--out", out)
    assert "--out log.parquet" in fail(monkeypatch, capfd, log, "--robot", "double_pendulum")
    said = fail(monkeypatch, capfd, log, "--robot", "double_pendulum", "--out", out)
    assert "the quantities of the columns are unclear" in said and "--guess" in said
    wrong = tmp_path / "m.toml"
    wrong.write_text("[time]\ncolum = 't'\n")
    said = fail(monkeypatch, capfd, log, "--robot", "double_pendulum", "--mapping", wrong, "--out", out)
    assert "m.toml:2: time.colum: unknown key" in said and not out.exists()
    (tmp_path / "run.pkl").write_bytes(b"\x80\x04.")
    said = fail(monkeypatch, capfd, tmp_path / "run.pkl", "--robot", "double_pendulum", "--out", out)
    assert "refused" in said


def test_guess_names_what_the_reader_left_out(tmp_path: Path) -> None:
    m = motion()
    log, mapping = tmp_path / "run.npz", tmp_path / "m.toml"
    np.savez(log, t=m.t, q=m.q, images=np.zeros((3, 4, 5)))
    told = json.loads(run(log, "--robot", "double_pendulum", "--guess", mapping, "--json"))
    assert told["not_read"] == "'images' of shape (3, 4, 5) and type float64 was left out"
    assert f"# The reader: {told['not_read']}" in mapping.read_text()
