"""Valid MJCF files load as MuJoCo compiles them, or are refused by the name of what is not supported."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import forcegp
from forcegp import dynamics
from forcegp.errors import InertiaError, RobotFileWarning, UnsupportedRobotError
from forcegp.robot.mjcf import _Compiled
from robots import random_states

mujoco: Any = pytest.importorskip("mujoco")

RELATIVE = 1e-8  # MuJoCo diagonalises inertias on loading, which costs it some digits
INERTIAL = '<inertial pos="0.02 0 -0.2" mass="1.3" diaginertia="0.012 0.011 0.002"/>'
THREE = f"""
<body name="one"><joint name="a" axis="0 1 0" damping="0.1" armature="0.01"/>{INERTIAL}
  <body name="two" pos="0 0 -0.4"><joint name="b" axis="1 1 0"/>{INERTIAL}
    <body name="three" pos="0 0.1 -0.3"><joint name="c" type="slide" axis="0 0 1"/>{INERTIAL}</body>
  </body>
</body>"""


def write(folder: Path, rest: str, body: str = THREE) -> Path:
    path = folder / "robot.xml"
    path.write_text(f"<mujoco>{rest}<worldbody>{body}</worldbody></mujoco>")
    return path


def assert_equal(robot: forcegp.RobotModel, path: Path, held: dict[str, float] | None = None) -> None:
    """Check M, gravity and damping against MuJoCo's own reading of the file, with some joints held."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.gravity[:] = robot.gravity.numpy()
    data = mujoco.MjData(model)
    for name, q in (held or {}).items():
        data.qpos[model.joint(name).qposadr] = q
    dofs = [int(model.joint(name).dofadr[0]) for name in robot.joint_names]
    q, qd = random_states(robot, 3)[:2]
    for k in range(3):
        data.qpos[dofs], data.qvel[dofs] = q[k], qd[k]
        mujoco.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        for column, unit in zip(M, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        ours = dynamics.mass_matrix(robot, q[k]).numpy()
        assert np.abs(ours - M[np.ix_(dofs, dofs)]).max() < RELATIVE * np.abs(M).max()
        bias = -(dynamics.bias_force(robot, q[k], qd[k]) + dynamics.gravity_force(robot, q[k])).numpy()
        assert np.abs(bias - data.qfrc_bias[dofs]).max() < RELATIVE * np.abs(data.qfrc_bias).max()
        damping = dynamics.damping_force(robot.replace(friction=0.0 * robot.friction), qd[k]).numpy()
        assert np.abs(damping - data.qfrc_passive[dofs]).max() < RELATIVE * (1.0 + np.abs(damping).max())


ACTUATORS = {
    "gear": '<motor joint="a" gear="3" armature="0.2" damping="0.3"/>',
    "several": '<motor joint="a" armature="0.1" damping="1"/><position joint="a" gear="-2" armature="0.1"/>',
    "parent": '<velocity jointinparent="c" gear="5" armature="0.02" damping="0.1"/>',
    "classes": '<general joint="b" class="strong"/><motor joint="c"/>',
    "tendon": '<motor tendon="t" gear="3" armature="0.02" damping="0.4"/>',
    "muscle": '<muscle joint="b" armature="0.3"/>',
    "dcmotor": '<dcmotor joint="b" motorconst="1" resistance="1" armature="0.3"/>',
}


@pytest.mark.parametrize("kind", ACTUATORS)
def test_armature_and_damping_of_actuators_act_on_joints(tmp_path: Path, kind: str) -> None:
    rest = (
        '<default><motor damping="0.05"/><default class="strong"><motor armature="0.4" gear="2"/></default>'
        "</default>"
        '<tendon><fixed name="t"><joint joint="b" coef="-2"/></fixed></tendon>'
        f"<actuator>{ACTUATORS[kind]}</actuator>"
    )
    path = write(tmp_path, rest)
    if kind == "muscle":  # MuJoCo computes the length range of a muscle by simulation, which needs limits
        path.write_text(path.read_text().replace('muscle joint="b"', 'muscle joint="b" lengthrange="0 1"'))
    robot = forcegp.load_robot(path)
    assert float(robot.armature.sum()) > 0.01
    assert_equal(robot, path)


def test_armature_of_an_actuator_is_the_value_in_the_file(tmp_path: Path) -> None:
    motor = '<motor joint="a" gear="2" armature="0.25" damping="0.5"/>'
    robot = forcegp.load_robot(write(tmp_path, f"<actuator>{motor}</actuator>"))
    assert robot.armature.tolist() == [0.01 + 4 * 0.25, 0.0, 0.0]
    assert robot.damping.tolist() == [0.1 + 4 * 0.5, 0.0, 0.0]


TENDON = '<tendon><{kind} name="belt" {attribute}="0.3">{path}</{kind}></tendon>'
COUPLED = '<joint joint="a" coef="1"/><joint joint="b" coef="-2"/>'
SITES = '<site site="base"/><site site="tip"/>'


@pytest.mark.parametrize("attribute", ["armature", "damping"])
def test_a_tendon_that_couples_joints_is_refused_by_name(tmp_path: Path, attribute: str) -> None:
    """With one joint left the tendon acts on that joint alone, with coef² times its parameters."""
    fixed = TENDON.format(kind="fixed", attribute=attribute, path=COUPLED)
    path = write(tmp_path, fixed)
    with pytest.raises(UnsupportedRobotError, match=rf"the {attribute} of tendon 'belt'(.|\n)*locked_joints"):
        forcegp.load_robot(path)
    robot = forcegp.load_robot(path, locked_joints={"a": 0.2})
    assert getattr(robot, attribute).tolist() == pytest.approx([4 * 0.3, 0.0])
    assert_equal(robot, path, {"a": 0.2})
    sites = THREE.replace('<body name="two"', '<site name="tip" pos="0.1 0 0"/><body name="two"')
    spatial = TENDON.format(kind="spatial", attribute=attribute, path=SITES)
    path = write(tmp_path, spatial, '<site name="base" pos="0.3 0 0"/>' + sites)
    with pytest.raises(UnsupportedRobotError, match=rf"the {attribute} of tendon 'belt'"):
        forcegp.load_robot(path)
    assert_equal(forcegp.load_robot(path, locked_joints={"a": 0.2}), path, {"a": 0.2})
    actuated = write(
        tmp_path,
        f'<tendon><fixed name="t">{COUPLED}</fixed></tendon><actuator>'
        f'<motor name="m" tendon="t" {attribute}="0.1"/></actuator>',
    )
    with pytest.raises(UnsupportedRobotError, match=rf"the {attribute} of actuator 'm'"):
        forcegp.load_robot(actuated)


def test_forces_of_tendons_that_are_ignored_are_named(tmp_path: Path) -> None:
    for attribute, name in (("stiffness", "stiffness"), ("frictionloss", "frictionloss")):
        path = write(tmp_path, TENDON.format(kind="fixed", attribute=attribute, path=COUPLED))
        with pytest.warns(RobotFileWarning, match=f"the {name} of tendon 'belt' is ignored"):
            forcegp.load_robot(path)


def test_what_the_reader_would_miss_is_found_by_the_comparison(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Polynomial damping that couples joints, and a reader that forgets armature, gravity or damping."""
    coupled = TENDON.format(kind="fixed", attribute="damping", path=COUPLED)
    poly = write(tmp_path, coupled.replace('damping="0.3"', 'damping="0 0.3"'))
    with pytest.raises(UnsupportedRobotError, match=r"damping of tendon 'belt' couples joints"):
        forcegp.load_robot(poly)
    path = write(tmp_path, '<actuator><motor name="m" joint="b" armature="0.1"/></actuator>')
    monkeypatch.setattr("forcegp.robot.mjcf._drives", lambda *_: iter(()))
    with pytest.raises(UnsupportedRobotError, match="mass matrix at joint 'b' differs from that in MuJoCo"):
        forcegp.load_robot(path)
    monkeypatch.undo()
    equations = _Compiled.equations
    monkeypatch.setattr(
        _Compiled, "equations", lambda self, state, joints, g: equations(self, state, joints, -g)
    )
    with pytest.raises(UnsupportedRobotError, match=r"gravity at joint '[abc]' differs"):
        forcegp.load_robot(path)


RELATIONS = {
    "quadratic": ('polycoef="0.1 0.5 0.7 0 0"', "", lambda x: 0.1 + 0.5 * x + 0.7 * x**2),
    "quartic": ('polycoef="0.1 0 0.3 -0.2 0.4"', "", lambda x: 0.1 + 0.3 * x**2 - 0.2 * x**3 + 0.4 * x**4),
    "short": ('polycoef="0 2"', "", lambda x: 2 * x),
    "default": ("", "", lambda x: x),
    "reference": ('polycoef="0 1 2"', "ref", lambda x: -0.3 + (x - 0.5) + 2 * (x - 0.5) ** 2),
}


@pytest.mark.parametrize("kind", RELATIONS)
def test_joints_follow_the_whole_polynomial_and_the_references(tmp_path: Path, kind: str) -> None:
    polycoef, ref, relation = RELATIONS[kind]
    body = THREE.replace('name="b"', 'name="b" ref="0.5"').replace('name="c"', 'name="c" ref="-0.3"')
    rest = f'<compiler angle="radian"/><equality><joint joint1="c" joint2="b" {polycoef}/></equality>'
    path = write(tmp_path, rest, body if ref else THREE)
    with pytest.raises(UnsupportedRobotError, match="'c' mimics joint 'b'") as caught:
        forcegp.load_robot(path)
    assert f"'c': {relation(0.0)!r}"[:9] in str(caught.value)
    robot = forcegp.load_robot(path, locked_joints={"b": 0.7})
    assert robot.joint_names == ("a",)
    assert_equal(robot, path, {"b": 0.7, "c": relation(0.7)})


def test_chains_classes_and_held_values_of_equalities(tmp_path: Path) -> None:
    chain = '<joint joint1="c" joint2="b" polycoef="0 0 1"/><joint joint1="b" joint2="a" polycoef="0.1 3"/>'
    path = write(tmp_path, f"<equality>{chain}</equality>")
    with pytest.raises(UnsupportedRobotError, match=r"locked_joints=\{'a': 0.0, 'b': 0.1, 'c': 0.010"):
        forcegp.load_robot(path)
    # A class switches a constraint off, and a switched-off one may be of any kind.
    off = '<default><default class="off"><equality active="false"/></default></default>'
    weld = '<weld body1="one" body2="two" active="false"/>'
    for constraint in ('<joint class="off" joint1="c" joint2="b"/>', weld):
        path = write(tmp_path, f"{off}<equality>{constraint}</equality>")
        assert forcegp.load_robot(path).nq == 3
    held = THREE.replace('name="c"', 'name="c" ref="0.2"')
    path = write(tmp_path, '<equality><joint joint1="c" polycoef="0.3"/></equality>', held)
    with pytest.raises(UnsupportedRobotError, match=r"'c' is held in place(.|\n)*\{'c': 0.5\}"):
        forcegp.load_robot(path)
    assert_equal(forcegp.load_robot(path, locked_joints={"c": 0.5}), path, {"c": 0.5})
    with pytest.warns(RobotFileWarning, match=r"'c' is locked at 0.4, and in the file at 0.5"):
        forcegp.load_robot(path, locked_joints={"c": 0.4})
    twice = '<joint joint1="c" joint2="b"/><joint joint1="c" joint2="a"/>'
    with pytest.raises(UnsupportedRobotError, match="'c' has several equality constraints"):
        forcegp.load_robot(write(tmp_path, f"<equality>{twice}</equality>"))


def stl(path: Path) -> None:
    """A tetrahedron as a binary STL file."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4")
    faces = [corners[[i, j, k]] for i, j, k in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))]
    records = b"".join(np.zeros(3, "<f4").tobytes() + face.tobytes() + b"\0\0" for face in faces)
    path.write_bytes(bytes(80) + struct.pack("<I", 4) + records)


