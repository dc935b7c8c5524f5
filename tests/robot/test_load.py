"""Robot files that are wrong: one typed error that names the file, the link or joint, and the remedy."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import forcegp
from forcegp import dynamics, kinematics
from forcegp.errors import (
    InertiaError,
    RobotFileError,
    RobotFileWarning,
    ShapeError,
    UnknownNameError,
    UnsupportedRobotError,
)
from forcegp.robot.load import BUNDLED
from forcegp.robot.safety import MAX_BYTES, MAX_ELEMENTS
from forcegp.robot.write_back import write_robot
from robots import ARMS, example_data, random_states

PUBLISHED_IIWA = Path(__file__).resolve().parents[3] / "shared/real/kuka_iiwa14/iiwa14.urdf"

SECONDS = 2.0  # what the requirements allow for any file; processor time, as other programs may run
LINK = '<link name="{0}"><inertial><mass value="1"/>{1}</inertial></link>'
BALL = '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>'
JOINT = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/>{4}</joint>'


def link(name: str, inertia: str = BALL) -> str:
    return LINK.format(name, inertia)


def joint(name: str, parent: str, child: str, rest: str = "", kind: str = "revolute") -> str:
    return JOINT.format(name, kind, parent, child, rest)


def write(folder: Path, *parts: str) -> Path:
    path = folder / "robot.urdf"
    path.write_text('<robot name="r">' + "".join(parts) + "</robot>")
    return path


def arm(folder: Path, rest: str = "", kind: str = "revolute", inertia: str = BALL) -> Path:
    return write(folder, '<link name="base"/>', link("hand", inertia), joint("j", "base", "hand", rest, kind))


def test_bundled_robots_load_without_remarks() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RobotFileWarning)
        robots = {name: forcegp.load_robot(name) for name in BUNDLED}
    assert {name: robot.nq for name, robot in robots.items()} == {
        "double_pendulum": 2,
        "franka_panda": 7,
        "kuka_iiwa": 7,
        "kuka_iiwa14": 7,
        "ur5": 6,
    }
    assert all(robot.name == name for name, robot in robots.items())


def test_bundled_panda_equals_the_published_figures() -> None:
    """Against the arm of example-robot-data, which carries the same identified figures and a hand."""
    published = next(arm for arm in ARMS if arm.name == "panda").load()
    ours = forcegp.load_robot("franka_panda")
    assert ours.joint_names == published.joint_names
    for field in ("placement_rotation", "placement_position", "axis", "lower", "upper", "effort_limit"):
        torch.testing.assert_close(getattr(ours, field), getattr(published, field), rtol=0, atol=1e-12)
    for field in ("mass", "com", "inertia"):
        torch.testing.assert_close(
            getattr(ours, field)[:6], getattr(published, field)[:6], rtol=1e-12, atol=0
        )


@pytest.mark.skipif(not PUBLISHED_IIWA.exists(), reason="the published robot file is not here")
def test_bundled_iiwa14_equals_the_published_parameters() -> None:
    published, ours = forcegp.load_robot(PUBLISHED_IIWA), forcegp.load_robot("kuka_iiwa14")
    assert ours.joint_names == published.joint_names
    assert ours.frame_names == published.frame_names
    fields = ("placement_rotation", "placement_position", "axis", "lower", "upper", "effort_limit")
    for field in (*fields, "velocity_limit", "damping", "friction", "mass", "com", "inertia"):
        torch.testing.assert_close(getattr(ours, field), getattr(published, field), rtol=0, atol=1e-15)
    q = random_states(ours, 4)[0]
    for frame in ours.frame_names:
        pose = kinematics.frame_pose(ours, q, frame), kinematics.frame_pose(published, q, frame)
        torch.testing.assert_close(*pose, rtol=0, atol=1e-12)


def test_bundled_iiwa14_has_the_published_total_mass_and_reach() -> None:
    """Masses and link lengths of Drake's iiwa14, summed by hand."""
    robot = forcegp.load_robot("kuka_iiwa14")
    assert float(robot.mass.sum()) == pytest.approx(5.76 + 6.35 + 3 * 3.5 + 1.8 + 1.2)
    flange = kinematics.frame_pose(robot, torch.zeros(7, dtype=robot.dtype), "iiwa_link_ee")[1]
    height = 0.1575 + 0.2025 + 0.2045 + 0.2155 + 0.1845 + 0.2155 + 0.081 + 0.045
    np.testing.assert_allclose(flange, [0.0, 0.0, height], atol=1e-9)


