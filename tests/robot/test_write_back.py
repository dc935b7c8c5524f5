"""Robot files edited in place: what was asked for is in them, and nothing else has changed."""

import difflib
import re
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest
import torch
from scipy.integrate import solve_ivp

import forcegp
from forcegp.errors import RobotFileError, RobotFileWarning
from forcegp.robot.edit_xml import EditableXml
from forcegp.robot.inertia import from_pseudo_inertia, pseudo_inertia
from forcegp.robot.load import robot_path
from forcegp.robot.model import RobotModel
from forcegp.robot.write_back import write_robot

CLASSES = """<?xml version="1.0"?>
<!-- an arm
     with a comment -->
<mujoco model='arm'>
  <compiler angle="radian"/>
  <default>
    <default class="big"> <joint damping="2" armature="0.1" frictionloss="0.3"/> </default>
  </default>
  <worldbody>
    <body name="base" childclass="big">
      <inertial pos="0 0 0.1" mass="2" diaginertia="0.02 0.02 0.01"/>
      <joint name="a" axis="0 0 1"   pos="0.1 0 0"/>
      <geom type="sphere" size="0.1"/>
      <body name="arm" pos="0 0 0.3" euler="0.3 0 0">
        <inertial pos="0.1 0 0" mass="1" quat="0.9 0.1 0.2 0.1" diaginertia="0.02 0.015 0.01"/>
        <joint name="b" axis="0 1 0" damping="0.5"/>
        <body name="hand" pos="0.3 0 0">
          <joint name="c" type="slide" axis="1 0 0"/>
          <geom type="box" size="0.05 0.02 0.03"/>
        </body>
        <body name="plate" pos="0 0.2 0"><inertial pos="0 0 0" mass="0.2" euler="0.1 0.2 0.3"
              diaginertia="0.001 0.001 0.001"/></body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
SAME = 1e-9
"""Relative error of figures that are written with twelve digits."""


def changed(robot: RobotModel, size: float = 0.1) -> RobotModel:
    """Another robot of the same joints, whose links are those of some mass distribution."""
    generator = torch.Generator().manual_seed(0)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    J = pseudo_inertia(robot.mass, robot.com, robot.inertia)
    E = torch.eye(4, dtype=torch.float64) + size * noise(robot.nq, 4, 4)
    mass, com, inertia = from_pseudo_inertia(E @ J @ E.mT)
    return robot.replace(
        mass=mass,
        com=com,
        inertia=inertia,
        damping=robot.damping + noise(robot.nq).abs(),
        friction=robot.friction + noise(robot.nq).abs(),
    )


def differences(before: Path, after: Path) -> list[str]:
    lines = difflib.unified_diff(
        before.read_text().splitlines(), after.read_text().splitlines(), lineterm="", n=0
    )
    return [line for line in lines if line[:1] in "+-" and line[:3] not in ("+++", "---")]


@pytest.mark.parametrize("name", ["franka_panda", "kuka_iiwa14"])
def test_urdf_holds_the_robot_and_keeps_its_text(name: str, tmp_path: Path) -> None:
    robot = changed(forcegp.load_robot(name))
    out = tmp_path / "out.urdf"
    written = write_robot(robot, name, out)
    read = forcegp.load_robot(out)
    for figure in ("mass", "com", "inertia", "damping", "friction"):
        torch.testing.assert_close(getattr(read, figure), getattr(robot, figure), rtol=SAME, atol=1e-12)
    edited = ("<mass", "<inertia ", "<origin", "<dynamics")
    assert all(line[1:].strip().startswith(edited) for line in differences(robot_path(name), out))
    assert {change.figure for change in written.changes} >= {"mass", "damping", "friction"}
    # The mass matrix by another library.
    model = pinocchio.buildModelFromUrdf(str(out))  # pyright: ignore[reportAttributeAccessIssue]
    q = torch.linspace(-0.5, 0.5, robot.nq, dtype=torch.float64)
    M = pinocchio.crba(model, model.createData(), q.numpy())  # pyright: ignore[reportAttributeAccessIssue]
    torch.testing.assert_close(
        torch.from_numpy(M).triu(), forcegp.dynamics.mass_matrix(robot, q).triu(), rtol=1e-8, atol=1e-10
    )


def test_what_did_not_change_keeps_every_byte(tmp_path: Path) -> None:
    for name in ("kuka_iiwa14", "ur5"):
        out = tmp_path / "same.urdf"
        written = write_robot(forcegp.load_robot(name), name, out)
        assert written.changes == () and out.read_bytes() == robot_path(name).read_bytes()


@pytest.mark.parametrize("included", [False, True])
def test_mjcf_with_defaults_and_turned_inertias(included: bool, tmp_path: Path) -> None:
    """Joint classes, an inertia from geoms, a quaternion, Euler angles, and a body fixed to another."""
    path, out = tmp_path / "arm.xml", tmp_path / "out.xml"
    text = CLASSES
    if included:
        head, rest = CLASSES.split("  <default>\n", 1)
        classes, tail = rest.split("\n  </default>\n", 1)
        text = f'{head}  <include file="classes.xml"/>\n{tail}'
        (tmp_path / "classes.xml").write_text(f"<mujocoinclude><default>{classes}</default></mujocoinclude>")
    path.write_text(text)
    robot = changed(forcegp.load_robot(path), 0.02)
    robot = robot.replace(armature=robot.armature + 0.05)
    written = write_robot(robot, path, out)
    read = forcegp.load_robot(out)
    for figure in ("mass", "com", "inertia", "damping", "friction", "armature"):
        torch.testing.assert_close(getattr(read, figure), getattr(robot, figure), rtol=1e-8, atol=1e-10)
    assert written.losses == ()
    # Without inertial elements and the identified attributes of joints, both texts are the same.
    identified = r'\s*<inertial[^>]*/>|\s+(damping|frictionloss|armature)="[^"]*"(?=[^>]*/>)'
    before, after = (re.sub(identified, "", p.read_text()) for p in (path, out))
    assert after == before and 'childclass="big"' in after
    model = mujoco.MjModel.from_xml_path(str(out))  # pyright: ignore[reportAttributeAccessIssue]
    torch.testing.assert_close(torch.from_numpy(model.dof_damping), robot.damping)
    torch.testing.assert_close(torch.from_numpy(model.dof_armature), robot.armature)


def test_fixed_links_share_a_change_that_none_can_take(tmp_path: Path) -> None:
    """Two equal halves of a link, which becomes lighter than either half."""
    half = (
        '<inertial><origin xyz="0 0 {z}"/><mass value="1"/>'
        '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>'
    )
    path, out = tmp_path / "halves.urdf", tmp_path / "out.urdf"
    path.write_text(
        f'<robot name="r"><link name="base"/><link name="a">{half.format(z=0.1)}</link>'
        f'<link name="b">{half.format(z=-0.1)}</link>'
        '<joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>'
        '<joint name="f" type="fixed"><parent link="a"/><child link="b"/></joint></robot>'
    )
    robot = forcegp.load_robot(path)
    lighter = robot.replace(mass=0.3 * robot.mass, inertia=0.3 * robot.inertia)
    written = write_robot(lighter, path, out)
    masses = {change.element: change.after for change in written.changes if change.figure == "mass"}
    assert masses == pytest.approx({"a": 0.3, "b": 0.3})
    torch.testing.assert_close(forcegp.load_robot(out).inertia, lighter.inertia)


def test_refusals_leave_no_file(tmp_path: Path) -> None:
    robot, out = forcegp.load_robot("kuka_iiwa14"), tmp_path / "out.urdf"
    with pytest.raises(RobotFileError, match="joints differ from those of the robot"):
        write_robot(robot, "ur5", out)
    path = tmp_path / "arm.xml"
    path.write_text(CLASSES)
    (tmp_path / "outer.xml").write_text('<mujoco><include file="arm.xml"/></mujoco>')
    outer = forcegp.load_robot(tmp_path / "outer.xml")
    with pytest.raises(RobotFileError, match="is not in this file"):
        write_robot(outer.replace(damping=outer.damping + 1.0), tmp_path / "outer.xml", out)
    path.write_text(CLASSES.replace('angle="radian"', 'angle="radian" boundmass="0.15"'))
    bounded = forcegp.load_robot(path)
    with pytest.raises(RobotFileError, match="this would change the mass of joint 'c'"):
        write_robot(bounded.replace(mass=0.5 * bounded.mass), path, out)
    assert not out.exists()


def test_an_edit_of_text_with_other_alphabets_and_quotes() -> None:
    """Positions are bytes; values are escaped; an element without children opens."""
    document = EditableXml("<r a='ä'><ü x=\"1\"/><!-- <no x='2'/> --></r>".encode(), "file")
    (child,) = document.root.children
    document.set(document.root, "a", 'b"<')
    document.set(child, "x", "2")
    document.set(child, "y", "3")
    document.add_child(child, "z", {"q": "4"})
    assert document.written().decode() == (
        '<r a=\'b"&lt;\'><ü x="2" y="3">\n  <z q="4"/>\n</ü><!-- <no x=\'2\'/> --></r>'
    )
    with pytest.raises(RobotFileError, match="cannot be edited in place"):
        EditableXml("<r a='ä'/>".encode("utf-16"), "file")


@pytest.mark.parametrize("size", [1e-9, 1e-7, 1e-6, 1e-5])
@pytest.mark.parametrize("source", ["kuka_iiwa14", "ur5"])
def test_a_small_change_is_written_or_left_but_not_refused(source: str, size: float, tmp_path: Path) -> None:
    """A mass of kilograms does not hide changes of a wrist's inertia."""
    wanted = changed(forcegp.load_robot(source), size)
    write_robot(wanted, source, tmp_path / "small.urdf")
    found = forcegp.load_robot(tmp_path / "small.urdf")
    sizes = wanted.inertia.abs().flatten(1).amax(-1) + 1e-7
    assert bool(((found.inertia - wanted.inertia).abs().flatten(1).amax(-1) <= 1e-5 * sizes).all())


