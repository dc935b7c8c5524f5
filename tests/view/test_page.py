"""The 3D view: what is shown where, as one file that needs no network."""

from __future__ import annotations

import json
import re
import signal
import urllib.error
import urllib.request
from functools import cache
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import forcegp
from forcegp import kinematics
from forcegp.cli import app
from forcegp.constraints import ImplicitSurface
from forcegp.models.structured_fit import StructuredFit
from forcegp.report.animation import animation_source, arm_points
from forcegp.robot.shapes import shapes_of
from forcegp.view.motion import Motion, at_rest, of_log, pictures, with_rollout
from forcegp.view.page import ARROW, TILES, _patches, content_of, force_text, serve, write_view
from forces.cases import logged, two_contacts
from robots import example_data

ROUNDED = 2e-5
"""Coordinates in a page are rounded to 10 µm."""


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
    content = content_of(motion, shapes_of(two_contacts().robot))
    force, arrow = motion.forces[0], content["forces"][0]
    k = int(np.flatnonzero(np.isfinite(force.value))[0])
    start, tip, bar = (np.array(arrow[name][k]) for name in ("start", "tip", "bar"))
    np.testing.assert_allclose(start, force.point[k], atol=ROUNDED)
    scale = ARROW / max(np.nanmax(abs(one.value), initial=0.0) for one in motion.forces)
    np.testing.assert_allclose(np.linalg.norm(tip - start), scale * abs(force.value[k]), atol=ROUNDED)
    np.testing.assert_allclose(np.linalg.norm(bar[1] - bar[0]), 4.0 * scale * force.std[k], atol=ROUNDED)
    opened = int(np.flatnonzero(~np.isfinite(force.value))[0])
    assert arrow["tip"][opened] is None and content["texts"][opened][0] == "table: open"
    assert content["texts"][k][0] == force_text(force, k) != "table: open"


def test_any_surface_is_drawn_where_it_is() -> None:
    bowl = ImplicitSurface(lambda p: p[2] - 0.3 - 0.5 * (p[0] ** 2 + p[1] ** 2))
    along = np.stack([np.linspace(-0.4, 0.4, 200), np.full(200, 0.1), np.full(200, 0.35)], axis=-1)
    tiles = _patches(bowl, along)
    centres = torch.from_numpy(np.stack([tile.mean(axis=0) for tile in tiles]))
    assert len(tiles) == TILES and float(bowl.value(centres).abs().max()) < 1e-6
    sides = np.stack([tile[1] - tile[0] for tile in tiles])
    normals = bowl.gradient(centres).numpy()
    across = np.cross(sides, normals)
    np.testing.assert_allclose(np.linalg.norm(across, axis=-1), 0.0, atol=1e-9)


def test_solids_move_with_their_links() -> None:
    motion = of_log(two_contacts(), log())
    robot, shapes = motion.system.robot, shapes_of(two_contacts().robot)
    content = content_of(motion, shapes)
    surfaces = [solid for solid in content["solids"] if solid["link"] is None]
    assert len(surfaces) == 2 and len(content["solids"]) == len(shapes) + 2
    poses, frame = kinematics.link_poses(robot, motion.q), content["poses"][3]
    for link in range(robot.nq):
        R, p = np.reshape(frame[link + 1][:9], (3, 3)), frame[link + 1][9:]
        np.testing.assert_allclose(R, poses.rotation[3, link].numpy(), atol=ROUNDED)
        expected = poses.position[3, link] + robot.base_position
        np.testing.assert_allclose(p, expected.numpy(), atol=ROUNDED)


def test_one_file_without_references(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_view(
        tmp_path / "view.html", at_rest(two_contacts()), shapes_of(two_contacts().robot), "a < b"
    )
    html = path.read_text(encoding="utf-8")
    assert "<title>a &lt; b</title>" in html and f"script-src '{animation_source()}'" in html
    assert not re.search(r'(src|href)="(?!data:)', html)
    assert path.stat().st_size < 200_000
    assert capfd.readouterr().out == "", "a program may read the output"


def test_the_page_is_served_until_interrupted() -> None:
    pages = []

    def ask(address: str) -> None:
        def fetch() -> None:
            with urllib.request.urlopen(address, timeout=10) as answer:
                pages.append(answer.read().decode())
            for url, host in ((address, "attacker.example:80"), (address.rpartition("/")[0], None)):
                headers = {} if host is None else {"Host": host}
                with pytest.raises(urllib.error.HTTPError, match="404"):
                    urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10)
                pages.append("refused")
            signal.raise_signal(signal.SIGINT)

        Thread(target=fetch, daemon=True).start()

    # A test that runs in the background of a shell has its interrupts ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        serve("<p>λ</p>", 0, ask)
    finally:
        signal.signal(signal.SIGINT, before)
    assert pages == ["<p>λ</p>", "refused", "refused"]


def test_paths_of_a_rollout_are_added() -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    q = torch.tensor([0.3, -0.2], dtype=torch.float64)
    tau, options = torch.zeros(1, 2, dtype=torch.float64), forcegp.rollout.RolloutOptions(0.01)
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
    assert "<canvas" in out.read_text(encoding="utf-8")


def test_one_motion_at_a_time(tmp_path: Path) -> None:
    both = ["--data", "a.parquet", "--rollout", "b.parquet"]
    done = CliRunner().invoke(app, ["view", "kuka_plane", *both])
    assert done.exit_code != 0
    assert "cannot be combined" in str(done.exception)


def test_a_free_base_is_drawn_where_it_is() -> None:
    robot = forcegp.load_robot(example_data() / "solo_description/robots/solo12.urdf", base="free")
    q = torch.zeros(1, robot.nq, dtype=torch.float64)
    q[0, :3] = torch.tensor([1.0, 2.0, 3.0])
    points = arm_points(robot, q, "FL_FOOT", (0.0, 0.0, 0.0))
    assert points.shape[1] == 5, "the base, the three joints of a leg, and its foot"
    torch.testing.assert_close(points[0, 0], q[0, :3])
