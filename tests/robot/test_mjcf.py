"""MJCF models: MuJoCo's own figures, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import forcegp
from forcegp import dynamics, kinematics
from forcegp.errors import InertiaError, RobotFileError, RobotFileWarning, UnsupportedRobotError
from forcegp.robot.load import BUNDLED
from robots import random_states

mujoco: Any = pytest.importorskip("mujoco")

RELATIVE = 1e-8  # MuJoCo diagonalises inertias on loading, which costs it some digits
BRANCHED = Path(__file__).parent / "data" / "branched.xml"
BODY = '<body name="arm"><joint name="hinge"/>{}<geom size="0.1"/></body>'


def load_text(folder: Path, body: str, rest: str = "", **options: object) -> forcegp.RobotModel:
    path = folder / "robot.xml"
    path.write_text(f"<mujoco>{rest}<worldbody>{body}</worldbody></mujoco>")
    return forcegp.load_robot(path, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def pair() -> tuple[forcegp.RobotModel, Any]:
    with pytest.warns(RobotFileWarning, match="site 'left_tip' shares its name"):
        robot = forcegp.load_robot(BRANCHED)
    text = BRANCHED.read_text().replace('<mesh name="cover" file="not_there.stl"/>', "")
    return robot, mujoco.MjModel.from_xml_string(text.replace('<geom type="mesh" mesh="cover"/>', ""))


def test_dynamics_equal_mujoco(pair: tuple[forcegp.RobotModel, Any]) -> None:
    robot, model = pair
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    q, qd, qdd, _ = random_states(robot, 5)
    for k in range(5):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        for column, unit in zip(M, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        ours = dynamics.mass_matrix(robot, q[k]).numpy()
        assert np.abs(ours - M).max() < RELATIVE * np.abs(M).max()
        data.qacc[:] = qdd[k]
        mujoco.mj_inverse(model, data)
        expected = data.qfrc_inverse + data.qfrc_passive
        tau = dynamics.inverse_dynamics(robot, q[k], qd[k], qdd[k]).numpy()
        assert np.abs(tau - expected).max() < RELATIVE * np.abs(expected).max()


def test_frames_of_bodies_and_sites_equal_mujoco(pair: tuple[forcegp.RobotModel, Any]) -> None:
    robot, model = pair
    data = mujoco.MjData(model)
    q = random_states(robot, 1, seed=3)[0][0]
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    places = {model.body(b).name: (data.xmat[b], data.xpos[b]) for b in range(model.nbody)}
    sites = {model.site(s).name: (data.site_xmat[s], data.site_xpos[s]) for s in range(model.nsite)}
    places |= {"site/left_tip" if name == "left_tip" else name: place for name, place in sites.items()}
    assert set(robot.frame_names) == set(places)
    for name, (rotation, position) in places.items():
        R, p = kinematics.frame_pose(robot, q, name)
        assert np.abs(R.numpy() - rotation.reshape(3, 3)).max() < RELATIVE, name
        assert np.abs(p.numpy() - position).max() < RELATIVE, name


def test_joint_figures_are_read(pair: tuple[forcegp.RobotModel, Any]) -> None:
    robot, _ = pair
    assert robot.joint_names == ("turn", "lift", "left_1", "right_1", "joint_4", "right_3")
    assert robot.joint_types == ("revolute", "prismatic", *["revolute"] * 4)
    assert robot.armature.tolist() == [0.02, 0.02, 0.0, 0.02, 0.02, 0.02]
    assert robot.damping.tolist() == [0.3] * 6
    assert robot.friction.tolist() == [0, 0.4, 0, 0, 0, 0]
    assert (robot.lower[:3].tolist(), robot.upper[:3].tolist()) == ([-1, -0.2, -np.inf], [1.5, 0.3, np.inf])
    assert robot.effort_limit.tolist() == [40, 40, 87, np.inf, np.inf, np.inf]


@pytest.mark.parametrize(
    ("body", "rest", "message"),
    [
        (
            '<body name="arm"><freejoint name="root"/><geom size="1"/></body>',
            "",
            "'root' of link 'arm' is a",
        ),
        (
            '<body name="arm"><joint name="b" type="ball"/><geom size="1"/></body>',
            "",
            "'b' .* ball joint",
        ),
        (
            '<body name="arm"><joint name="s" stiffness="3"/><geom size="1"/></body>',
            "",
            "'s' has a spring",
        ),
        ('<body name="arm" gravcomp="1"><joint/><geom size="1"/></body>', "", "body 'arm' has gravity comp"),
        (BODY.format('<replicate count="9"><site name="s"/></replicate>'), "", "'arm' has a <replicate>"),
        (BODY.format('<flexcomp name="f"/>'), "", "'arm' has a <flexcomp>"),
        (BODY.format('<composite type="cable"/>'), "", "'arm' has a <composite>"),
        (BODY.format('<plugin plugin="x"/>'), "", "'arm' has a <plugin>"),
        (BODY.format(""), "<extension/>", "<extension> is not supported"),
        (BODY.format(""), "<deformable/>", "<deformable> is not supported"),
        (
            BODY.format(""),
            '<equality><joint joint1="hinge"/></equality>',
            "'hinge' is held in place by",
        ),
        (BODY.format(""), '<equality><weld body1="arm"/></equality>', "constraint <weld> is not supported"),
        ('<body name="arm"><joint/><geom type="mesh" mesh="m"/></body>', "", "'arm' takes .* mesh 'm'"),
    ],
)
def test_unsupported_is_refused_by_name(tmp_path: Path, body: str, rest: str, message: str) -> None:
    with pytest.raises(UnsupportedRobotError, match=message):
        load_text(tmp_path, body, rest)


@pytest.mark.parametrize(
    ("inertial", "message"),
    [
        ('mass="-1" diaginertia="1 1 1"', "moving bodies must be larger.*'arm'"),
        ('mass="1" diaginertia="1 1 3"', r"A \+ B >= C.*'arm'"),
        ('mass="nan" diaginertia="1 1 1"', "<inertial> mass is not valid"),
        ('mass="1" diaginertia="1 inf 1"', "<inertial> diaginertia is not valid"),
    ],
)
def test_unphysical_inertia_is_refused(tmp_path: Path, inertial: str, message: str) -> None:
    with pytest.raises(InertiaError, match=message):
        load_text(tmp_path, BODY.format(f'<inertial pos="0 0 0" {inertial}/>'))


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e300"])
def test_numbers_that_mujoco_lets_through_are_refused(tmp_path: Path, number: str) -> None:
    with pytest.raises(RobotFileError, match="<joint> 'j' damping is not valid"):
        load_text(tmp_path, f'<body><joint name="j" damping="{number}"/><geom size="1"/></body>')


def test_mujoco_error_is_passed_on_with_its_cause(tmp_path: Path) -> None:
    with pytest.raises(
        RobotFileError, match=r"MuJoCo's compiler rejects.*\n.*\n.*unrecognized attribute: 'nane'"
    ):
        load_text(tmp_path, '<body><joint nane="j"/><geom size="1"/></body>')


def test_warnings_of_mujoco_are_remarks_and_leave_no_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    twice = '<body name="b"><joint name="i"/><joint name="j"/><geom size="0.1"/></body>'
    with pytest.raises(InertiaError, match=r"link 'b/(i|j)' of joint '(i|j)' moves without inertia"):
        load_text(tmp_path, twice)
    with pytest.warns(RobotFileWarning, match="MuJoCo warns: Inertia matrix is too close to singular"):
        load_text(tmp_path, twice, locked_joints={"j": 0.0})
    assert [path.name for path in tmp_path.iterdir()] == ["robot.xml"]


def test_includes_come_from_the_same_folder_only_and_once(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(f"<mujocoinclude>{BODY.format('')}</mujocoinclude>")
    assert load_text(tmp_path, '<include file="arm.xml"/>').joint_names == ("hinge",)
    for name in ("/etc/passwd", "../arm.xml", "", ".", "none.xml", "arm\0.xml", "robot.xml"):
        with pytest.raises(RobotFileError, match=r"include of|not well-formed"):
            load_text(tmp_path, f'<include file="{name}"/>')
    (tmp_path / "arm.xml").write_text('<mujocoinclude><include file="arm.xml"/></mujocoinclude>')
    with pytest.raises(RobotFileError, match=r"include of 'arm.xml' is refused"):
        load_text(tmp_path, '<include file="arm.xml"/>')


def test_coupled_joint_can_be_locked(tmp_path: Path) -> None:
    finger = '<body name="f"><joint name="finger"/><geom size="0.1"/></body>'
    rest = '<equality><joint joint1="finger" joint2="hinge" polycoef="0.4 1 0 0 0"/></equality>'
    with pytest.raises(UnsupportedRobotError, match=r"locked_joints={'hinge': 0.0, 'finger': 0.4}"):
        load_text(tmp_path, BODY.format(finger), rest)
    robot = load_text(tmp_path, BODY.format(finger), rest, locked_joints={"finger": 0.4})
    assert robot.joint_names == ("hinge",)
    turn = kinematics.frame_pose(robot, torch.zeros(1, dtype=robot.dtype), "f")[0]
    assert turn[0, 0].item() == pytest.approx(np.cos(0.4))


@pytest.mark.parametrize("name", BUNDLED)
def test_urdf_and_the_mjcf_that_mujoco_makes_of_it_are_one_robot(tmp_path: Path, name: str) -> None:
    urdf = Path(forcegp.__file__).parent / "robot/bundled" / f"{name}.urdf"
    text = urdf.read_text().replace("</robot>", '<mujoco><compiler fusestatic="false"/></mujoco></robot>')
    spec = mujoco.MjSpec.from_string(text)
    spec.compile()
    path = tmp_path / f"{name}.xml"
    path.write_text(spec.to_xml())
    ours, converted = forcegp.load_robot(urdf), forcegp.load_robot(path)
    assert converted.joint_names == ours.joint_names
    states = random_states(ours, 4)[:3]
    expected = dynamics.inverse_dynamics(ours, *states)
    # MuJoCo writes numbers with six digits or so.
    torch.testing.assert_close(dynamics.inverse_dynamics(converted, *states), expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(converted.lower, ours.lower, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(converted.friction, ours.friction, rtol=1e-4, atol=1e-4)
    for frame in ours.frame_names[1:]:
        torch.testing.assert_close(
            kinematics.frame_pose(converted, states[0], frame),
            kinematics.frame_pose(ours, states[0], frame),
            rtol=1e-4,
            atol=1e-4,
        )