MESHES = {
    "mass": ("", '<geom type="mesh" mesh="v" mass="0"/>'),
    "density": ("", '<geom type="mesh" mesh="v" density="0"/>'),
    "class": ('mass="0"', '<geom type="mesh" mesh="v" class="visual"/>'),
    "mesh in class": ('mass="0" type="mesh" mesh="v"', '<geom class="visual"/>'),
    "group": ("", '<geom type="mesh" mesh="v" group="4"/>'),
    "group in class": ('group="5"', '<geom type="mesh" mesh="v" class="visual"/>'),
    "fitted": ('density="0"', '<geom type="box" mesh="v" class="visual"/>'),
    "childclass": ('mass="0"', '<frame childclass="visual"><geom type="mesh" mesh="v"/></frame>'),
}


@pytest.mark.parametrize("kind", MESHES)
def test_meshes_without_mass_are_not_needed(tmp_path: Path, kind: str) -> None:
    visual, geom = MESHES[kind]
    rest = (
        '<compiler inertiagrouprange="0 3"/>'
        f'<default><default class="visual"><geom {visual}/></default></default>'
        '<asset><mesh name="v" file="v.stl"/></asset>'
    )
    body = f'<body name="arm"><joint name="j" axis="0 1 0"/>{geom}<geom size="0.1" pos="0.2 0 0"/></body>'
    path = write(tmp_path, rest, body)
    robot = forcegp.load_robot(path)  # the mesh does not exist
    stl(tmp_path / "v.stl")
    assert_equal(robot, path)
    path.write_text(path.read_text().replace("0 3", "0 5").replace('mass="0"', "").replace('density="0"', ""))
    with pytest.raises(UnsupportedRobotError, match="body 'arm' takes its inertia from the mesh 'v'"):
        forcegp.load_robot(path)


