"""A free base as six joints gives the figures of Pinocchio's free-flyer and of MuJoCo's free joint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

import forcegp
from forcegp import dynamics, kinematics
from forcegp.errors import RobotFileError, UnknownNameError, UnsupportedRobotError
from forcegp.forces.posterior import SPREAD, trained_region
from forcegp.robot.free_base import BASE_JOINTS
from forcegp.robot.write_back import write_robot
from free_flyer import HOPPER, body_velocity, turn
from pinocchio_oracle import pin
from robots import ARMS, Arm, example_data, kinetic_energy, potential_energy, random_states

LEGGED = [
    arm for arm in ARMS if arm.name in ("solo12", "go2", "anymal_kinova", "bolt", "g1", "talos", "icub")
]
RELATIVE = 1e-10
mujoco = pytest.importorskip("mujoco")


class FreeFlyer:
    """Pinocchio's model with a free-flyer, with vectors in our joint order."""

    def __init__(self, arm: Arm, robot: forcegp.RobotModel) -> None:
        if pin is None:
            pytest.skip("Pinocchio is not installed")
        self.model = pin.buildModelFromUrdf(str(arm.path), pin.JointModelFreeFlyer())
        self.model.armature = np.zeros(self.model.nv)
        self.model.gravity.linear = robot.gravity.numpy()
        self.data = self.model.createData()
        self.joints = [self.model.joints[self.model.getJointId(name)] for name in robot.joint_names[6:]]
        self.order = [*range(6), *(joint.idx_v for joint in self.joints)]

    def vector(self, x: Tensor) -> np.ndarray:
        """A velocity in Pinocchio's order."""
        out = np.zeros(self.model.nv)
        out[self.order] = x.numpy()
        return out

    def position(self, q: Tensor) -> np.ndarray:
        """A configuration."""
        out = pin.neutral(self.model)
        out[:7] = pin.SE3ToXYZQUAT(pin.SE3(turn(q).numpy(), q[:3].numpy()))
        for joint, value in zip(self.joints, q[6:].tolist(), strict=True):
            entry = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
            out[joint.idx_q : joint.idx_q + joint.nq] = entry
        return out


def states(robot: forcegp.RobotModel, count: int = 3) -> tuple[Tensor, ...]:
    """Random states with a pitch within ±1."""
    q, *rest = random_states(robot, count)
    q[:, 4] /= np.pi
    return q, *rest


def relative(ours: Tensor, theirs: np.ndarray) -> float:
    return float(np.abs(ours.numpy() - theirs).max() / np.abs(theirs).max())


@pytest.mark.parametrize("arm", LEGGED, ids=lambda arm: arm.name)
def test_dynamics_of_the_free_flyer(arm: Arm) -> None:
    robot = arm.load(base="free")
    assert robot.joint_names[:6] == BASE_JOINTS
    oracle = FreeFlyer(arm, robot)
    q, qd, qdd, _ = states(robot)
    M, force = dynamics.mass_matrix(robot, q), dynamics.inverse_dynamics(robot, q, qd, qdd)
    back = dynamics.forward_dynamics(robot, q, qd, force)
    frame = robot.frame_names[-1]
    J = kinematics.frame_jacobian(robot, q, frame)
    for k in range(len(q)):
        T = torch.func.jacrev(lambda x, k=k: body_velocity(q[k], x))(qd[k])
        v = body_velocity(q[k], qd[k])
        a = torch.func.jvp(body_velocity, (q[k], qd[k]), (qd[k], qdd[k]))[1]
        place, at = oracle.position(q[k]), np.ix_(oracle.order, oracle.order)
        upper = np.triu(pin.crba(oracle.model, oracle.data, place))
        theirs = (upper + np.triu(upper, 1).T)[at]
        assert relative(M[k], T.mT.numpy() @ theirs @ T.numpy()) < RELATIVE
        torque = pin.rnea(oracle.model, oracle.data, place, oracle.vector(v), oracle.vector(a))[oracle.order]
        assert relative(force[k], T.mT.numpy() @ torque) < RELATIVE
        rounding = 8.0 * np.finfo(float).eps * np.linalg.cond(M[k].numpy())
        assert relative(back[k], qdd[k].numpy()) < max(RELATIVE, rounding)
        where = oracle.model.getFrameId(frame)
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        both = pin.computeFrameJacobian(oracle.model, oracle.data, place, where, world)[:, oracle.order]
        assert relative(J[k], np.roll(both, 3, axis=0) @ T.numpy()) < RELATIVE


