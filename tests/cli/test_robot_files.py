"""Robot files as they come: an undeclared world, missing meshes, grippers, macros, each by the commands."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import forcegp
from forcegp.cli import app, main
from forcegp.errors import RobotFileWarning

LINK = """<link name="{0}"><inertial><origin xyz="0 0 {2}"/><mass value="{1}"/>
<inertia ixx="{3}" ixy="0" ixz="0" iyy="{3}" iyz="0" izz="{3}"/></inertial>{4}</link>"""
MESHES = """<visual><geometry><mesh filename="package://nowhere/arm.stl"/></geometry></visual>
<collision><geometry><mesh filename="missing.dae"/></geometry></collision>"""
ARM = f"""<robot name="arm"><link name="base"/>{LINK.format("link", 2.0, 0.2, 0.02, MESHES)}
<joint name="weld" type="fixed"><parent link="world"/><child link="base"/></joint>
<joint name="swing" type="revolute"><parent link="base"/><child link="link"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="20" velocity="5"/></joint>"""
FINGER = """<joint name="{0}" type="prismatic"><parent link="link"/><child link="{0}_link"/>
<origin xyz="0 0 0.4"/><axis xyz="0 1 0"/><limit lower="0.01" upper="0.04" effort="9" velocity="1"/>
{1}</joint>"""
MIMIC = '<mimic joint="left" multiplier="-1" offset="0.05"/>'
GRIPPER = (
    ARM
    + "".join(LINK.format(f"{side}_link", 0.1, 0.0, 1e-4, "") for side in ("left", "right"))
    + FINGER.format("left", "")
    + FINGER.format("right", "{0}")
    + "</robot>"
)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A swing of the arm, of which nothing but its joint was logged."""
    (tmp_path / "arm.urdf").write_text(ARM + "</robot>")
    with pytest.warns(RobotFileWarning, match="'world' is used but not declared"):
        robot = forcegp.load_robot(tmp_path / "arm.urdf")
    t = np.arange(1200) / 200.0
    motion = [1.2 * np.sin(2.0 * t), 2.4 * np.cos(2.0 * t), -4.8 * np.sin(2.0 * t)]
    state = [torch.from_numpy(x)[:, None] for x in motion]
    tau = forcegp.dynamics.inverse_dynamics(robot, *state)[:, 0].numpy()
    path = tmp_path / "log.csv"
    names = ",".join(["t", *(f"{name}.swing" for name in ("q", "qd", "qdd", "tau"))])
    np.savetxt(path, np.column_stack([t, *motion, tau]), delimiter=",", header=names, comments="")
    return path


def run(*arguments: object) -> str:
    """Output of a command that succeeds, warnings included."""
    done = CliRunner().invoke(app, [*map(str, arguments)])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.output


def fail(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Message of a command that fails."""
    monkeypatch.setattr(sys, "argv", ["forcegp", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    out, err = capfd.readouterr()
    assert ended.value.code == 2 and out == "" and "Traceback" not in err
    return err


@pytest.mark.filterwarnings("ignore::forcegp.errors.RobotFileWarning")
def test_an_undeclared_world_and_missing_meshes_do_not_stop_a_fit(log: Path, tmp_path: Path) -> None:
    robot = tmp_path / "arm.urdf"
    assert "verdict: go on" in run("check", "--robot", robot, "--data", log)
    shown = run("fit", "--robot", robot, "-d", log, "-m", "analytical", "-o", tmp_path / "m")
    assert "analytical" in shown and "inference" not in shown, "what this model has no choice of is not shown"


@pytest.mark.filterwarnings("ignore::forcegp.errors.RobotFileWarning")
def test_a_gripper_that_mimics_is_locked_as_the_message_says(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    robot, scene = tmp_path / "gripper.urdf", tmp_path / "scene.toml"
    robot.write_text(GRIPPER.format(MIMIC))
    said = fail(monkeypatch, capfd, "check", "--robot", robot, "--data", log)
    assert (
        "joint 'right' mimics joint 'left'" in said and "locked_joints={'left': 0.01, 'right': 0.04}" in said
    )
    for locked in ("left = 0.01, right = 0.04", "left = 0.01"):
        scene.write_text(f'[robot]\nmodel = "gripper.urdf"\nlocked_joints = {{ {locked} }}\n')
        system = forcegp.load_scene(scene).system()
        fingers = [
            forcegp.kinematics.frame_pose(system.robot, torch.zeros(1).double(), f"{side}_link")[1][1]
            for side in ("left", "right")
        ]
        assert [float(y) for y in fingers] == pytest.approx([0.01, 0.04])
    assert "verdict" in run("check", "--scene", scene, "--data", log)


@pytest.mark.filterwarnings("ignore::forcegp.errors.RobotFileWarning")
def test_fingers_that_were_not_logged_are_locked_as_the_message_says(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    robot, scene, mapping = tmp_path / "gripper.urdf", tmp_path / "scene.toml", tmp_path / "mapping.toml"
    robot.write_text(GRIPPER.format(""))
    mapping.write_text(
        'time = { column = "t" }\njoints = { swing = "swing" }\n'
        'position = { column = "q.{joint}", unit = "rad" }\n'
        'torque = { column = "tau.{joint}", unit = "Nm" }\n'
    )
    imported = ("import", log, "--mapping", mapping, "-o", tmp_path / "log.parquet")
    said = fail(monkeypatch, capfd, "check", "--robot", robot, "--data", log)
    assert "joint 'left' of robot 'arm' is not in the data" in said
    lock = "locked_joints = { left = 0.0, right = 0.0 }"
    assert lock in said and "under [robot]" in said
    assert lock in fail(monkeypatch, capfd, *imported, "--robot", robot)
    scene.write_text(f'[robot]\nmodel = "gripper.urdf"\n{lock}\n')
    assert "1200 from 1200 logged" in run(*imported, "--scene", scene)
    assert "verdict" in run("check", "--scene", scene, "--data", tmp_path / "log.parquet")


def test_macros_that_are_not_expanded_are_named(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, text in (
        ("arm.urdf.xacro", ARM.replace('effort="20"', 'effort="${effort}"') + "</robot>"),
        (
            "arm.xacro",
            ARM.replace("<robot ", '<robot xmlns:xacro="http://ros.org/wiki/xacro" ')
            + "<xacro:arm/></robot>",
        ),
    ):
        (tmp_path / name).write_text(text)
        for command in (["check"], ["fit", "-o", tmp_path / "model"]):
            said = fail(monkeypatch, capfd, *command, "--robot", tmp_path / name, "--data", log)
            assert (
                "xacro macros that are not expanded" in said and "xacro robot.urdf.xacro > robot.urdf" in said
            )
