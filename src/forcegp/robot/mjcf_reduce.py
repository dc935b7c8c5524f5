"""Reduction of MJCF documents to their mechanics, before MuJoCo compiles them.

Bodies, joints, sites, geoms, inertias, tendons, actuators, equalities and defaults are kept. Elements for
visuals, sensors or collisions are dropped, so meshes and textures are never opened. Unsupported elements that
affect motion cause errors.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from forcegp.errors import InertiaError, RobotFileError, UnsupportedRobotError
from forcegp.robot.free_base import free_mjcf
from forcegp.robot.safety import MAX_ELEMENTS, MAX_NUMBER, parse_xml, read_bytes
from forcegp.robot.tree import Base

_IGNORED_SECTIONS = ("size", "statistic", "visual", "asset", "contact", "sensor", "keyframe", "custom")
_KEPT_SECTIONS = ("default", "actuator", "tendon", "equality")
_BODY_PARTS = ("body", "frame", "joint", "freejoint", "inertial", "site", "geom")
_IGNORED_PARTS = ("camera", "light")
_COMPILER = (
    "autolimits", "boundmass", "boundinertia", "settotalmass", "balanceinertia", "coordinate", "angle",
    "eulerseq", "inertiafromgeom", "inertiagrouprange", "alignfree",
)  # fmt: skip
_OF_PLUGINS = (
    "name", "class", "joint", "jointinparent", "tendon", "gear", "forcerange", "forcelimited", "armature",
    "damping",
)  # fmt: skip
"""Attributes that an actuator of a plugin shares with other actuators."""
_FLAGS = "gravity", "damper", "frictionloss", "passive"
"""Flags that switch off forces of the robot; the last one is of older versions of MuJoCo."""
_LOOKS = ("user", "material")
_EQUALITIES = ("joint", "tendon", "connect", "weld")
_WORDS = (
    "name", "class", "childclass", "joint", "joint1", "joint2", "jointinparent", "tendon", "tendon1",
    "tendon2", "body", "body1", "body2", "site", "site1", "site2", "refsite", "cranksite", "slidersite",
    "sidesite", "geom", "mesh", "hfield",
)  # fmt: skip
"""Attributes that are names and not numbers."""


def reduce_mjcf(root: Element, path: Path, base: Base = "fixed") -> tuple[Element, list[str]]:
    """Return the reduced document, with files included from its folder, and notes. Raise typed errors that
    name invalid or unsupported elements.
    """
    _expand_includes(root, path)
    if base == "free":
        free_mjcf(root, str(path))
    document = Element("mujoco", model=root.get("model", path.stem))
    remarks: list[str] = []
    for section in root:
        where = f"{path}: <{section.tag}>"
        if section.tag == "compiler":
            SubElement(document, "compiler", _only(section, _COMPILER))
        elif section.tag == "option":
            option = SubElement(document, "option", _only(section, ("gravity",)))
            for flag in section.iter("flag"):
                SubElement(option, "flag", _only(flag, _FLAGS))
            fluid = ", ".join(name for name in ("density", "viscosity", "wind") if section.get(name))
            remarks += [f"{where}: the forces of {fluid} are ignored"] if fluid else []
        elif section.tag == "worldbody":
            document.append(_copy_body(section, f"{path}: body"))
        elif section.tag in _KEPT_SECTIONS:
            document.append(_copy_section(section, path))
        elif section.tag not in _IGNORED_SECTIONS:
            text = f"{where} is not supported"
            raise UnsupportedRobotError(text, expected="bodies with joints", got=section.tag)
    _check_numbers(document, path)
    return document, remarks


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


def _only(element: Element, names: tuple[str, ...]) -> dict[str, str]:
    return {k: element.attrib[k] for k in names if k in element.attrib}


def _without(element: Element, names: tuple[str, ...]) -> dict[str, str]:
    return {k: v for k, v in element.attrib.items() if k not in names}


def _copy_section(section: Element, path: Path) -> Element:
    """Copy a section without user data and materials; refuse equalities of objects that are dropped."""
    copy = Element(section.tag, _without(section, _LOOKS))
    for child in section:
        if section.tag == "equality" and child.tag not in _EQUALITIES:
            raise unsupported_equality(path, child.tag, child.get("name"))
        if section.tag == "actuator" and child.tag == "plugin":
            SubElement(copy, "general", _only(child, _OF_PLUGINS))
        else:
            copy.append(_copy_section(child, path))
    return copy


def unsupported_equality(path: Path, kind: str, got: str | None) -> UnsupportedRobotError:
    """Return the error for an equality constraint that does not couple two joints."""
    return UnsupportedRobotError(
        f"{path}: equality constraint <{kind[:60]}> is not supported",
        expected="<equality> constraints between joints only",
        got=f"one of {got!r}",
        hint="close the loop with a point constraint of this library",
    )


def _copy_body(body: Element, where: str) -> Element:
    copy = Element(body.tag, _without(body, ("user", "mocap", "sleep")))
    _copy_parts(body, copy, f"{where} {body.get('name', '(unnamed)')!r}")
    return copy


def _copy_parts(source: Element, copy: Element, where: str) -> None:
    for part in source:
        if part.tag == "body":
            copy.append(_copy_body(part, where.rsplit(" ", 1)[0]))
        elif part.tag == "frame":
            _copy_parts(part, SubElement(copy, "frame", part.attrib), where)
        elif part.tag in _BODY_PARTS:
            SubElement(copy, part.tag, _without(part, _LOOKS))
        elif part.tag not in _IGNORED_PARTS:
            text = f"{where} has a <{part.tag[:60]}>, which is not supported"
            hint = "save the compiled model with MuJoCo, which expands such elements"
            raise UnsupportedRobotError(text, expected=", ".join(_BODY_PARTS), hint=hint)


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