FRAMES = """<mujoco model="two_arms">
  <worldbody>
    <frame pos="0.5 0 0" euler="0 0 30">
      <body>
        <frame euler="0 90 0"><joint axis="0 0 1"/></frame>
        <inertial pos="0 0 .1" mass="1" diaginertia=".1 .1 .05"/>
        <body name="body_1" pos="0 0 .2">
          <joint name="joint_0" axis="0 1 0" armature="0.02"/><geom size="0.1" pos="0 0.1 0"/>
        </body>
      </body>
    </frame>
  </worldbody>
  <worldbody>
    <body name="other" pos="1 0 0"><joint name="j" axis="0 1 0"/><geom size="0.1" pos="0 0.1 0"/></body>
  </worldbody>
  <actuator><motor joint="joint_0" gear="2" armature="0.1" damping="0.2"/></actuator>
</mujoco>
"""


def test_mjcf_with_frames_unnamed_bodies_actuators_and_two_worldbodies(tmp_path: Path) -> None:
    """Names of unnamed bodies do not hide others, and what an actuator adds is not written to its joint."""
    path, out = tmp_path / "arm.xml", tmp_path / "out.xml"
    path.write_text(FRAMES)
    file = forcegp.load_robot(path)
    robot = changed(file, 0.02)
    robot = robot.replace(armature=robot.armature + 0.05)
    write_robot(robot, path, out)
    read = forcegp.load_robot(out)
    for figure in ("mass", "com", "inertia", "damping", "friction", "armature"):
        torch.testing.assert_close(getattr(read, figure), getattr(robot, figure), rtol=1e-8, atol=1e-10)
    model = mujoco.MjModel.from_xml_path(str(out))  # pyright: ignore[reportAttributeAccessIssue]
    torch.testing.assert_close(
        torch.from_numpy(model.dof_armature), robot.armature - torch.tensor([0, 0.4, 0])
    )
    with pytest.raises(RobotFileError, match="armature of joint 'joint_0' is below that of its actuators"):
        write_robot(robot.replace(armature=0.1 * robot.armature), path, out)
    inside = FRAMES.replace("<inertial", '<frame pos="1 0 0"><inertial').replace('.05"/>', '.05"/></frame>')
    path.write_text(inside)
    with pytest.raises(RobotFileError, match="<inertial> of body 'body_1_' is inside a <frame>"):
        write_robot(changed(forcegp.load_robot(path), 0.02), path, out)


