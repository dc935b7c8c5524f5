"""Scene files: what they build, and that every error names file, line and key."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp.constraints import Cylinder, PointConnection
from forcegp.errors import SceneError
from forcegp.scene import BUNDLED, load_scene
from forcegp.simulate import SimulationConfig

ROOT = Path(__file__).parents[2]
TEXT = """\
[robot]
model = "kuka_iiwa"
base_position = [0.0, 0.0, 0.05]
gravity = [0.0, 0.0, -9.8]

[[contact]]
name = "table"
frame = "lbr_iiwa_link_7"
point = [0.0, 0.0, 0.1]
surface = { type = "plane", normal = [0.0, 0.0, 1.0], offset = 0.055 }

[[contact]]
name = "wall"
frame = "lbr_iiwa_link_6"
surface = { type = "cylinder", center = [1, 0, 0], axis = [0, 0, 1], radius = 0.2 }

[baumgarte]
natural_frequency = 10.0

[simulation]
duration = 5
[simulation.gains]
position_stiffness = 64.0
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def test_the_bundled_scene_is_the_papers_task() -> None:
    scene = load_scene("kuka_plane")
    system = scene.system()
    table = forcegp.SurfaceContact(
        "table", "lbr_iiwa_link_7", (0, 0, 0.1), forcegp.Plane(normal=(0, 0, 1), offset=0.055)
    )
    assert tuple(system.contacts) == (table,)
    assert system.baumgarte == forcegp.constraints.Baumgarte(natural_frequency=10.0, damping_ratio=1.0)
    assert system.robot.gravity.tolist() == [0, 0, -9.8]
    assert system.robot.base_position.tolist() == [0, 0, 0.05]
    assert (scene.simulation.dt, scene.simulation.viscous_friction) == (1 / 240, 1.0)
    assert scene.simulation.noise_std == 0.1 and scene.model.section.noise.acceleration is None


@pytest.mark.parametrize("path", [*BUNDLED, *sorted(ROOT.glob("scenes/*.toml"))], ids=str)
def test_every_scene_that_is_shipped_is_valid(path: str | Path) -> None:
    scene = load_scene(path)
    assert len(scene.system().contacts) == len(scene.sections.contact)


def test_the_example_shows_every_key_of_the_simulation() -> None:
    text = (ROOT / "scenes" / "kuka_sphere.toml").read_text()
    config = SimulationConfig()
    for name in [*config.__dataclass_fields__, *config.gains.__dataclass_fields__]:
        assert re.search(rf"^(# )?(\[simulation\.)?{name}( =|\])", text, re.MULTILINE), name


