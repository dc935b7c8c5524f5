"""The 3D view: what is shown where, as one file that needs no network."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import forcegp
from forcegp.cli import app
from forcegp.models.structured_fit import StructuredFit
from forcegp.view.motion import Motion, at_rest, of_log, pictures, with_rollout
from forcegp.view.page import Stage, force_text, write_view
from forcegp.view.shapes import shapes_of
from forces.cases import logged, two_contacts

viser = pytest.importorskip("viser")


@cache
def fitted() -> StructuredFit:
    return forcegp.StructuredGP(two_contacts(), "analytical", noise=0.1).fit(
        logged(two_contacts(), 12), learn=[]
    )


def log() -> forcegp.Dataset:
    return logged(two_contacts(), 10, seed=5)


def test_twenty_pictures_a_second() -> None:
    t = torch.arange(241, dtype=torch.float64) / 240.0
    rows = pictures(t)
    np.testing.assert_allclose(t[rows].numpy(), np.arange(21) / 20.0, atol=1.0 / 240.0)
    assert pictures(t[:1]).tolist() == [0]


def test_forces_are_those_of_the_model_where_contacts_are_closed() -> None:
    data, model = log(), fitted()
    motion = of_log(two_contacts(), data, model)
    shown = data[pictures(data.t)]
    active = shown.active(("table", "ball"))
    found = model.predict(shown.q, shown.qd, shown.tau, "multiplier", active=active)
    for i, force in enumerate(motion.forces):
        np.testing.assert_array_equal(np.isfinite(force.value), active[:, i].numpy())
        closed = active[:, i]
        np.testing.assert_allclose(force.value[closed], found.mean[closed, i])
        assert found.std is not None
        np.testing.assert_allclose(force.std[closed], found.std[closed, i])
    alone = of_log(two_contacts(), data)
    closed = active[:, 0]
    np.testing.assert_array_equal(alone.forces[0].value[closed], shown.multiplier["table"][closed])
    assert not alone.forces[0].std.any(), "a logged force has no error bar"


def test_an_arrow_is_as_long_as_the_force_and_its_bar_is_two_deviations() -> None:
    motion = of_log(two_contacts(), log(), fitted())
    server = viser.ViserServer(host="127.0.0.1", port=8190, verbose=False)
    try:
        stage = Stage(server, motion, shapes_of(two_contacts().robot))
        force = motion.forces[0]
        k = int(np.flatnonzero(np.isfinite(force.value))[0])
        stage.show(k)
        arrow, spread = stage._arrows[0]
        ends = arrow.points[0].astype(float)
        bar = spread.points[0].astype(float)
        np.testing.assert_allclose(ends[0], force.point[k], atol=1e-6)
        # The lengths of the arrow and of the bar are in the ratio of the force and of four deviations.
        ratio = np.linalg.norm(bar[1] - bar[0]) / np.linalg.norm(ends[1] - ends[0])
        np.testing.assert_allclose(ratio, 4.0 * force.std[k] / abs(force.value[k]), rtol=1e-4)
        assert force_text(force, k) in stage._label.text
        opened = int(np.flatnonzero(~np.isfinite(force.value))[0])
        stage.show(opened)
        assert not arrow.visible and "table: open" in stage._label.text
    finally:
        server.stop()


def test_one_file_without_references(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_view(
        tmp_path / "view.html", at_rest(two_contacts()), shapes_of(two_contacts().robot), "a < b"
    )
    html = path.read_text(encoding="utf-8")
    assert "<title>a &lt; b</title>" in html
    assert not re.search(
        r'<(script|link|img|iframe)[^>]+(src|href)="(?!data:)', html[: html.index("</head>")]
    )
    assert path.stat().st_size < 6_000_000
    assert capfd.readouterr().out == "", "a program may read the output"


def test_paths_of_a_rollout_are_added() -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    q = torch.tensor([0.3, -0.2], dtype=torch.float64)
    tau, options = torch.zeros(1, 2, dtype=torch.float64), forcegp.RolloutOptions(0.01)
    path = forcegp.AnalyticalModel(system).nominal().rollout(q, 0.0 * q, tau, 0.1, options=options)
    motion = with_rollout(Motion(system, np.zeros(1), q[None]), path)
    assert [p.kind for p in motion.paths] == ["predicted"]
    np.testing.assert_allclose(motion.paths[0].points, path.tip("tip").numpy())


def test_the_command_writes_a_page(tmp_path: Path) -> None:
    model, data, out = tmp_path / "model", tmp_path / "log.parquet", tmp_path / "view.html"
    fitted().save(model)
    log().write(data)
    options = ["--data", str(data), "--samples", "0", "--horizon", "0.1", "--out", str(out), "--json"]
    done = CliRunner().invoke(app, ["view", str(model), *options])
    assert done.exit_code == 0, (done.output, done.exception)
    found = json.loads(done.stdout)
    assert found["page"] == str(out) and found["pictures"] == 10 and found["paths"] >= 1
    assert "__VISER_EMBED_DATA__" in out.read_text(encoding="utf-8")


def test_one_motion_at_a_time(tmp_path: Path) -> None:
    both = ["--data", "a.parquet", "--rollout", "b.parquet"]
    done = CliRunner().invoke(app, ["view", "kuka_plane", *both])
    assert done.exit_code != 0
    assert "exclude each other" in str(done.exception)