def test_bundled_double_pendulum_equals_the_textbook() -> None:
    robot = forcegp.load_robot("double_pendulum")
    q, qd = torch.tensor([0.4, -0.9], dtype=torch.float64), torch.tensor([1.1, 0.7], dtype=torch.float64)
    m, l, r, g = 1.0, 1.0, 0.02, 9.81
    I = m * (3 * r**2 + l**2) / 12
    c, s = np.cos(-0.9), np.sin(-0.9)
    M11, M12 = 2 * I + 1.5 * m * l**2 + m * l**2 * c, I + 0.25 * m * l**2 + 0.5 * m * l**2 * c
    expected = [[M11, M12], [M12, I + 0.25 * m * l**2]]
    np.testing.assert_allclose(dynamics.mass_matrix(robot, q), expected, rtol=1e-12)
    h = 0.5 * m * l**2 * s
    np.testing.assert_allclose(
        dynamics.bias_force(robot, q, qd), [h * (2 * 1.1 * 0.7 + 0.7**2), -h * 1.1**2], rtol=1e-12
    )
    both = -0.5 * m * g * l * np.sin(0.4 - 0.9)
    np.testing.assert_allclose(
        dynamics.gravity_force(robot, q), [both - 1.5 * m * g * l * np.sin(0.4), both], rtol=1e-12
    )


def test_unknown_robot_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown robot 'kuka_iwa'(.|\n)*did you mean 'kuka_iiwa'"):
        forcegp.load_robot("kuka_iwa")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "empty.urdf").touch()
    (tmp_path / "binary.urdf").write_bytes(bytes(range(256)) * 50)
    os.mkfifo(tmp_path / "pipe.urdf")
    (tmp_path / "html.xml").write_text("<html/>")
    cases = {
        tmp_path / "missing.urdf": "got: no such file",
        tmp_path: "got: a folder",
        tmp_path / "pipe.urdf": "got: something else",
        tmp_path / "empty.urdf": "no element found",
        tmp_path / "binary.urdf": "not (well-formed|readable)",
        tmp_path / "html.xml": "neither URDF nor MJCF(.|\n)*<html>",
        tmp_path / "nul\0.urdf": "cannot be read",
    }
    for path, message in cases.items():
        with pytest.raises(RobotFileError, match=message):
            forcegp.load_robot(path)


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    data = next(arm for arm in ARMS if arm.name == "kuka_iiwa").path.read_bytes().rstrip()
    path = tmp_path / "robot.urdf"
    for length in range(0, len(data), 97):
        path.write_bytes(data[:length])
        with pytest.raises(RobotFileError, match=r"robot\.urdf: not well-formed XML"):
            forcegp.load_robot(path)


def _laughs() -> str:
    entities = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10 if i else "lol"}">' for i in range(10))
    return f'<!DOCTYPE robot [{entities}]><robot name="r">&e9;</robot>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (_laughs, "document types and entities are not allowed"),
        (
            lambda: '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="r">&x;</robot>',
            "document types and entities are not allowed",
        ),
        (lambda: '<!DOCTYPE r SYSTEM "http://localhost/r.dtd"><robot name="r"/>', "document types"),
        (lambda: "<robot name='r'>" + "<link name='l'/>" * (MAX_ELEMENTS + 1), "too many elements"),
        (lambda: "<robot name='r'>" + "".join(f"<link name='{i}'/>" for i in range(1_000_000)), "too large"),
        (lambda: "<robot name='r'>" + "<link>" * 500, "nested too deeply"),
        (lambda: "<mujoco><worldbody>" + "<body>" * 500, "nested too deeply"),
        (lambda: "<robot name='" + "r" * MAX_BYTES + "'/>", "too large"),
        (lambda: '<robot name="r"><link a="' + "1 " * 4_000_000 + '"/></robot>', "<link> has no usable name"),
    ],
)
def test_hostile_files_are_refused_in_time(tmp_path: Path, text: Callable[[], str], message: str) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(text())
    start = time.process_time()
    with pytest.raises(RobotFileError, match=message):
        forcegp.load_robot(path)
    assert time.process_time() - start < SECONDS