def test_momentum_and_energy_in_flight() -> None:
    robot = next(arm for arm in LEGGED if arm.name == "solo12").load(base="free")
    robot = robot.replace(damping=0.0 * robot.damping, friction=0.0 * robot.friction)
    q, qd, *_ = states(robot, 1)
    n, duration = robot.nq, 0.2

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        at = torch.from_numpy(x.copy())
        qdd = dynamics.forward_dynamics(robot, at[:n], at[n:], torch.zeros(n, dtype=at.dtype))
        return np.concatenate([x[n:], qdd.numpy()])

    x = torch.cat([q[0], qd[0]])
    end = torch.from_numpy(solve_ivp(rate, (0.0, duration), x.numpy(), rtol=1e-9, atol=1e-9).y[:, -1].copy())
    (q0, v0), (q1, v1) = x.split(n), end.split(n)
    energy = [kinetic_energy(robot, a, b) + potential_energy(robot, a) for a, b in ((q0, v0), (q1, v1))]
    torch.testing.assert_close(energy[1], energy[0], rtol=1e-6, atol=1e-6)
    # The first three rows of M q̇ are the linear momentum.
    p0, p1 = ((dynamics.mass_matrix(robot, a) @ b)[:3] for a, b in ((q0, v0), (q1, v1)))
    weight = float(robot.mass.sum()) * robot.gravity
    torch.testing.assert_close(p1 - p0, duration * weight, rtol=1e-6, atol=1e-6)


def test_a_free_joint_of_mjcf_is_that_of_mujoco(tmp_path: Path) -> None:
    path = tmp_path / "hopper.xml"
    path.write_text(HOPPER)
    robot = forcegp.load_robot(path, base="free")
    assert robot.joint_names == (*BASE_JOINTS, "hip", "knee")
    assert robot.damping.tolist() == [0.0] * 6 + [0.3] * 2
    assert robot.armature.tolist() == [0.0] * 6 + [0.01] * 2
    model = mujoco.MjModel.from_xml_string(HOPPER)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    q, qd, qdd, _ = states(robot)
    site = model.site("foot").id
    for k in range(len(q)):
        v, a = torch.func.jvp(body_velocity, (q[k], qd[k]), (qd[k], qdd[k]))
        R = turn(q[k])
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, R.numpy().flatten())
        data.qpos[:] = [*q[k, :3], *quaternion, *q[k, 6:]]
        data.qvel[:] = [*qd[k, :3], *v[3:]]
        data.qacc[:] = [*qdd[k, :3], *a[3:]]
        mujoco.mj_inverse(model, data)
        T = torch.func.jacrev(lambda x, k=k: body_velocity(q[k], x))(qd[k])
        T[:3] = torch.eye(3, robot.nq)
        rigid = dynamics.inverse_dynamics(robot, q[k], qd[k], qdd[k]) + robot.damping * qd[k]
        assert relative(rigid, T.mT.numpy() @ data.qfrc_inverse) < RELATIVE
        _, position = kinematics.frame_pose(robot, q[k], "foot")
        assert np.abs(position.numpy() - data.site_xpos[site]).max() < RELATIVE
    written = write_robot(robot.replace(mass=1.1 * robot.mass), path, tmp_path / "out.xml")
    assert any(change.element == "trunk" and change.figure == "mass" for change in written.changes)
    assert "<freejoint" in (tmp_path / "out.xml").read_text()


def test_a_floating_joint_of_urdf_is_replaced(tmp_path: Path) -> None:
    text = (example_data() / "solo_description/robots/solo12.urdf").read_text()
    ends = '<parent link="odom"/><child link="base_link"/>'
    root = f'<link name="odom"/><joint name="float" type="floating">{ends}</joint>'
    path = tmp_path / "solo.urdf"
    path.write_text(text.replace("</robot>", f"{root}</robot>"))
    robot, plain = (forcegp.load_robot(source, base="free") for source in (path, LEGGED[0].path))
    assert robot.joint_names == plain.joint_names
    q = states(robot, 1)[0][0]
    torch.testing.assert_close(dynamics.mass_matrix(robot, q), dynamics.mass_matrix(plain, q))