CURVED = """<mujoco model="arm">
  <option timestep="0.0002"/>
  <default><joint damping="0.1 0.3 0.2"/></default>
  <worldbody>
    <body name="one" childclass="main">
      <joint name="a" axis="0 1 0" armature="0.1" frictionloss="0.4"/>
      <inertial pos="0.1 0 -0.3" mass="1" diaginertia="0.02 0.02 0.01"/>
      <body name="two" pos="0 0 -0.5">
        <joint axis="0 1 0" armature="0.1"/><inertial pos="0 0 -0.2" mass="1" diaginertia="0.02 0.02 0.01"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="t" frictionloss="0.1"><joint joint="a" coef="-2"/></fixed></tendon>
  <actuator><motor joint="a" name="m"/><general joint="a" name="f" dyntype="filter" dynprm="0.1"/></actuator>
  <keyframe><key qpos="0 0" act="0.5"/></keyframe>
</mujoco>
"""


def bent(robot: RobotModel, **changes: list) -> RobotModel:
    """A robot whose joints have dry friction with memory and polynomial damping."""
    law = {"damping": [0.3, 0.2], "drag": [[0.0, 0.0], [-0.1, 0.3]], "friction": [1.5, 0.8]}
    law |= {"stribeck": [0.5, 0.0], "stribeck_velocity": [0.2, 0.1], "bristle": [150.0, 40.0]} | changes
    return robot.replace(**{name: torch.tensor(x, dtype=torch.float64) for name, x in law.items()})