def test_a_chain_as_long_as_allowed_loads_and_a_longer_one_is_refused(tmp_path: Path) -> None:
    def chain(count: int, kind: str) -> Path:
        links = [link(f"l{i}") for i in range(count + 1)]
        joints = [joint(f"j{i}", f"l{i}", f"l{i + 1}", kind=kind) for i in range(count)]
        return write(tmp_path, *links, *joints, link("tip"), joint("last", f"l{count}", "tip"))

    assert forcegp.load_robot(chain(400, "revolute")).nq == 401
    # Fixed joints fold away, however many there are: two thousand, beyond Python's recursion limit.
    assert forcegp.load_robot(chain(2000, "fixed")).nq == 1
    with pytest.raises(RobotFileError, match="1 to 500 moving joints"):
        forcegp.load_robot(chain(1500, "revolute"))


TWO = ('<link name="base"/>', link("a"), link("b"))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ((), "the file has no links"),
        (TWO[:1], r"1 to 500 moving joints(.|\n)*got: 0"),
        ((*TWO, link("a"), joint("j", "base", "a")), "link name 'a' is not unique"),
        ((*TWO, joint("j", "base", "a"), joint("j", "a", "b")), "joint name 'j' is not unique"),
        ((*TWO, joint("j", "bsae", "a")), r"'j' has an unknown parent link 'bsae'(.|\n)*did you mean 'base'"),
        ((*TWO, joint("j", "base", "c")), "'j' has an unknown child link 'c'"),
        ((*TWO, joint("j", "base", "a")), r"form several trees(.|\n)*got: base, b"),
        ((*TWO, joint("j", "a", "b"), joint("k", "b", "a")), "joint 'j' is part of a cycle"),
        ((*TWO[1:], joint("j", "a", "b"), joint("k", "b", "a")), "joint 'j' is part of a cycle"),
        (
            (*TWO, joint("j", "base", "a"), joint("k", "a", "b"), joint("l", "base", "b")),
            "'b' is the child of several joints",
        ),
        (('<link name="base"/>', "<link/>"), "a <link> has no usable name"),
        ((*TWO, '<joint type="fixed"/>'), "a <joint> has no usable name"),
        ((*TWO, '<joint name="j"/>'), "joint 'j' has no type"),
        ((*TWO, '<joint name="j" type="fixed"><parent link="a"/></joint>'), "joint 'j' has no <child>"),
        ((*TWO, '<joint name="j" type="fixed"><parent/></joint>'), "joint 'j': <parent> has no link"),
        (
            (*TWO, '<joint name="j" type="fixed"><parent link="a"/><parent link="b"/></joint>'),
            "'j' has several <parent>",
        ),
        (('<xacro:macro xmlns:xacro="http://www.ros.org/wiki/xacro"/>',), "xacro macros(.|\n)*got: <macro>"),
        (("<xacro:arm/>",), "xacro macros(.|\n)*expand them first: xacro"),  # no namespace: no XML either
        ((link("${prefix}base"),), r"xacro macros(.|\n)*got: \$\{prefix\}base"),
    ],
)
def test_structure_is_checked(tmp_path: Path, parts: tuple[str, ...], message: str) -> None:
    with pytest.raises(RobotFileError, match=r"robot\.urdf: (.|\n)*" + message):
        forcegp.load_robot(write(tmp_path, *parts))


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        ('<axis xyz="0 0 0"/>', "joint 'j' has an axis of length zero"),
        ('<axis xyz="0 nan 1"/>', "joint 'j': axis xyz is not valid"),
        ('<axis xyz="0 1"/>', r"joint 'j': axis xyz is not valid(.|\n)*expected: 3 finite(.|\n)*got: '0 1'"),
        ('<origin xyz="0 0 1e400"/>', "joint 'j': origin xyz is not valid"),
        ('<origin rpy="a b c"/>', "joint 'j': origin rpy is not valid"),
        (
            '<limit lower="1" upper="-1"/>',
            r"has its lower limit above its upper limit(.|\n)*got: \(1.0, -1.0\)",
        ),
        ('<limit upper="nan"/>', "joint 'j': limit upper is not valid"),
        ('<limit effort="-3"/>', "joint 'j' has a negative limit"),
        ('<dynamics damping="-0.1"/>', "joint 'j' has negative friction"),
        ('<dynamics friction="much"/>', "joint 'j': dynamics friction is not valid"),
        ('<mimic joint="i" multiplier="much"/>', "joint 'j': mimic multiplier is not valid"),
        ('<mimic joint="i" offset="nan"/>', "joint 'j': mimic offset is not valid"),
        ("<mimic>i</mimic>", "joint 'j': <mimic> has no joint"),
        ('<origin rpy="0 0 ${pi/2}"/>', r"xacro macros that are not expanded(.|\n)*got: 0 0 \$\{pi/2\}"),
    ],
)
def test_joint_figures_are_checked(tmp_path: Path, rest: str, message: str) -> None:
    with pytest.raises(RobotFileError, match=message):
        forcegp.load_robot(arm(tmp_path, rest))


