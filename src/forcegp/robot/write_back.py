"""Writing of robot parameters into a copy of the URDF or MJCF file.

Only changed attributes are edited (`edit_xml.py`). Meshes, comments, order and formatting are preserved. A
link of the robot may consist of several links in the file that are fixed to each other. Of those that stay
physically consistent, the heaviest takes the whole change J − J₀ in pseudo-inertia. If none stays consistent,
each J_k changes to E J_k Eᵀ, where E satisfies E J₀ Eᵀ = J. In MJCF, dry friction with memory is that of a DC
motor without control. The edited text is checked before it is written.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from forcegp.errors import RobotFileError
from forcegp.files import atomic_file
from forcegp.robot.edit_xml import EditableXml, Span
from forcegp.robot.free_base import BASE_JOINTS
from forcegp.robot.inertia import from_pseudo_inertia, pseudo_inertia
from forcegp.robot.load import read_tree, robot_of, robot_path
from forcegp.robot.model import RobotModel
from forcegp.robot.safety import parse_xml, read_bytes
from forcegp.robot.tree import (
    Base,
    Drive,
    Inertial,
    Tree,
    checked,
    inertia_doubt,
    inertia_error,
    lock_joints,
    transform,
)

CHANGED = 1e-6
"""Relative change in a parameter below which the text in the file is preserved."""
SAME = 1e-6
"""Relative tolerance for parameters read back from a written file."""
FLOORS = {"mass": 1e-6, "com": 1e-2, "inertia": 1e-7}
"""Parameters of a link, and the sizes below which their differences count as absolute ones."""
ORIENTATIONS = ("axisangle", "euler", "xyaxes", "zaxis")
"""Attributes for the orientation of an inertial frame in MJCF, apart from a quaternion."""


DRAG = ("quadratic damping", "cubic damping")
BRISTLE = ("friction", "stribeck", "stribeck_velocity", "bristle")
"""Parameters of polynomial damping and of dry friction with memory, which MJCF supports."""
TIMESTEP = 0.002
"""Time step of MuJoCo unless a file states it [s]."""
NO_MOTOR = 'input="none" motorconst="1e-9" resistance="1"'
"""Attributes of a DC motor without control and back-EMF, whose friction alone acts."""
FORCES = {"motor": ("gear",), "position": ("kp", "kv"), "velocity": ("kv",)}
"""Attributes of actuators in MJCF that are proportional to their force."""


class Change(NamedTuple):
    """A changed parameter of a link or joint, such as `mass` or `damping`, with its values in SI units."""

    element: str
    figure: str
    before: float
    after: float


@dataclass(frozen=True)
class WrittenRobot:
    """The changed parameters, and descriptions of the parameters that the format cannot represent."""

    changes: tuple[Change, ...]
    losses: tuple[str, ...]


def write_robot(
    robot: RobotModel,
    source: str | Path,
    out: str | Path,
    *,
    locked_joints: Mapping[str, float] | None = None,
) -> WrittenRobot:
    """Write the masses, inertias, damping, friction and armature of a robot into a copy of its file.

    If torques have a scale, the motors and servos of an MJCF file are scaled by it. MJCF also takes
    polynomial damping (`drag`), and friction with memory of the joints that have a `bristle`.

    Args:
        robot: the robot with the parameters to write. It must have the links and joints of the file.
        source: the URDF or MJCF file of the robot, or the name of a bundled robot.
        out: path of the edited copy, which may be `source` itself.
        locked_joints: see `load_robot`.

    Returns:
        The changed parameters, and the parameters that the format cannot represent.

    Raises:
        RobotFileError: the joints differ from those in the file, an element to change is in an included file,
            no link can take a change, or the written file would not represent the robot.

    Example:
        >>> import tempfile, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> heavier = robot.replace(mass=1.1 * robot.mass)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     written = write_robot(heavier, "double_pendulum", f"{folder}/heavier.urdf")
        >>> {change.figure for change in written.changes} >= {"mass"}
        True
    """
    path, robot = robot_path(source), robot.to("cpu", torch.float64)
    data, locked = read_bytes(path), locked_joints or {}
    base, content = _content(data, path, {*robot.joint_names, *locked})
    tree = checked(lock_joints(content, locked))
    file = robot_of(tree, _world(robot))
    if file.joint_names != robot.joint_names:
        raise RobotFileError(
            f"{path}: the joints differ from those of the robot",
            expected=", ".join(robot.joint_names),
            got=", ".join(file.joint_names),
            hint="pass the file from which the robot was loaded, with the same locked_joints",
        )
    document = EditableXml(data, str(path))
    label, is_urdf = str(path), document.root.tag == "robot"
    writer = _Urdf(document, label) if is_urdf else _Mjcf(document, label, content)
    if base == "free":
        writer.of_base = tuple(i for i, name in enumerate(robot.joint_names) if name in BASE_JOINTS)
    changes = [*_joint_changes(writer, tree, robot, file), *_link_changes(writer, tree, robot, file)]
    scaled, unscaled = _scale_changes(writer, robot)
    changes += scaled
    writer.finish()
    written = document.written()
    losses = (*_losses(robot, writer), *unscaled, *_base_losses(robot, writer))
    _check(
        robot, robot_of(checked(lock_joints(read_tree(written, path, base), locked)), _world(robot)), writer
    )
    with atomic_file(out) as temporary:
        temporary.write_bytes(written)
    return WrittenRobot(tuple(changes), losses)


def _content(data: bytes, path: Path, joints: set[str]) -> tuple[Base, Tree]:
    """Return the kind of base with which the file has the given joints, and its content."""
    if joints.isdisjoint(BASE_JOINTS):
        return "fixed", read_tree(data, path)
    try:
        return "free", read_tree(data, path, "free")
    except RobotFileError:
        return "fixed", read_tree(data, path)


def is_mjcf(source: str | Path) -> bool:
    """Return whether a robot file is MJCF, which supports armature, rather than URDF."""
    path = robot_path(source)
    return parse_xml(read_bytes(path), str(path)).tag == "mujoco"


def _world(robot: RobotModel) -> dict[str, np.ndarray]:
    return {name: getattr(robot, name).numpy() for name in ("base_rotation", "base_position", "gravity")}


def per_joint(robot: RobotModel, name: str) -> Tensor:
    """Return a parameter of each joint `(nq,)`, which is zero if the robot does not have it."""
    if name in DRAG:
        return 0.0 * robot.damping if robot.drag is None else robot.drag[:, DRAG.index(name)]
    values = getattr(robot, name)
    return 0.0 * robot.damping if values is None else values


def _joint_changes(writer: _Urdf | _Mjcf, tree: Tree, robot: RobotModel, file: RobotModel) -> list[Change]:
    """Write changed joint parameters, without those of other drives, and return the changes."""
    changes, joints = [], {joint.name: joint for joint in tree.joints}
    for i, joint in enumerate(robot.joint_names):
        if i in writer.of_base:
            continue
        names = *writer.figures, *(DRAG if writer.has_laws else ())
        bristles = writer.has_laws and bool(per_joint(robot, "bristle")[i] > 0.0)
        names = (*names, *BRISTLE[1:]) if bristles else names
        pairs = {name: [float(per_joint(x, name)[i]) for x in (file, robot)] for name in names}
        edits = [Change(joint, name, *pair) for name, pair in pairs.items()]
        edits = [each for each in edits if abs(each.after - each.before) > CHANGED * abs(each.before)]
        current = vars(joints[joint]) | dict(zip(DRAG, joints[joint].drag, strict=True))
        changed, values = {each.figure for each in edits}, dict[str, str]()
        written = {name: pair[1] - pair[0] + current[name] for name, pair in pairs.items()}
        bent = bristles and not changed.isdisjoint(BRISTLE)
        for figure, attribute in writer.figures.items():
            if figure in changed and not (figure == "friction" and bent):
                if written[figure] < 0.0:
                    text = f"{writer.label}: the {figure} of joint {joint!r} is below that of its actuators"
                    least, after = pairs[figure][0] - current[figure], pairs[figure][1]
                    raise RobotFileError(text, expected=f"at least {least:g}", got=after)
                values[attribute] = _text(written[figure])
        curved = writer.has_laws and any(x for name in DRAG for x in pairs[name])
        if curved and not changed.isdisjoint(("damping", *DRAG)):
            # Without all three coefficients, the others are those of a default class.
            values["damping"] = _text(np.array([written[name] for name in ("damping", *DRAG)]))
        if bent:
            values |= {"frictionloss": "0"} if current["friction"] else {}
            writer.set_bristle(
                joint, current["friction"] - pairs["friction"][0], *(pairs[x][1] for x in BRISTLE)
            )
        if values:
            writer.set_joint(joint, values)
        changes += edits
    return changes


def _scale_changes(writer: _Urdf | _Mjcf, robot: RobotModel) -> tuple[list[Change], tuple[str, ...]]:
    """Scale the actuators by the scales of the torques. Return the changes, and a sentence on the others."""
    scales = () if robot.torque_scale is None else robot.torque_scale.tolist()
    changes, lacking = [], []
    for joint, scale in zip(robot.joint_names, scales, strict=False):
        scaled = writer.scale_actuators(joint, scale) if abs(scale - 1.0) > CHANGED else []
        changes += scaled
        lacking += [] if scaled or abs(scale - 1.0) <= CHANGED else [f"{joint} {scale:.4g}"]
    text = f"no motor or servo in the file holds the scale of torques ({', '.join(lacking)})"
    return changes, (text,) if lacking else ()


def _link_changes(writer: _Urdf | _Mjcf, tree: Tree, robot: RobotModel, file: RobotModel) -> list[Change]:
    """Write changed link inertias, and return the changes."""
    old = {link.name: link.inertial for link in tree.links}
    J_old = pseudo_inertia(file.mass, file.com, file.inertia)
    J_new = pseudo_inertia(robot.mass, robot.com, robot.inertia)
    changes: list[Change] = []
    differing = set().union(*(_differing(figure, file, robot, CHANGED) for figure in FLOORS))
    for i, joint in enumerate(robot.joint_names):
        if i not in differing:
            continue
        for name, body in _shared(_parts(file, i, old), J_old[i], J_new[i], joint).items():
            writer.set_inertial(name, body)
            before = old[name] or NOTHING
            changes.append(Change(name, "mass", before.mass, body.mass))
            for axis, *pair in zip("xyz", before.com, body.com, strict=True):
                changes.append(Change(name, f"com {axis}", *map(float, pair)))
            for axes, *place in zip(_MOMENTS, *_PLACES, strict=True):
                pair = (float(x.inertia[tuple(place)]) for x in (before, body))
                changes.append(Change(name, f"inertia {axes}", *pair))
    return changes


NOTHING = Inertial(0.0, np.zeros(3), np.zeros((3, 3)))
"""Inertia of a link without mass."""
_MOMENTS = ("xx", "yy", "zz", "xy", "xz", "yz")
_PLACES = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)


class _Part(NamedTuple):
    """A link of the file, with its pose and its pseudo-inertia J `(4, 4)` in the robot link."""

    name: str
    pose: Tensor
    J: Tensor
    sound: bool


def _parts(file: RobotModel, i: int, old: Mapping[str, Inertial | None]) -> list[_Part]:
    """Return the links of the file that make up link i, heaviest first."""
    frames = zip(file.frame_names, file.frame_parents, file.frame_rotation, file.frame_position, strict=True)
    parts = []
    for name, parent, R, p in frames:
        if parent == i and name in old:
            body = old[name] or NOTHING
            pose = torch.from_numpy(transform(R.numpy(), p.numpy()))
            inertial = [torch.as_tensor(x, dtype=pose.dtype) for x in (body.mass, body.com, body.inertia)]
            # J = T J_own Tᵀ
            J = pose @ pseudo_inertia(*inertial) @ pose.mT
            parts.append(_Part(name, pose, J, not (inertia_error(body) or inertia_doubt(body))))
    return sorted(parts, key=lambda part: -float(part.J[3, 3]))


def _shared(parts: list[_Part], J_old: Tensor, J_new: Tensor, joint: str) -> dict[str, Inertial]:
    """Return new inertias of links fixed to each other. One takes the whole change, or all take a share."""
    for part in parts:
        body = _body(part.pose, part.J + J_new - J_old)
        if body is not None and not inertia_error(body) and not (part.sound and inertia_doubt(body)):
            return {part.name: body}
    values, vectors = torch.linalg.eigh(J_old)
    if float(values[0]) > 0.0:
        # E = J₀^-½ (J₀^½ J J₀^½)^½ J₀^-½, so that E J₀ Eᵀ = J, and E J_k Eᵀ > 0 if J_k > 0
        root = vectors @ torch.diag(values.sqrt()) @ vectors.mT
        inverse = vectors @ torch.diag(values.rsqrt()) @ vectors.mT
        inner, axes = torch.linalg.eigh(root @ J_new @ root)
        E = inverse @ axes @ torch.diag(inner.clamp(min=0.0).sqrt()) @ axes.mT @ inverse
        bodies = {part.name: _body(part.pose, E @ part.J @ E.mT) for part in parts if part.J.any()}
        if all(body is not None and not inertia_error(body) for body in bodies.values()):
            return {name: body for name, body in bodies.items() if body is not None}
    raise RobotFileError(
        f"no link in the file can absorb the change in inertia beyond joint {joint!r}",
        expected="links that stay physically consistent",
        got=", ".join(part.name for part in parts) or "no link with a name",
        hint="correct the <inertial> of these links, which is unphysical",
    )


def _body(pose: Tensor, J: Tensor) -> Inertial | None:
    """Return the mass, centre of mass and inertia in the axes of a link, or `None` if it has no mass."""
    back = torch.linalg.inv(pose)
    if float(J[3, 3]) <= 0.0:
        return None
    mass, com, inertia = from_pseudo_inertia(back @ J @ back.mT)
    return Inertial(float(mass), com.numpy(), inertia.numpy())


def _losses(robot: RobotModel, writer: _Urdf | _Mjcf) -> tuple[str, ...]:
    """Describe the parameters that the format cannot represent."""
    losses, figures = [], (*writer.figures, *(DRAG if writer.has_laws else ()))
    rigid = per_joint(robot, "bristle") == 0.0 if writer.has_laws else torch.ones_like(robot.damping).bool()
    for figure in ("damping", *DRAG, "friction", "stribeck", "bristle", "armature"):
        values = per_joint(robot, figure) * (rigid if figure in BRISTLE else 1.0)
        if figure not in figures and bool((values != 0.0).any()):
            listed = ", ".join(f"{x:.4g}" for x in values.tolist())
            losses.append(f"the format does not support {figure} ({listed})")
    return tuple(losses)


def _base_losses(robot: RobotModel, writer: _Urdf | _Mjcf) -> Iterator[str]:
    """Yield the parameters of a free base, which no file has."""
    for figure in writer.figures:
        values = getattr(robot, figure)[list(writer.of_base)]
        if bool((values != 0.0).any()):
            yield f"a free base has no {figure} ({', '.join(f'{x:.4g}' for x in values.tolist())})"


def _check(robot: RobotModel, read: RobotModel, writer: _Urdf | _Mjcf) -> None:
    """Compare a robot with the robot read from the written text; raise `RobotFileError` if they differ."""
    for figure in (*FLOORS, *writer.figures, *((*DRAG, *BRISTLE[1:]) if writer.has_laws else ())):
        wrong = _differing(figure, robot, read, 10.0 * SAME)
        wrong = [i for i in wrong if figure in FLOORS or i not in writer.of_base]
        if figure in BRISTLE[1:3]:
            wrong = [i for i in wrong if per_joint(robot, "bristle")[i] > 0.0]
        if wrong:
            raise RobotFileError(
                f"{writer.label}: this would change the {figure} of joint {robot.joint_names[wrong[0]]!r}",
                expected=per_joint(robot, figure)[wrong[0]].tolist(),
                got=per_joint(read, figure)[wrong[0]].tolist(),
                hint="<compiler> settings such as boundmass, inertiafromgeom or settotalmass alter values",
            )


def _differing(figure: str, one: RobotModel, other: RobotModel, tolerance: float) -> list[int]:
    """Return the joints whose parameters differ by more than a fraction of their size."""
    wanted, got = (per_joint(robot, figure).reshape(robot.nq, -1) for robot in (one, other))
    size = wanted.abs().amax(-1) + FLOORS.get(figure, 0.0)
    return ((wanted - got).abs().amax(-1) > tolerance * size).nonzero()[:, 0].tolist()


def _text(values: float | np.ndarray) -> str:
    return " ".join(f"{x:.12g}" for x in np.atleast_1d(values).tolist())


class _Urdf:
    """Attributes of a URDF document."""

    figures: ClassVar = {"damping": "damping", "friction": "friction"}
    has_laws: ClassVar = False
    """Whether the format supports polynomial damping and dry friction with memory."""
    of_base: tuple[int, ...] = ()

    def __init__(self, document: EditableXml, label: str) -> None:
        self.document, self.label = document, label
        self._named = {(e.tag, e.attributes.get("name")): e for e in document.root.children}

    def set_joint(self, joint: str, values: dict[str, str]) -> None:
        element = self._named["joint", joint]
        dynamics = element.find("dynamics")
        if dynamics is None:
            self.document.add_child(element, "dynamics", values)
            return
        for name, text in values.items():
            self.document.set(dynamics, name, text)

    def set_bristle(self, joint: str, other: float, *law: float) -> None:
        """URDF has no friction with memory."""

    def scale_actuators(self, joint: str, scale: float) -> list[Change]:
        """URDF has no motors."""
        return []

    def finish(self) -> None:
        """URDF has no motors."""

    def set_inertial(self, link: str, body: Inertial) -> None:
        element = self._named["link", link]
        inertial = element.find("inertial")
        if inertial is None:
            inside = f'<origin xyz="{_text(body.com)}"/><mass value="{_text(body.mass)}"/><inertia'
            inside += "".join(f' {name}="{_text(x)}"' for name, x in _urdf_moments(body.inertia)) + "/>"
            self.document.add_child(element, "inertial", {}, inside)
            return
        origin, mass, inertia = (inertial.find(tag) for tag in ("origin", "mass", "inertia"))
        assert mass is not None and inertia is not None
        R = np.eye(3)
        if origin is None:
            self.document.add_child(inertial, "origin", {"xyz": _text(body.com)})
        else:
            rpy = [float(x) for x in origin.attributes.get("rpy", "0 0 0").split()]
            R = Rotation.from_euler("xyz", rpy).as_matrix()
            self.document.set(origin, "xyz", _text(body.com))
        self.document.set(mass, "value", _text(body.mass))
        for name, value in _urdf_moments(R.T @ body.inertia @ R):
            self.document.set(inertia, name, _text(value))


def _urdf_moments(inertia: np.ndarray) -> list[tuple[str, float]]:
    return list(zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), inertia[_PLACES].tolist(), strict=True))


class _Mjcf:
    """Attributes of an MJCF document."""

    figures: ClassVar = {"damping": "damping", "friction": "frictionloss", "armature": "armature"}
    has_laws: ClassVar = True
    of_base: tuple[int, ...] = ()

    def __init__(self, document: EditableXml, label: str, content: Tree) -> None:
        self.document, self.label = document, label
        worlds = [section for section in document.root.children if section.tag == "worldbody"]
        bodies = [e for world in worlds for e in world.iter() if e.tag == "body"]
        joints = [part for body in bodies for part in _inside(body) if part.tag == "joint"]
        joints = [part for part in joints if part.attributes.get("type") != "free"]
        # The compiled model has the order of the document, and the world as its first link.
        links = [link.name for link in content.links if link.frame][1:]
        self._bodies = _named(bodies, links)
        names = [joint.name for joint in content.joints if joint.kind != "fixed"]
        self._joints = _named(joints, [name for name in names if name not in BASE_JOINTS])
        sections = [section for section in document.root.children if section.tag == "actuator"]
        self._actuators = [e for section in sections for e in section.children]
        self._drives = [drive for drive in content.drives if drive.gains]
        self._keys = [e for e in document.root.iter() if e.tag == "key" and "act" in e.attributes]
        steps = (e.attributes.get("timestep") for e in document.root.children if e.tag == "option")
        self._step = next((float(step) for step in steps if step), TIMESTEP)
        self._motors: list[str] = []

    def _element(self, kind: str, name: str, among: Mapping[str, Span]) -> Span:
        if name not in among:
            text = f"{self.label}: the {kind} {name!r} is not in this file"
            hint = "write to the included file, or expand the includes first"
            raise RobotFileError(text, expected=f"one of {', '.join(among) or 'none'}", hint=hint)
        return among[name]

    def set_joint(self, joint: str, values: dict[str, str]) -> None:
        element = self._element("joint", joint, self._joints)
        for name, text in values.items():
            self.document.set(element, name, text)

    def set_bristle(self, joint: str, other: float, *law: float) -> None:
        """Write LuGre friction to the motor of a joint that has it, or add a motor without any other force.

        MuJoCo evaluates the bristles z at the start of a step h. With the damping σ₁ = σ₀ h, the force σ₀ z +
        σ₁ ż is that at its end, without which joints at rest would vibrate.

        Args:
            joint: the joint.
            other: dry friction of the joint alone, minus that of the joint with its drives.
            law: the parameters `BRISTLE`.
        """
        dry, excess, speed, stiffness = law
        pairs = [each for each in self._pairs(joint) if each[1].lugre and set(each[1].ratios) == {joint}]
        ratio = abs(pairs[0][1].ratios[joint]) if pairs else 1.0
        dry += other + ratio * sum(drive.lugre[1] for _, drive in pairs)
        values = [stiffness / ratio**2, stiffness * self._step / ratio**2, dry / ratio]
        text = _text(np.array([*values, (dry + excess) / ratio, speed * ratio]))
        if pairs and pairs[0][0].tag == "dcmotor":
            self.document.set(pairs[0][0], "lugre", text)
        elif pairs:
            hint = "write it as <dcmotor>"
            got = f"<{pairs[0][0].tag}>"
            text = f"{self.label}: the actuator of joint {joint!r} with LuGre friction cannot be edited"
            raise RobotFileError(text, expected="<dcmotor>", got=got, hint=hint)
        else:
            self.set_joint(joint, {"name": joint})
            self._motors.append(f"<dcmotor joint={quoteattr(joint)} {NO_MOTOR} lugre={quoteattr(text)}/>")

    def finish(self) -> None:
        """Write the motors that were added, after all others, and their states in keyframes."""
        if self._motors:
            motors = "".join(f"\n    {motor}" for motor in self._motors)
            self.document.append(self.document.root, f"<actuator>{motors}\n  </actuator>")
        for key in self._keys if self._motors else ():
            self.document.set(key, "act", key.attributes["act"] + len(self._motors) * " 0")

    def _pairs(self, joint: str) -> list[tuple[Span, Drive]]:
        """Return the actuators of the document with those of the model."""
        if len(self._actuators) != len(self._drives):
            raise RobotFileError(
                f"{self.label}: actuators of joint {joint!r} may be in an included file",
                expected=f"{len(self._drives)} actuators",
                got=len(self._actuators),
                hint="write to the included file, or expand the includes first",
            )
        return list(zip(self._actuators, self._drives, strict=True))

    def scale_actuators(self, joint: str, scale: float) -> list[Change]:
        """Scale the motors and servos of a joint alone."""
        changes = []
        for element, drive in self._pairs(joint):
            names = FORCES.get(element.tag, ())
            # The armature and damping of a motor grow with its gear.
            if set(drive.ratios) == {joint} and not ("gear" in names and (drive.armature or drive.damping)):
                for name in (name for name in names if drive.gains[name]):
                    value = drive.gains[name]
                    self.document.set(element, name, _text(scale * value))
                    changes.append(Change(element.attributes.get("name", joint), name, value, scale * value))
        return changes

    def set_inertial(self, link: str, body: Inertial) -> None:
        element = self._element("body", link, self._bodies)
        inertial, edit = element.find("inertial"), self.document
        if inertial is None and any(part.tag == "inertial" for part in _inside(element)):
            text = f"{self.label}: the <inertial> of body {link!r} is inside a <frame>"
            raise RobotFileError(text, expected="<inertial> as a child of <body>", hint="move it to the body")
        full = _text(body.inertia[_PLACES])
        if inertial is None:
            values = {"pos": _text(body.com), "mass": _text(body.mass), "fullinertia": full}
            edit.add_child(element, "inertial", values)
            return
        edit.set(inertial, "pos", _text(body.com))
        edit.set(inertial, "mass", _text(body.mass))
        turned = {"quat", *ORIENTATIONS} & inertial.attributes.keys()
        if "fullinertia" in inertial.attributes:
            edit.set(inertial, "fullinertia", full)
        elif not turned:
            edit.drop(inertial, "diaginertia")
            edit.set(inertial, "fullinertia", full)
        else:
            moments, axes = _principal(body.inertia)
            for name in turned & set(ORIENTATIONS):
                edit.drop(inertial, name)
            edit.set(inertial, "quat", _text(np.roll(Rotation.from_matrix(axes).as_quat(), 1)))
            edit.set(inertial, "diaginertia", _text(moments))


def _inside(body: Span) -> Iterator[Span]:
    """Yield the elements of a body, including those inside frames but excluding those of child bodies."""
    for child in body.children:
        yield child
        if child.tag == "frame":
            yield from _inside(child)


def _named(elements: list[Span], names: list[str]) -> dict[str, Span]:
    """Return elements by the names in the model, or by their own if some are in included files."""
    if len(elements) != len(names):
        names = [element.attributes.get("name", "") for element in elements]
    return {name: element for name, element in zip(names, elements, strict=True) if name}


def _principal(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the principal moments and right-handed principal axes of an inertia matrix."""
    moments, axes = np.linalg.eigh(inertia)
    moments, axes = moments[::-1], axes[:, ::-1]
    if np.linalg.det(axes) < 0.0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    return moments, axes