def test_unclear_bases_are_named(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="base"):
        forcegp.load_robot("ur5", base="floating")  # pyright: ignore[reportArgumentType]
    path = tmp_path / "two.xml"
    body = '<body><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
    path.write_text(f"<mujoco><worldbody>{body}{body}</worldbody></mujoco>")
    with pytest.raises(RobotFileError, match="base of the robot is not clear"):
        forcegp.load_robot(path, base="free")
    text = LEGGED[0].path.read_text().replace("FL_HAA", "base_x")
    (tmp_path / "named.urdf").write_text(text)
    with pytest.raises(RobotFileError, match="'base_x' has the name of a joint of the free base"):
        forcegp.load_robot(tmp_path / "named.urdf", base="free")


def urdf(path: Path, joints: str, links: str = "world a b") -> Path:
    """A URDF of links, all but `world` with inertia."""
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    text = "".join(f'<link name="{x}">{"" if x == "world" else body}</link>' for x in links.split())
    path.write_text(f'<robot name="r">{text}{joints}</robot>')
    return path


def joint(name: str, kind: str, parent: str, child: str) -> str:
    """A joint of a URDF."""
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/></joint>'


def test_no_joint_is_lost(tmp_path: Path) -> None:
    hinge = joint("j2", "continuous", "a", "b")
    fixed = urdf(tmp_path / "fixed.urdf", joint("j1", "fixed", "world", "a") + hinge)
    assert forcegp.load_robot(fixed, base="free").joint_names == (*BASE_JOINTS, "j2")
    moving = urdf(tmp_path / "rail.urdf", joint("j1", "prismatic", "world", "a") + hinge)
    pair = joint("j1", "fixed", "world", "a") + joint("j2", "fixed", "world", "b")
    several = urdf(tmp_path / "two.urdf", pair)
    for path in (moving, several):
        with pytest.raises(RobotFileError, match="base of the robot is not clear"):
            forcegp.load_robot(path, base="free")
    both = joint("f", "floating", "world", "a") + joint("g", "floating", "world", "b")
    with pytest.raises(UnsupportedRobotError, match="several joints are floating"):
        forcegp.load_robot(urdf(tmp_path / "floating.urdf", both), base="free")


def test_defaults_do_not_act_on_the_base(tmp_path: Path) -> None:
    defaults = '<joint damping="0.3" actuatorfrcrange="-5 5"/>'
    text = HOPPER.replace('<joint damping="0.3" armature="0.01"/>', defaults)
    (tmp_path / "hopper.xml").write_text(text)
    robot = forcegp.load_robot(tmp_path / "hopper.xml", base="free")
    assert robot.effort_limit[:6].isinf().all()
    inside = HOPPER.replace('<freejoint name="root"/>', '<frame><freejoint name="root"/></frame>')
    (tmp_path / "frame.xml").write_text(inside)
    with pytest.raises(RobotFileError, match="base of the robot is not clear"):
        forcegp.load_robot(tmp_path / "frame.xml", base="free")


def test_an_actuator_of_the_free_joint_is_named(tmp_path: Path) -> None:
    actuator = '<actuator><motor joint="root" gear="1 0 0 0 0 0"/></actuator></mujoco>'
    (tmp_path / "driven.xml").write_text(HOPPER.replace("</mujoco>", actuator))
    with pytest.raises(UnsupportedRobotError, match="<motor> acts on the free joint 'root'"):
        forcegp.load_robot(tmp_path / "driven.xml", base="free")


def test_a_base_has_no_friction_in_written_files(tmp_path: Path) -> None:
    source = LEGGED[0].path
    robot = forcegp.load_robot(source, base="free")
    rough = robot.replace(damping=robot.damping + 0.01, mass=1.1 * robot.mass)
    written = write_robot(rough, source, tmp_path / "out.urdf")
    assert any("free base has no damping" in loss for loss in written.losses)
    again = forcegp.load_robot(tmp_path / "out.urdf", base="free")
    torch.testing.assert_close(again.mass, rough.mass, rtol=1e-6, atol=1e-9)
    locked = {"base_z": 0.0, "base_pitch": 0.0, "base_roll": 0.0}
    planar = forcegp.load_robot(source, base="free", locked_joints=locked)
    changed = planar.replace(mass=1.1 * planar.mass)
    assert write_robot(changed, source, tmp_path / "planar.urdf", locked_joints=locked).changes


def test_joints_without_any_load_have_a_trained_region() -> None:
    load = torch.tensor([1.0, 0.0], dtype=torch.float64)
    x = torch.randn(100, 2, dtype=torch.float64) * load
    assert (trained_region(x, x, load)[SPREAD] > 0.0).all()