@pytest.mark.parametrize("kind", ["floating", "planar", "ball", "spherical"])
def test_unsupported_joints_are_refused_by_name(tmp_path: Path, kind: str) -> None:
    with pytest.raises(UnsupportedRobotError, match=rf"joint 'j' is of type '{kind}'"):
        forcegp.load_robot(arm(tmp_path, kind=kind))


def test_mimic_joint_is_refused_unless_locked(tmp_path: Path) -> None:
    mimic = '<mimic joint="i"/><axis xyz="0 0 2"/><origin xyz="0 0 1"/>'
    path = write(tmp_path, *TWO, joint("i", "base", "a"), joint("j", "a", "b", mimic))
    with pytest.raises(UnsupportedRobotError, match=r"'j' mimics joint 'i'(.|\n)*={'i': 0.0, 'j': 0.0}"):
        forcegp.load_robot(path)
    with pytest.raises(UnknownNameError, match=r"unknown joint of .*robot\.urdf to lock 'jj'"):
        forcegp.load_robot(path, locked_joints={"jj": 0.0})
    with pytest.raises(RobotFileError, match="'j' cannot be locked"):
        forcegp.load_robot(path, locked_joints={"j": float("nan")})
    with pytest.warns(RobotFileWarning, match="'j' is locked at 0.7, and in the file follows 'i'"):
        robot = forcegp.load_robot(path, locked_joints={"j": 0.7})
    rotation, position = kinematics.frame_pose(robot, torch.zeros(1, dtype=robot.dtype), "b")
    np.testing.assert_allclose(rotation, Rotation.from_rotvec([0, 0, 0.7]).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(position, [0, 0, 1])


def test_the_hint_for_a_gripper_locks_leader_and_follower_within_their_limits(tmp_path: Path) -> None:
    slide = '<axis xyz="0 1 0"/><limit lower="0.01" upper="0.04"/>'
    follower = f'{slide}<mimic joint="left" multiplier="-2" offset="0.1"/>'
    path = write(
        tmp_path,
        *TWO,
        link("c"),
        joint("arm", "base", "a"),
        joint("left", "a", "b", slide, "prismatic"),
        joint("right", "a", "c", follower, "prismatic"),
    )
    with pytest.raises(UnsupportedRobotError, match="'right' mimics joint 'left'") as caught:
        forcegp.load_robot(path)
    hint = caught.value.args[0].partition("locked_joints=")[2]
    locked = {"left": 0.01, "right": 0.08}
    assert hint.startswith(str(locked))
    assert forcegp.load_robot(path, locked_joints=locked).joint_names == ("arm",)


def test_an_undeclared_world_is_the_base_with_a_remark(tmp_path: Path) -> None:
    """Drake attaches a robot to its world by a fixed joint, without declaring a link of that name."""
    weld = joint("weld", "world", "base", '<origin xyz="0 0 0.5"/>', "fixed")
    path = write(tmp_path, *TWO[:2], joint("j", "base", "a"), weld)
    with pytest.warns(RobotFileWarning, match="link 'world' is used but not declared"):
        robot = forcegp.load_robot(path)
    assert len(robot.remarks) == 1 and robot.joint_names == ("j",)
    zero = torch.zeros(1, dtype=robot.dtype)
    np.testing.assert_array_equal(kinematics.frame_pose(robot, zero, "a")[1], [0, 0, 0.5])
    np.testing.assert_array_equal(kinematics.frame_pose(robot, zero, "world")[1], [0, 0, 0])
    declared = write(tmp_path, '<link name="world"/>', *TWO[:2], joint("j", "base", "a"), weld)
    assert not forcegp.load_robot(declared).remarks
    moving = write(tmp_path, *TWO[:2], joint("j", "base", "a"), joint("k", "world", "base"))
    with pytest.raises(RobotFileError, match="unknown parent link 'world'"):
        forcegp.load_robot(moving)


def test_meshes_that_are_missing_do_not_matter(tmp_path: Path) -> None:
    mesh = '<geometry><mesh filename="package://nowhere/hand.stl" scale="1 1 1"/></geometry>'
    path = arm(tmp_path)
    path.write_text(path.read_text().replace("</inertial>", f"</inertial><visual>{mesh}</visual>", 1))
    path.write_text(path.read_text().replace("</visual>", f"</visual><collision>{mesh}</collision>", 1))
    assert "nowhere" in path.read_text()
    assert forcegp.load_robot(path).remarks == ()


def test_urdf_needs_no_mujoco(tmp_path: Path) -> None:
    """MuJoCo is optional: it is imported for MJCF only, and its absence is one error that says what to do."""
    (tmp_path / "arm.xml").write_text("<mujoco><worldbody/></mujoco>")
    code = f"""
import sys
sys.modules["mujoco"] = None  # as if it were not installed
import forcegp
import forcegp.robot.write_back
assert forcegp.load_robot("kuka_iiwa").nq == 7
try:
    forcegp.load_robot({str(tmp_path / "arm.xml")!r})
except forcegp.errors.MissingDependencyError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("Reading MJCF files needs the package 'mujoco'")
    assert 'pip install "forcegp[mujoco]"' in done.stdout


def _inertia(*moments: object) -> str:
    return '<inertia ixx="{}" ixy="{}" ixz="{}" iyy="{}" iyz="{}" izz="{}"/>'.format(*moments)


@pytest.mark.parametrize(
    ("inertia", "message"),
    [
        (
            _inertia(-0.1, 0, 0, 0.1, 0, 0.1),
            "link 'hand' is not physical(.|\n)*a principal moment is -0.1 kg",
        ),
        (
            _inertia(0.1, 0.2, 0, 0.1, 0, 0.1),
            "link 'hand' is not physical(.|\n)*a principal moment is -0.1 kg",
        ),
        (_inertia("nan", 0, 0, 0.1, 0, 0.1), "link 'hand': inertia ixx is not valid"),
        ('<inertia ixx="1"/>', "link 'hand': <inertia> has no ixy"),
        ("", "link 'hand' has an <inertial> without <inertia>"),
        (_inertia(0, 0, 0, 0, 0, 0), "link 'hand' of joint 'j' moves without inertia"),
    ],
)
def test_unphysical_inertia_is_refused(tmp_path: Path, inertia: str, message: str) -> None:
    with pytest.raises(InertiaError, match=message):
        forcegp.load_robot(arm(tmp_path, inertia=inertia))


@pytest.mark.parametrize(
    ("value", "message"),
    [("-2", "the mass -2 kg is negative"), ("inf", "mass value is not valid"), ("", "<mass> has no value")],
)
def test_unphysical_mass_is_refused(tmp_path: Path, value: str, message: str) -> None:
    path = arm(tmp_path)
    path.write_text(path.read_text().replace('mass value="1"', f'mass value="{value}"'))
    with pytest.raises(InertiaError, match=message):
        forcegp.load_robot(path)


def test_singular_mass_matrix_is_refused_by_link(tmp_path: Path) -> None:
    """A massless link between two hinges on one axis spins freely; on two axes it does not."""
    parts = '<link name="base"/>', '<link name="loose"/>', link("hand")
    joints = joint("i", "base", "loose"), joint("j", "loose", "hand", '<axis xyz="{}"/>')
    with pytest.raises(InertiaError, match=r"link '(loose|hand)' of joint '(i|j)' moves without inertia"):
        forcegp.load_robot(write(tmp_path, *parts, *joints[:1], joints[1].format("1 0 0")))
    assert forcegp.load_robot(write(tmp_path, *parts, *joints[:1], joints[1].format("0 1 0"))).nq == 2


@pytest.mark.filterwarnings("ignore::forcegp.errors.RobotFileWarning")
def test_doubtful_inertia_of_published_files_is_remarked_on(tmp_path: Path) -> None:
    path = example_data() / "allegro_hand_description/urdf/allegro_right_hand.urdf"
    with pytest.warns(RobotFileWarning, match=r"'link_3.0' is not physical: .* triangle inequality"):
        robot = forcegp.load_robot(path)
    assert len(robot.remarks) == 4
    path = arm(tmp_path)
    path.write_text(path.read_text().replace('mass value="1"', 'mass value="0"'))
    with pytest.warns(
        RobotFileWarning, match="'hand' is not physical: it has a rotational inertia .* no mass"
    ):
        forcegp.load_robot(path)


def test_joint_figures_are_read(tmp_path: Path) -> None:
    rest = (
        '<axis xyz="0 3 4"/><limit lower="-0.5" upper="inf" effort="7" velocity="3"/>'
        '<dynamics damping="0.2" friction="0.4"/>'
    )
    robot = forcegp.load_robot(arm(tmp_path, rest, kind="prismatic"), dtype=torch.float32)
    assert robot.dtype == torch.float32
    assert robot.joint_types == ("prismatic",)
    assert robot.axis[0].tolist() == pytest.approx([0.0, 0.6, 0.8])
    fields = "lower", "upper", "effort_limit", "velocity_limit", "damping", "friction"
    values = [getattr(robot, field).item() for field in fields]
    assert values == pytest.approx([-0.5, np.inf, 7.0, 3.0, 0.2, 0.4])


@pytest.mark.parametrize("name", ["base_position", "base_rpy", "gravity"])
@pytest.mark.parametrize("value", [(1, 2), (0, 0, float("nan")), (), (1e400, 0.0, 0.0)])
def test_options_are_checked(name: str, value: object) -> None:
    with pytest.raises(ShapeError, match=f"{name} is not valid"):
        forcegp.load_robot("kuka_iiwa", **{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("file", "limbs"),
    [
        ("anymal_b_simple_description/robots/anymal.urdf", 4),
        ("hyq_description/robots/hyq_no_sensors.urdf", 4),
        ("solo_description/robots/solo.urdf", 4),
        ("allegro_hand_description/urdf/allegro_right_hand.urdf", 0),
        ("ur_description/urdf/ur5_robot.urdf", 0),
        ("tiago_description/robots/tiago_no_hand.urdf", 0),
    ],
)
def test_a_walking_robot_without_a_base_joint_is_said_to_be_held(file: str, limbs: int) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        robot = forcegp.load_robot(example_data() / file)
    held = [str(w.message) for w in caught if "no joint connects the base" in str(w.message)]
    assert len(held) == (1 if limbs else 0)
    assert all(f"with {limbs} limbs" in text and "floating base" in text for text in held)
    assert [text for text in robot.remarks if "no joint connects" in text] == held


@pytest.mark.parametrize(
    ("head", "extra"),
    [
        ('<robot name="r" xmlns="http://www.ros.org">', ""),
        ('<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">', ""),
        ('<robot name="r">', '<gazebo><sensor:camera name="c"><a:b c:d="1"/></sensor:camera></gazebo>'),
        ('<robot name="r" xsi:schemaLocation="x y">', '<controller:gripper controller:name="g"/>'),
    ],
)
def test_default_and_undeclared_namespaces_have_no_meaning(tmp_path: Path, head: str, extra: str) -> None:
    path = arm(tmp_path)
    plain = forcegp.load_robot(path)
    path.write_text(path.read_text().replace('<robot name="r">', head + extra))
    assert forcegp.load_robot(path).fingerprint == plain.fingerprint
    written = write_robot(plain.replace(mass=2.0 * plain.mass), path, tmp_path / "out.urdf")
    assert {change.figure for change in written.changes} >= {"mass"}
    assert head + extra in (tmp_path / "out.urdf").read_text()


ZERO = '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>'


def _on_axis(turn: str, mounted: str) -> list[str]:
    """An arm whose last link is a point mass on the axis of the last joint `w`, up to rounding."""
    tool = f'<origin xyz="0 0.12 0" rpy="0 0 0"/>{ZERO}'
    return [
        '<link name="base"/>',
        link("upper"),
        link("wrist", ZERO if mounted == "direct" else BALL) if mounted != "tool" else '<link name="wrist"/>',
        link("tool", tool) if mounted == "tool" else "",
        joint(
            "s", "base", "upper", f'<origin xyz="0.3 0.2 0.7" rpy="{turn}"/><axis xyz="0 0 1"/>', "continuous"
        ),
        joint(
            "w",
            "upper",
            "wrist",
            f'<origin xyz="0.1 0 0.31" rpy="{turn}"/><axis xyz="0.6 0 0.8"/>',
            "continuous",
        ),
        joint("f", "wrist", "tool", '<origin xyz="0.072 -0.12 0.096"/>', "fixed")
        if mounted == "tool"
        else "",
    ]


@pytest.mark.parametrize("turn", ["0 0 0", "1.5707963267948966 0 0.3", "1.5708 -1.5708 0", "0.1 0.7 -2.3"])
@pytest.mark.parametrize("mounted", ["direct", "tool"])
def test_mass_on_the_axis_of_a_joint_is_no_inertia(tmp_path: Path, turn: str, mounted: str) -> None:
    """Its moment is zero up to rounding. With an inertia of 1e-7 kg m² the arm loads."""
    path = write(tmp_path, *_on_axis(turn, mounted))
    with pytest.raises(InertiaError, match="of joint 'w' moves without inertia"):
        forcegp.load_robot(path)
    assert forcegp.load_robot(path, locked_joints={"w": 0.1}).nq == 1
    small = ZERO.replace('"0"', '"1e-7"').replace('xy="1e-7"', 'xy="0"').replace('xz="1e-7"', 'xz="0"')
    path.write_text(path.read_text().replace(ZERO, small.replace('yz="1e-7"', 'yz="0"')))
    assert forcegp.load_robot(path).nq == 2


def test_a_robot_without_masses_is_refused_and_no_page_promises_otherwise(tmp_path: Path) -> None:
    links = (f'<link name="{name}"/>' for name in ("base", "upper", "lower"))
    path = write(tmp_path, *links, joint("a", "base", "upper"), joint("b", "upper", "lower"))
    with pytest.raises(InertiaError, match=r"moves without inertia(.|\n)*<inertial>, at least an estimate"):
        forcegp.load_robot(path)
    pages = Path(__file__).resolve().parents[2] / "docs"
    lines = [line for page in pages.rglob("*.md") for line in page.read_text(encoding="utf-8").splitlines()]
    assert not [line for line in lines if "sgp-zero" in line and "kinematics" in line]
