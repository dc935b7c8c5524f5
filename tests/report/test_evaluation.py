"""The page of an evaluation: title, verdict, red where it is bad, tables with units, nothing fetched."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest

from forcegp import AnalyticalModel, evaluate
from forcegp.report.evaluation import error_tables, score_table, write_evaluation
from forcegp.report.window import opening, predicted_window
from random_data import random_data, table_system

system = table_system()
data = random_data(system, 80)
model = AnalyticalModel(system).nominal()
found = evaluate(model, data)
window = predicted_window(model, opening(data, 0.2), model.kind)


def page(folder: Path, name: str = "model", log: str = "logs/test.parquet") -> str:
    """The text of the page."""
    return write_evaluation(folder, name, log, None, found, window).read_text(encoding="utf-8")


def test_the_page_opens_with_the_kind_of_model_the_data_and_the_verdict(tmp_path: Path) -> None:
    text = page(tmp_path)
    assert "<h1>Analytical model on test.parquet</h1>" in text
    named = page(tmp_path / "named", name="models/arm-2")
    assert "<h1>Analytical model “arm-2” on test.parquet</h1>" in named
    assert found.verdict in text and text.index(found.verdict) < text.index("<h2>")
    names = {path.name for path in tmp_path.iterdir() if path.is_file()}
    assert names == {"evaluation.html", "window.json", "predictions.svg", "errors.svg", "forces.svg"}
    assert text.index("Contact force") < text.index("Predictions and errors")


def test_what_is_worse_than_a_trivial_predictor_is_red(tmp_path: Path) -> None:
    text = page(tmp_path)
    for verdict in found.verdicts:
        item = re.search(rf"<li([^>]*)>{re.escape(verdict.text())}", text)
        assert item and ("bad" in item.group(1)) == (not verdict.better)
    torque = error_tables(found)[0]
    assert torque.bad and all(column == 1 for _, column in torque.bad)
    for i, row in enumerate(torque.rows):
        worse = any(float(row[1]) > float(other) for other in row[2:5])
        # Cells are rounded, so that only clear differences are compared.
        if min(abs(float(row[1]) - float(other)) for other in row[2:5]) > 1e-2 * float(row[1]):
            assert ((i, 1) in torque.bad) == worse


def test_tables_have_units_and_a_row_per_joint() -> None:
    for table, unit in zip(error_tables(found), ("[N m, N]", "[rad/s², m/s²]"), strict=True):
        assert unit in table.caption and [row[0] for row in table.rows] == list(data.joint_names)
    assert all(
        "[" in row[0] or "coverage" in row[0] or row[0] == "samples" for row in score_table(found).rows
    )


def test_text_from_outside_is_escaped_and_nothing_is_fetched(tmp_path: Path) -> None:
    text = page(tmp_path, "<script>alert(1)</script>", "<b>log</b>")
    assert "<script>" not in text and "<b>log" not in text
    addresses = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert addresses and all(address.startswith("data:") for address in addresses)


def test_logs_that_count_seconds_from_1970_keep_their_digits() -> None:
    later = data.replace(t=data.t + 1.7e9)
    shown = predicted_window(model, opening(later, 0.2), model.kind)
    assert shown.t[0] == 0.0 and shown.seconds == pytest.approx(window.seconds, abs=1e-6)
    assert all(b > a for a, b in pairwise(shown.t))


def test_what_the_learned_forces_are_worth_is_on_the_page(tmp_path: Path) -> None:
    worth = {"joint_friction of elbow": 12.3, "bristles of elbow": -0.4}
    text = write_evaluation(tmp_path, "m", "d", None, found, window, worth).read_text("utf-8")
    assert re.search(r"joint_friction of elbow(.|\n)*12\.3", text)
    caption = "Log evidence of the learned forces"
    assert caption in text and caption not in page(tmp_path / "named")