def test_mjcf_holds_polynomial_damping_and_friction_with_memory(tmp_path: Path) -> None:
    """What MuJoCo simulates from the written file is M q̈ = Q with LuGre's bristles, by another integrator."""
    path, out = tmp_path / "arm.xml", tmp_path / "out.xml"
    path.write_text(CURVED)
    robot = bent(forcegp.load_robot(path))
    written = write_robot(robot, path, out)
    assert written.losses == ()
    changed = {(change.element, change.figure) for change in written.changes}
    assert ("a", "stribeck") in changed and ("joint_1", "bristle") in changed
    with pytest.warns(RobotFileWarning, match="LuGre friction"):
        read = forcegp.load_robot(out)
    for figure in ("damping", "drag", "friction", "stribeck", "bristle"):
        torch.testing.assert_close(getattr(read, figure), getattr(robot, figure), rtol=SAME, atol=1e-12)
    added = [line for line in differences(path, out) if line[0] == "+"]
    assert len(added) == 7 and sum("<dcmotor" in line for line in added) == 2
    model = mujoco.MjModel.from_xml_path(str(out))  # pyright: ignore[reportAttributeAccessIssue]
    assert model.nu == 2 and model.actuator(1).name == "f"  # controls are those of the file
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS  # pyright: ignore[reportAttributeAccessIssue]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    mujoco.mj_resetDataKeyframe(model, data, 0)  # pyright: ignore[reportAttributeAccessIssue]
    assert data.act.tolist() == [0.5, 0.0, 0.0]
    data.act[:] = 0.0

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        q, v, z = torch.from_numpy(x).view(3, 2)
        # The tendon has 0.2 of the dry friction of the first joint, which is off here.
        dry = robot.friction - robot.friction.new_tensor([0.2, 0.0])
        g = dry + robot.stribeck * torch.exp(-((v / robot.stribeck_velocity) ** 2))
        bend = v - robot.bristle * v.abs() / g * z
        viscous = forcegp.dynamics.damping_force(robot.replace(friction=0.0 * v, stribeck=0.0 * v), v)
        tau = viscous - robot.bristle * z + v.new_tensor([8.0 * np.sin(3.0 * t), 3.0 * np.sin(4.0 * t)])
        return torch.cat([v, forcegp.dynamics.forward_dynamics(bare, q, v, tau), bend]).numpy()

    bare = robot.replace(damping=0.0 * robot.damping, drag=None, friction=0.0 * robot.friction)
    bare = bare.replace(stribeck=0.0 * robot.stribeck)
    end = 1.5
    solved = solve_ivp(slope, (0.0, end), np.zeros(6), rtol=1e-8, atol=1e-9, max_step=2e-3)
    while data.time < end - 1e-9:
        data.qfrc_applied[:] = 8.0 * np.sin(3.0 * data.time), 3.0 * np.sin(4.0 * data.time)
        mujoco.mj_step(model, data)  # pyright: ignore[reportAttributeAccessIssue]
    moved = np.abs(solved.y[:2]).max()
    assert moved > 0.3  # rad, and the error is of the first order in the step of 0.2 ms
    np.testing.assert_allclose(data.qpos, solved.y[:2, -1], atol=2e-3 * moved)

    # Once more, into the file with the motors.
    again = tmp_path / "again.xml"
    write_robot(bent(read, stribeck=[0.0, 0.2], bristle=[90.0, 40.0]), out, again)
    assert again.read_text().count("<dcmotor") == 2
    with pytest.warns(RobotFileWarning):
        assert forcegp.load_robot(again).bristle.tolist() == pytest.approx([90.0, 40.0])  # pyright: ignore


def test_what_a_file_cannot_hold_of_friction_is_a_loss_or_refused(tmp_path: Path) -> None:
    path, out = tmp_path / "arm.xml", tmp_path / "out.xml"
    urdf = bent(forcegp.load_robot("double_pendulum"))
    losses = write_robot(urdf, "double_pendulum", tmp_path / "out.urdf").losses
    for figure in ("quadratic damping (0, -0.1)", "cubic damping (0, 0.3)", "stribeck (0.5, 0)", "bristle"):
        assert any(f"does not support {figure}" in loss for loss in losses)
    lugre = ' dyntype="dcmotor" gaintype="dcmotor" biastype="dcmotor" gainprm="1 1"'
    lugre = lugre + ' dynprm="0 0 0 0 0 30" biasprm="0 0 0 1 1 1"'
    path.write_text(CURVED.replace(' dyntype="filter" dynprm="0.1"', lugre))
    with pytest.warns(RobotFileWarning):
        robot = forcegp.load_robot(path)
    with pytest.raises(RobotFileError, match="joint 'a' with LuGre friction cannot be edited"):
        write_robot(bent(robot), path, out)
    with (
        pytest.warns(RobotFileWarning),
        pytest.raises(RobotFileError, match="change the bristle of joint 'a'"),
    ):
        write_robot(robot.replace(bristle=None), path, out)