def test_all_tables(tmp_path: Path) -> None:
    connection = '[[connection]]\nname = "hold"\nframe = "lbr_iiwa_link_7"\nother_point = [0.4, 0, 0.5]\n'
    scene = load_scene(written(tmp_path, TEXT + connection + "[model]\nnoise = 0.2\n"))
    system = scene.system(dtype=torch.float32)
    assert system.contact_names == ("table", "wall", "hold")
    assert system.contacts[1].surface == Cylinder((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.2)  # pyright: ignore
    held = PointConnection("hold", "lbr_iiwa_link_7", (0.0, 0.0, 0.0), None, (0.4, 0.0, 0.5))
    assert system.contacts[2] == held
    assert system.robot.dtype == torch.float32
    assert scene.model.section.noise.acceleration == 0.2
    assert scene.simulation.duration == 5.0 and scene.simulation.gains.position_stiffness == 64.0
    assert scene.simulation.gains.position_damping == SimulationConfig().gains.position_damping


def test_without_baumgarte_and_contacts(tmp_path: Path) -> None:
    system = load_scene(written(tmp_path, '[robot]\nmodel = "double_pendulum"\n')).system()
    assert system.baumgarte is None and not system.contacts


def test_a_robot_file_is_found_beside_the_scene(tmp_path: Path) -> None:
    bundled = ROOT / "src/forcegp/robot/bundled/double_pendulum.urdf"
    (tmp_path / "arm.urdf").write_bytes(bundled.read_bytes())
    assert load_scene(written(tmp_path, '[robot]\nmodel = "arm.urdf"\n')).robot().nq == 2
    (tmp_path / "arm.urdf").write_text("<robot")
    with pytest.raises(SceneError, match=r"scene.toml:1: robot: .*arm.urdf"):
        load_scene(tmp_path / "scene.toml").robot()


@pytest.mark.parametrize(
    ("old", "new", "place", "rest"),
    [
        (
            "base_position",
            "base_positon",
            "3: robot.base_positon: unknown key",
            "did you mean 'base_position'",
        ),
        ("[robot]", "[robott]", "1: robott: unknown key", "did you mean 'robot'"),
        ("offset", "offst", "10: contact[0].surface.offst: unknown key", "did you mean 'offset'"),
        (
            "radius = 0.2",
            "radius = '1'",
            "15: contact[1].surface.radius: input should be",
            "'1'",
        ),
        ('"plane"', '"plan"', "10: contact[0].surface.type: unknown type 'plan'", "did you mean 'plane'"),
        ('type = "plane", ', "", "10: contact[0].surface: key 'type' is missing", "plane, sphere, cyl"),
        ("link_6", "link6", "14: contact[1].frame: unknown frame", "did you mean 'lbr_iiwa_link_6'"),
        ("[0, 0, 1], radius", "[0, 0, 0], radius", "15: contact[1].surface.axis: the cylinder's", "got"),
        ("[0.0, 0.0, 0.05]", "[0.0, 0.05]", "3: robot.base_position: too few numbers", "expected"),
        ("[0.0, 0.0, 0.05]", "[0, 0, 0, 0]", "3: robot.base_position", "got"),
        (
            "[0.0, 0.0, -9.8]",
            "[0.0, 0.0, inf]",
            "4: robot.gravity[2]: input should be a finite number",
            "inf",
        ),
        ("kuka_iiwa", "kuka_iwa", "2: robot.model: no such robot", "did you mean 'kuka_iiwa'"),
        ('model = "kuka_iiwa"\n', "", "1: robot: key 'model' is missing", "expected"),
        ('name = "wall"', 'name = "table"', "6: contact: ", "table"),
        ("10.0", "-10.0", "18: baumgarte.natural_frequency: ", "got: -10.0"),
        ("duration = 5", "duration = -5", "21: simulation.duration: ", "a positive finite number"),
        ("duration = 5", "duraton = 5", "21: simulation.duraton: unknown key", "did you mean 'duration'"),
        ("position_stiffness", "position_stiffnes", "23: simulation.gains.position_stiffnes", "did you mean"),
        ("[baumgarte]", "[baumgarte", "17: not valid TOML", "got"),
        ("[baumgarte]", "[robot]", "17: not valid TOML", "got"),
    ],
)
def test_every_error_names_file_line_and_key(
    tmp_path: Path, old: str, new: str, place: str, rest: str
) -> None:
    path = written(tmp_path, TEXT.replace(old, new, 1))
    assert old in TEXT
    with pytest.raises(SceneError) as caught:
        load_scene(path).system()
    assert str(caught.value).startswith(f"{path}:{place}"), str(caught.value)
    assert rest in str(caught.value)


def test_missing_scenes(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"no such scene(?s:.*)did you mean 'kuka_plane'"):
        load_scene("kuka_plan")
    written(tmp_path, TEXT)
    with pytest.raises(SceneError, match=r"did you mean '.*scene.toml'"):
        load_scene(tmp_path / "scen.toml")


@pytest.mark.parametrize(
    "content",
    [
        b"\xff\xfe",
        b"\x00",
        b"a = " + b"[" * 100_000,
        b"#" * (1 << 21),
        b"robot = 1",
        b"[[robot]]",
        b"",
        b"contact = {}",
        *(b"a = " + b"[" * levels + b"]" * levels for levels in (40, 150, 250, 400)),
        *(b"robot = " + b"{a = " * levels + b"1" + b"}" * levels for levels in (40, 150, 250)),
        b".".join([b"a"] * 20_000) + b" = 1",
        b"\n".join([b"robot = {", b"a" + b".a" * 500 + b" = 1}"]),
        b".".join([b"a"] * 1_000) + b" = 1",
    ],
    ids=range(18),
)
def test_hostile_scenes(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    with pytest.raises(SceneError, match=r"scene.toml"):
        load_scene(path)
