"""Reduction of MJCF documents to their mechanics, before MuJoCo compiles them.

Bodies, joints, sites, inertias and defaults are kept. Elements for visuals, sensors, actuation or collisions
are dropped, so meshes and textures are never opened. Unsupported elements that affect motion cause errors.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement

from forcegp.errors import InertiaError, RobotFileError, UnsupportedRobotError
from forcegp.robot.safety import MAX_ELEMENTS, MAX_NUMBER, parse_numbers, parse_xml, read_bytes

_IGNORED_SECTIONS = (
    "size", "statistic", "visual", "asset", "contact", "sensor", "keyframe", "custom", "tendon",
)  # fmt: skip
_BODY_PARTS = ("body", "frame", "joint", "freejoint", "inertial", "site", "geom")
_IGNORED_PARTS = ("camera", "light")
_DEFAULTS = ("default", "joint", "geom", "site")
_COMPILER = (
    "autolimits", "boundmass", "boundinertia", "settotalmass", "balanceinertia", "coordinate", "angle",
    "eulerseq", "inertiafromgeom", "inertiagrouprange", "alignfree",
)  # fmt: skip
_NO_MESH = ("material", "mesh", "hfield", "user")
_ACTUATORS = ("motor", "general", "position", "velocity", "intvelocity", "damper")
_ACTUATOR_LIMITS = ("gear", "forcerange", "forcelimited", "ctrlrange", "ctrllimited")
_WORDS = ("name", "class", "childclass", "user", "joint1", "joint2")


class Coupling(NamedTuple):
    """The joint that a coupled joint follows, and the linear part of the relation."""

    leader: str
    multiplier: float
    offset: float


def reduce_mjcf(root: Element, path: Path) -> tuple[Element, dict[str, Coupling], list[str]]:
    """Return the reduced document with files included from its folder, the couplings keyed by the name of the
    constrained joint, and notes. Raise typed errors that name invalid or unsupported elements.
    """
    _expand_includes(root, path)
    document = Element("mujoco", model=root.get("model", path.stem))
    from_geoms = [c.get("inertiafromgeom") == "true" for c in root.iter("compiler")]
    coupled: dict[str, Coupling] = {}
    remarks: list[str] = []
    for section in root:
        where = f"{path}: <{section.tag}>"
        if section.tag == "compiler":
            SubElement(document, "compiler", _only(section, _COMPILER))
        elif section.tag == "option":
            fluid = ", ".join(name for name in ("density", "viscosity", "wind") if section.get(name))
            remarks += [f"{where}: the forces of {fluid} are ignored"] if fluid else []
        elif section.tag == "default":
            document.append(_copy_default(section))
        elif section.tag == "worldbody":
            document.append(_copy_body(section, any(from_geoms), f"{path}: body"))
        elif section.tag == "actuator":
            document.append(_copy_actuators(section))
        elif section.tag == "equality":
            coupled.update(_couplings(section, path))
        elif section.tag not in _IGNORED_SECTIONS:
            text = f"{where} is not supported"
            raise UnsupportedRobotError(text, expected="bodies with joints", got=section.tag)
        elif section.tag == "tendon" and len(section):
            remarks.append(f"{path}: the forces of tendons are ignored")
    _check_numbers(document, path)
    return document, coupled, remarks


def _expand_includes(root: Element, path: Path) -> None:
    """Insert included files, each at most once and only from within the folder of the robot file."""
    folder = path.resolve().parent
    included = {path.resolve()}
    stack = [root]
    count = 0
    while stack:
        element = stack.pop()
        position = 0
        while position < len(element):
            child = element[position]
            count += 1
            if count > MAX_ELEMENTS:
                raise RobotFileError(f"{path}: too many elements", expected=f"at most {MAX_ELEMENTS}")
            if child.tag == "include":
                element[position : position + 1] = list(_included(child, folder, included, path))
            else:
                stack.append(child)
                position += 1


def _included(include: Element, folder: Path, included: set[Path], path: Path) -> Element:
    name = include.get("file", "")
    try:
        target = (folder / name).resolve()
        inside = target.is_relative_to(folder) and target.is_file()
    except (ValueError, OSError, RuntimeError):
        target, inside = folder, False
    if not inside or target in included:
        raise RobotFileError(
            f"{path}: include of {name!r} is refused",
            expected="a file in the folder of the robot file, included once",
            got="a file that is already included"
            if target in included
            else "a missing file, or one in another folder",
        )
    included.add(target)
    return parse_xml(read_bytes(target), str(target))


def _copy_default(default: Element) -> Element:
    copy = Element("default", default.attrib)
    limits = {}
    for child in default:
        if child.tag == "default":
            copy.append(_copy_default(child))
        elif child.tag in _DEFAULTS:
            SubElement(copy, child.tag, _without(child, _NO_MESH))
        elif child.tag in _ACTUATORS:
            limits |= _only(child, _ACTUATOR_LIMITS)
    if limits:
        SubElement(copy, "general", limits)
    return copy


def _only(element: Element, names: tuple[str, ...]) -> dict[str, str]:
    return {k: element.attrib[k] for k in names if k in element.attrib}


def _without(element: Element, names: tuple[str, ...]) -> dict[str, str]:
    return {k: v for k, v in element.attrib.items() if k not in names}


def _copy_actuators(section: Element) -> Element:
    """Copy the limits of joint actuators. The name of a copy states whether its control is a force."""
    copy = Element("actuator")
    for i, actuator in enumerate(section):
        if actuator.tag in _ACTUATORS and actuator.get("joint"):
            name = f"{'motor' if actuator.tag == 'motor' else 'servo'}_{i}"
            kept = _only(actuator, ("class", "joint", *_ACTUATOR_LIMITS))
            SubElement(copy, "general", {"name": name, **kept})
    return copy


def _parts(body: Element) -> Iterator[Element]:
    """Yield the elements of a body, including those inside frames but excluding those of child bodies."""
    for child in body:
        yield child
        if child.tag == "frame":
            yield from _parts(child)


def _copy_body(body: Element, from_geoms: bool, where: str) -> Element:
    name = body.get("name", "(unnamed)")
    has_inertial = any(part.tag == "inertial" for part in _parts(body))
    keep_geoms = body.tag == "body" and (from_geoms or not has_inertial)
    copy = Element(body.tag, _without(body, ("user", "mocap", "sleep")))
    _copy_parts(body, copy, keep_geoms, from_geoms, f"{where} {name!r}")
    return copy


def _copy_parts(source: Element, copy: Element, keep_geoms: bool, from_geoms: bool, where: str) -> None:
    for part in source:
        if part.tag == "body":
            copy.append(_copy_body(part, from_geoms, where.rsplit(" ", 1)[0]))
        elif part.tag == "frame":
            _copy_parts(part, SubElement(copy, "frame", part.attrib), keep_geoms, from_geoms, where)
        elif part.tag == "geom":
            if keep_geoms and part.get("mass") != "0":
                _refuse_mesh(part, where)
                SubElement(copy, "geom", _without(part, ("name", *_NO_MESH)))
        elif part.tag in _BODY_PARTS:
            SubElement(copy, part.tag, _without(part, ("user",)))
        elif part.tag not in _IGNORED_PARTS:
            text = f"{where} has a <{part.tag[:60]}>, which is not supported"
            hint = "save the compiled model with MuJoCo, which expands such elements"
            raise UnsupportedRobotError(text, expected=", ".join(_BODY_PARTS), hint=hint)


def _refuse_mesh(geom: Element, where: str) -> None:
    mesh = geom.get("mesh") or geom.get("hfield")
    if mesh:
        raise UnsupportedRobotError(
            f"{where} takes its inertia from the mesh {mesh!r}",
            expected="an <inertial>, or geoms that are primitive shapes",
            hint="copy the inertia that MuJoCo computes from the mesh into an <inertial>",
        )


def _couplings(equality: Element, path: Path) -> dict[str, Coupling]:
    coupled: dict[str, Coupling] = {}
    for constraint in equality:
        if constraint.get("active") == "false":
            continue
        first, second = constraint.get("joint1"), constraint.get("joint2")
        if constraint.tag == "joint" and first:
            where = f"{path}: the equality constraint of joint {first!r}: polycoef"
            offset, slope, *_ = parse_numbers(constraint.get("polycoef", "0 1 0 0 0"), where, 5)
            coupled[first] = Coupling(second or "", slope, offset)
        else:
            raise UnsupportedRobotError(
                f"{path}: equality constraint <{constraint.tag[:60]}> is not supported",
                expected="<equality> constraints between joints only",
                got=f"one on body {constraint.get('body1')!r}",
                hint="close the loop with a point constraint of this library",
            )
    return coupled


def _check_numbers(document: Element, path: Path) -> None:
    """Reject NaN, infinite and implausibly large numbers, which MuJoCo's compiler would accept."""
    for element in document.iter():
        for attribute, text in element.attrib.items():
            if attribute in _WORDS or element.tag == "mujoco":
                continue
            for word in text.split():
                try:
                    value = float(word)
                except ValueError:
                    continue
                if not abs(value) <= MAX_NUMBER:
                    error = InertiaError if element.tag == "inertial" else RobotFileError
                    name = element.get("name")
                    raise error(
                        f"{path}: <{element.tag}>{f' {name!r}' if name else ''} {attribute} is not valid",
                        expected=f"finite numbers below {MAX_NUMBER:g}",
                        got=repr(text[:80]),
                    )
