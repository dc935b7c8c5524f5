"""`forcegp check`: table, JSON, page, last line and exit code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from typer.testing import CliRunner

import forcegp
from forcegp import checks
from forcegp.checks import KINDS, Finding, Log, Report
from forcegp.checks.explain import with_alternatives
from forcegp.cli import app
from forcegp.storage.model_file import model_path
from planted_faults import free_log

KINDS_OF_ONE = ("torque-gain", "masses-mismatch")
SCENE = '[robot]\nmodel = "double_pendulum"\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path


def write(log: Log, path: Path) -> None:
    """A log as a file, without the checks of a data set."""
    columns: dict[str, np.ndarray] = {"t": log.t}
    for name in ("q", "qd", "qdd", "tau"):
        columns |= {f"{name}.{j}": getattr(log, name)[:, k] for k, j in enumerate(log.joint_names)}
    header = log.header.model_copy(update={"joint_names": log.joint_names})
    table = pa.table(columns).replace_schema_metadata({b"forcegp": header.to_json().encode()})
    pq.write_table(table, path)


def run(folder: Path, log: Log, *options: str) -> Any:
    write(log, folder / "run.parquet")
    files = ["-s", str(folder / "scene.toml"), "-d", str(folder / "run.parquet")]
    return CliRunner().invoke(app, ["check", *files, *options])


@pytest.fixture
def log() -> Log:
    return free_log(forcegp.load_robot("double_pendulum"), seconds=10.0)


def test_json_holds_every_finding(folder: Path, log: Log) -> None:
    done = run(folder, log.replace(t=1e3 * log.t), "--json")
    result = json.loads(done.stdout)
    assert done.exit_code == 1 and result["usable"] is False and result["samples"] == len(log)
    first = result["findings"][0]
    assert first["kind"] == "time-unit" and first["severity"] == "error"
    assert first["intervals"] == [[0, len(log)]] and first["remedy"]
    assert first["evidence"]["seconds_per_unit"] == pytest.approx(1e-3, rel=0.02)


def test_faults_stop_with_rows_and_remedy_and_the_page_holds_all_and_fetches_nothing(
    folder: Path, log: Log
) -> None:
    tau, t = -log.tau, log.t.copy()
    tau[900, 1] -= 30.0
    tau[1200, 0] = np.nan
    t[1500:] += 0.2
    page = folder / "check.html"
    done = run(folder, log.replace(tau=tau, t=t), "--out", str(page))
    assert done.exit_code == 1
    assert "verdict: stop; repair 2 errors before fitting a model" in done.stdout.splitlines()
    assert "not-finite" in done.stdout and "1200" in done.stdout and "torque-sign" in done.stdout
    assert KINDS["torque-sign"].remedy.split()[0] in done.stdout
    text = page.read_text()
    for kind in ("not-finite", "torque-sign", "spike", "time-gap"):
        assert kind in text and KINDS[kind].remedy.split("/")[0] in text
    assert "verdict: stop" in text and text.count("data:image/svg+xml") >= 4
    assert "http://" not in text.replace("http://www.w3.org", "") and "<script" not in text


def test_alternatives_are_shown_together(folder: Path, log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    def both(*_: object, **__: object) -> Report:
        first, second = (Finding(kind, f"says {kind}", log.all_rows) for kind in KINDS_OF_ONE)
        return Report((with_alternatives(first, [second]),), len(log), log.joint_names)

    monkeypatch.setattr(checks, "check", both)
    done = run(folder, log, "--out", str(folder / "check.html"))
    page = (folder / "check.html").read_text()
    for text in (done.stdout, page):
        assert all(kind in text and f"says {kind}" in text for kind in KINDS_OF_ONE)
    assert "hang a known weight" in page and "Torque scaled wrongly, or inertial parameters" in page
    result = json.loads(run(folder, log, "--json").stdout)["findings"][0]
    assert result["kind"] == KINDS_OF_ONE[0] and result["alternatives"][0]["kind"] == KINDS_OF_ONE[1]


def test_the_function_takes_a_data_set(log: Log) -> None:
    robot = forcegp.load_robot("double_pendulum")
    columns = {name: torch.from_numpy(getattr(log, name)) for name in ("t", "q", "qd", "qdd", "tau")}
    data = forcegp.Dataset(**columns, joint_names=robot.joint_names)
    report = forcegp.check(forcegp.ConstrainedSystem(robot), data)
    assert report.usable and report.count("error") == 0


def test_a_log_in_order_may_go_on_and_a_robot_without_contacts_needs_no_scene(folder: Path, log: Log) -> None:
    write(log, folder / "run.parquet")
    data = ["-d", str(folder / "run.parquet")]
    done = CliRunner().invoke(app, ["check", "--robot", "double_pendulum", *data])
    assert done.exit_code == 0 and done.stdout.splitlines()[-1] == "verdict: go on", done.output
    out = folder / "model"
    done = CliRunner().invoke(
        app, ["fit", "--robot", "double_pendulum", *data, "-m", "analytical", "-o", str(out)]
    )
    assert done.exit_code == 0 and model_path(out).is_file(), done.output
    for named in ([], ["--robot", "double_pendulum", "-s", str(folder / "scene.toml")]):
        for command in (["check"], ["fit", "-o", str(folder / "other")]):
            done = CliRunner().invoke(app, [*command, *data, *named])
            assert done.exit_code != 0 and "either --scene or --robot" in str(done.exception), done.output


def test_every_log_that_is_given_is_reported(folder: Path, log: Log) -> None:
    """The faulty one decides the exit code wherever it stands."""
    write(log, folder / "good.parquet")
    write(log.replace(tau=-log.tau), folder / "bad.parquet")
    paths = [str(folder / name) for name in ("bad.parquet", "good.parquet")]
    scene = ["check", "-s", str(folder / "scene.toml")]
    done = CliRunner().invoke(app, [*scene, "-d", paths[0], "-d", paths[1]])
    assert done.exit_code == 1 and all(f"log: {path}" in done.stdout for path in paths), done.output
    assert [line.partition(";")[0] for line in done.stdout.splitlines() if line.startswith("verdict")] == [
        "verdict: stop",
        "verdict: go on",
    ]
    done = CliRunner().invoke(app, [*scene, "-d", paths[0], "-d", paths[1], "--json"])
    assert [one["usable"] for one in json.loads(done.stdout)["logs"]] == [False, True]
    done = CliRunner().invoke(app, [*scene, "-d", paths[0], "-d", paths[1], "-o", str(folder / "a.html")])
    assert "a page shows one log" in str(done.exception)


def test_a_finding_is_one_paragraph(folder: Path, log: Log) -> None:
    done = run(folder, log.replace(tau=log.tau * [1.0, -1.0]))
    (line,) = (line for line in done.stdout.splitlines() if "torque-sign" in line)
    assert line.startswith("error: ") and log.joint_names[1] in line and "→" in line
    assert not any("50526" in line or "e+" in line for line in done.stdout.splitlines())


def test_three_findings_come_first_and_the_others_are_counted(
    folder: Path, log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tables of what cannot be seen are on the page only; `--all` and JSON have everything."""
    kinds = ("faults-hidden", "torque-gain", "torque-offset", "spike", "quantised", "impact")
    found = tuple(Finding(kind, f"says {kind}", log.all_rows) for kind in kinds)
    monkeypatch.setattr(checks, "check", lambda *_, **__: Report(found, len(log), log.joint_names))
    lines = run(folder, log).stdout.splitlines()
    assert [line.split(" → ")[0] for line in lines[:3]] == [f"warning: says {kind}" for kind in kinds[1:4]]
    assert lines[3:] == ["also 3 notes: pass --all", "verdict: go on with care; 3 warnings to review"]
    page = folder / "check.html"
    assert f"also 3 notes: see {page}, or pass --all" in run(folder, log, "-o", str(page)).stdout
    assert all(f"says {kind}" in page.read_text() for kind in kinds)
    every = run(folder, log, "--all").stdout
    assert all(f"says {kind}" in every for kind in kinds) and "also" not in every
    assert len(json.loads(run(folder, log, "--json").stdout)["findings"]) == len(kinds)