def test_meshes_of_bodies_that_never_move_are_not_needed(tmp_path: Path) -> None:
    base = '<body name="base"><geom type="mesh" mesh="v"/>' + THREE + "</body>"
    path = write(tmp_path, '<asset><mesh name="v" file="v.stl"/></asset>', base)
    robot = forcegp.load_robot(path)
    stl(tmp_path / "v.stl")
    assert_equal(robot, path)


def test_materials_and_several_sections(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    marker = '<default><site material="red"/><geom material="red"/><tendon material="red"/></default>'
    sections = (
        '<asset><material name="red" rgba="1 0 0 1"/></asset>'
        '<worldbody><site name="s" material="red"/><geom size="0.1" material="red"/></worldbody>'
        f"<worldbody>{THREE}</worldbody>"
        f'<worldbody><body name="four" pos="1 0 0"><joint name="d"/>{INERTIAL}</body></worldbody>'
        '<tendon><fixed name="t"><joint joint="a" coef="1"/></fixed></tendon>'
        '<actuator><motor name="m" joint="a" armature="0.1"/></actuator>'
        '<actuator><motor name="n" joint="b" armature="0.2"/></actuator>'
    )
    path.write_text(f"<mujoco>{marker}{sections}</mujoco>")
    robot = forcegp.load_robot(path)
    assert robot.joint_names == ("a", "b", "c", "d")
    assert robot.armature.tolist() == [0.11, 0.2, 0.0, 0.0]
    assert_equal(robot, path)


def test_names_of_unnamed_bodies_and_joints_are_unique(tmp_path: Path) -> None:
    inner = f'<body name="body_1" pos="0 0 0.2"><joint name="joint_0" axis="0 1 0"/>{INERTIAL}</body>'
    path = write(tmp_path, "", f'<body><joint axis="0 1 0"/>{INERTIAL}{inner}</body>')
    robot = forcegp.load_robot(path)
    assert robot.joint_names == ("joint_0_", "joint_0")
    assert robot.frame_names == ("world", "body_1_", "body_1")


@pytest.mark.parametrize(
    ("option", "gravity"),
    [
        ('<option gravity="0 0 0"/>', [0.0, 0.0, 0.0]),
        ('<option gravity="0 9.81 0"/>', [0.0, 9.81, 0.0]),
        ('<option gravity="0 0 -1.62"/><option timestep="0.01"/>', [0.0, 0.0, -1.62]),
        ('<option><flag gravity="disable"/></option>', [0.0, 0.0, 0.0]),
        ("", [0.0, 0.0, -9.81]),
    ],
)
def test_gravity_is_that_of_the_file_unless_stated(tmp_path: Path, option: str, gravity: list[float]) -> None:
    path = write(tmp_path, option)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert forcegp.load_robot(path).gravity.tolist() == gravity
    notes = [str(warning.message) for warning in caught]
    assert any("gravity of the file is used" in note for note in notes) == (abs(sum(gravity)) < 9.0)
    assert forcegp.load_robot(path, gravity=(0.0, 0.0, -9.8)).gravity.tolist() == [0.0, 0.0, -9.8]
    scene = tmp_path / "scene.toml"
    scene.write_text('[robot]\nmodel = "robot.xml"\n')
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert forcegp.load_scene(scene).robot().gravity.tolist() == gravity


@pytest.mark.parametrize(("flag", "text"), [("damper", "damping"), ("frictionloss", "frictionloss")])
def test_forces_that_a_flag_switches_off_are_zero(tmp_path: Path, flag: str, text: str) -> None:
    joint = '<joint name="a" axis="0 1 0" damping="2" frictionloss="0.5"/>'
    path = write(
        tmp_path,
        f'<option><flag {flag}="disable"/></option><actuator><motor joint="a" damping="3"/></actuator>',
        f'<body name="one">{joint}{INERTIAL}</body>',
    )
    with pytest.warns(RobotFileWarning, match=f"{text} is switched off by a flag"):
        robot = forcegp.load_robot(path)
    off = text == "damping"
    assert (robot.damping.item(), robot.friction.item()) == ((0.0, 0.5) if off else (5.0, 0.0))
    assert_equal(robot, path)


POLYNOMIAL = """
<default><joint damping="0.2 0.1 0.05"/></default>
<tendon><fixed name="rope" damping="0.1 0.3 0.2"><joint joint="c" coef="-2"/></fixed></tendon>
<actuator>
  <motor joint="b" gear="-3" damping="0.1 -0.02 0.03" armature="0.1"/>
  <motor tendon="rope" gear="3" damping="0.02 0.01 0.04"/>
</actuator>"""


def test_polynomial_damping_is_that_of_mujoco(tmp_path: Path) -> None:
    """Of joints, of a default class, and of an actuator and a tendon with ratios; at random velocities."""
    path = write(tmp_path, POLYNOMIAL)
    robot, model = forcegp.load_robot(path), mujoco.MjModel.from_xml_path(str(path))
    assert robot.damping.tolist() == pytest.approx([0.1, 1.1, 0.6 + 36 * 0.02])
    assert robot.drag is not None
    expected = [[0.1, 0.05], [0.1 - 9 * 0.02, 0.05 + 9 * 0.03], [2.5 + 72 * 0.01, 3.25 + 144 * 0.04]]
    np.testing.assert_allclose(robot.drag.numpy(), expected, rtol=1e-14)
    data = mujoco.MjData(model)
    for qd in random_states(robot, 20)[1]:
        data.qvel[:] = 3.0 * qd
        mujoco.mj_forward(model, data)
        force = dynamics.damping_force(robot, 3.0 * qd).numpy()
        assert np.abs(force - data.qfrc_damper).max() < 1e-10 * np.abs(force).max()
    assert_equal(robot, path)


def test_lugre_friction_is_that_of_a_joint_that_keeps_sliding(tmp_path: Path) -> None:
    """MuJoCo's DC motor, driven at constant speeds until its bristle is bent, with a gear."""
    motor = '<dcmotor name="m" joint="b" input="none" motorconst="1e-9" resistance="1" gear="-2" lugre="{}"/>'
    path = write(tmp_path, f"<actuator>{motor.format('300 1 0.4 0.7 0.1')}</actuator>")
    with pytest.warns(RobotFileWarning, match="LuGre friction of actuator m is that of a joint that keeps"):
        robot = forcegp.load_robot(path)
    assert robot.bristle is not None
    assert robot.bristle.tolist() == [0.0, 1200.0, 0.0]
    model = mujoco.MjModel.from_xml_path(str(path))
    data, sharp = mujoco.MjData(model), robot.replace(friction_velocity=0.0 * robot.mass + 1e-6)
    for speed in (0.01, -0.04, 0.1, 0.5):
        mujoco.mj_resetData(model, data)
        for _ in range(round(0.1 / abs(speed) / model.opt.timestep)):
            data.qpos[:], data.qvel[:] = 0.0, [0.0, speed, 0.0]
            mujoco.mj_step(model, data)
        data.qvel[:] = [0.0, speed, 0.0]
        mujoco.mj_forward(model, data)
        force = dynamics.damping_force(sharp, sharp.mass.new_tensor([0.0, speed, 0.0])).numpy()
        np.testing.assert_allclose(force, data.qfrc_actuator, rtol=1e-10)
    path = write(tmp_path, f"<actuator>{motor.format('300 1 0.4')}</actuator>")
    with pytest.warns(RobotFileWarning):
        assert not forcegp.load_robot(path).stribeck.any()
    second = motor.replace('name="m"', 'name="n"').format("9 0 1 1 1")
    path = write(tmp_path, f"<actuator>{motor.format('300 1 0.4')}{second}</actuator>")
    with pytest.raises(
        UnsupportedRobotError, match="joint 'b' has several kinds of dry friction with memory"
    ):
        forcegp.load_robot(path)


def test_a_body_without_inertia_is_named_with_its_joint(tmp_path: Path) -> None:
    """MuJoCo rejects a body without mass; the library rejects mass on the axis of a joint."""
    nothing = '<inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/>'
    light = f'<body name="arm"><joint name="j" axis="0 1 0"/>{nothing}</body>'
    with pytest.raises(InertiaError, match="at the body of joint 'j'"):
        forcegp.load_robot(write(tmp_path, "", light))
