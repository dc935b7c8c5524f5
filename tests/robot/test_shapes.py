"""What a robot looks like."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import forcegp
from forcegp import kinematics
from forcegp.errors import RobotFileError
from forcegp.robot.load import BUNDLED
from forcegp.robot.shapes import box, cylinder, rods, shapes_of, sphere, turn_z

EXACT = 1e-12
"""Of products of a few rotations."""

ROBOT = """
<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="tool"><visual><origin xyz="0 0 0.1" rpy="0 1.5707963267948966 0"/>
    <geometry>{}</geometry></visual></link>
  <joint name="f" type="fixed"><origin xyz="0.5 0 0"/><parent link="arm"/><child link="tool"/></joint></robot>
"""


@given(st.tuples(*3 * [st.floats(-1, 1)]).filter(lambda v: np.linalg.norm(v) > 1e-3))
@settings(max_examples=60, deadline=None)
def test_z_is_turned_to_a_direction(v: tuple[float, float, float]) -> None:
    direction = np.array(v) / np.linalg.norm(v)
    R = turn_z(direction)
    np.testing.assert_allclose(R[:, 2], direction, atol=1e-9)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=EXACT)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=EXACT)


@pytest.mark.parametrize("down", [(0, 0, -1), (0, 0, 1)])
def test_z_along_itself(down: tuple[int, int, int]) -> None:
    R = turn_z(np.array(down, dtype=float))
    np.testing.assert_allclose(R[:, 2], down)
    assert np.linalg.det(R) == 1.0


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_robots_have_shapes_of_their_file(name: str) -> None:
    robot = forcegp.load_robot(name)
    text = (Path(forcegp.__file__).parent / "robot" / "bundled" / f"{name}.urdf").read_text()
    assert len(shapes_of(robot, name)) == text.count("<visual>")
    assert len(shapes_of(robot)) == text.count("<visual>"), "a saved model knows its robot by name"


def test_rods_end_at_the_joints() -> None:
    robot = forcegp.load_robot("double_pendulum")
    found = rods(robot)
    assert {shape.link for shape in found} == {0, 1}
    q = torch.tensor([0.4, -0.9], dtype=torch.float64)
    poses = kinematics.link_poses(robot, q)
    ends = []
    for shape in found:
        R, p = poses.rotation[shape.link].numpy(), poses.position[shape.link].numpy()
        ends.append(p + R @ shape.points[len(shape.points) // 2 :].mean(axis=0))
    np.testing.assert_allclose(ends[0], poses.position[1].numpy(), atol=EXACT)
    np.testing.assert_allclose(ends[1], kinematics.point_position(robot, q, "tip").numpy(), atol=EXACT)


def test_corners_lie_on_their_solids() -> None:
    np.testing.assert_allclose(np.linalg.norm(sphere(0.3), axis=1), 0.3)
    np.testing.assert_allclose(abs(box(0.2, 0.4, 0.6)), np.full((8, 3), [0.1, 0.2, 0.3]))
    np.testing.assert_allclose(np.linalg.norm(cylinder(0.1, 0.4)[:, :2], axis=1), 0.1)
    assert np.ptp(cylinder(0.1, 0.4)[:, 2]) == 0.4


def write(folder: Path, geometry: str) -> tuple[forcegp.RobotModel, Path]:
    path = folder / "robot" / "r.urdf"
    path.parent.mkdir(exist_ok=True)
    path.write_text(ROBOT.format(geometry))
    return forcegp.load_robot(path), path


def test_a_visual_of_a_fixed_frame_moves_with_its_joint(tmp_path: Path) -> None:
    (shape,) = shapes_of(*write(tmp_path, '<cylinder radius="0.1" length="0.4"/>'))
    assert shape.link == 0
    np.testing.assert_allclose(shape.points.mean(axis=0), [0.5, 0.0, 0.1], atol=EXACT)
    np.testing.assert_allclose(np.ptp(shape.points, axis=0), [0.4, 0.2, 0.2], atol=EXACT)


STL = """solid s
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid
"""


@pytest.mark.parametrize("name", ["m/a.stl", "package://robot/m/a.stl", "package://m/a.stl"])
def test_meshes_are_found_below_the_file_or_its_package(tmp_path: Path, name: str) -> None:
    (tmp_path / "robot" / "m").mkdir(parents=True)
    (tmp_path / "robot" / "m" / "a.stl").write_text(STL)
    (shape,) = shapes_of(*write(tmp_path, f'<mesh filename="{name}" scale="2 2 2"/>'))
    corners = {tuple(point) for point in shape.points.round(9)}
    assert corners == {(0.5, 0.0, 0.1), (0.5, 0.0, -1.9), (0.5, 2.0, 0.1)}, "turned, scaled and moved"


OUTSIDE = (
    "../secret.stl",
    "/etc/passwd",
    "package://robot/../../secret.stl",
    "http://example.com/a.stl",
    "file:///secret.stl",
    "none.stl",
    "",
)


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_mesh_outside_of_the_folder_is_not_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret.stl").write_text(STL)
    robot, path = write(tmp_path, '<mesh filename="x.stl"/>')
    path.write_text(ROBOT.format(f'<mesh filename="{name}"/>'))
    assert all(len(shape.points) == 48 for shape in shapes_of(robot, path)), "rods instead"


NOT_SIZES = ('<box size="1 2"/>', '<sphere radius="nan"/>', '<cylinder radius="1"/>')


@pytest.mark.parametrize("geometry", NOT_SIZES)
def test_wrong_numbers_are_named(tmp_path: Path, geometry: str) -> None:
    robot, path = write(tmp_path, '<sphere radius="1"/>')
    path.write_text(ROBOT.format(geometry))
    with pytest.raises(RobotFileError, match="link 'tool'"):
        shapes_of(robot, path)
