"""Convex shapes of a robot for display and collision, from its URDF file or as rods between its joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from forcegp.robot.load import BUNDLED, robot_path
from forcegp.robot.model import RobotModel
from forcegp.robot.safety import parse_numbers, parse_xml, read_bytes

Array = NDArray[np.float64]
MESHES = (".stl", ".obj", ".ply", ".glb")
"""Supported mesh formats. Parts in other formats are skipped."""
MESH_BYTES = 1 << 25
MESH_CORNERS = 200
"""Maximum number of vertices of the convex hull of a mesh."""
LEAST = 1e-3
"""Minimum length of a rod [m]."""
SIZES = {"box": {"size": 3}, "cylinder": {"radius": 1, "length": 1}, "sphere": {"radius": 1}}
"""Attributes of the shapes in a URDF file, with the number of values in each."""


@dataclass(frozen=True)
class Shape:
    """A convex part of the link of joint `link` (−1: base), with vertices `(k, 3)` in the link frame [m]."""

    link: int
    points: Array


def box(x: float, y: float, z: float) -> Array:
    """Return the vertices `(8, 3)` of a box centred at the origin with the given side lengths [m]."""
    signs = np.stack(np.meshgrid(*3 * [[-0.5, 0.5]], indexing="ij"), axis=-1)
    return signs.reshape(-1, 3) * [x, y, z]


def cylinder(radius: float, length: float, corners: int = 24) -> Array:
    """Return the vertices `(2 corners, 3)` of a cylinder along z, centred at the origin [m]."""
    angle = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle], axis=-1)
    half = np.array([0.0, 0.0, 0.5 * length])
    return np.concatenate([ring - half, ring + half])


def sphere(radius: float) -> Array:
    """Return the vertices `(k, 3)` of a sphere centred at the origin [m]."""
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
    return np.concatenate([cylinder(radius * np.cos(a), 2.0 * radius * np.sin(a), 24)[:24] for a in angles])


def turn_z(direction: Array) -> Array:
    """Return the shortest rotation `(3, 3)` from the z axis to a unit direction."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine, cosine = float(np.linalg.norm(axis)), float(direction[2])
    if sine < 1e-12:
        return np.diag([1.0, np.sign(cosine), np.sign(cosine)])
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()


def shapes_of(
    robot: RobotModel, source: str | Path | None = None, elements: Sequence[str] = ("visual",)
) -> list[Shape]:
    """Return the parts of a robot from its own or a bundled URDF file, or rods between its joints.

    The default is the file of a bundled robot with the same name and frames. Of the `elements` (`"visual"`,
    `"collision"`), the first that the file contains is used.

    Raises:
        RobotFileError: the shapes in the file are invalid.
    """
    if source is None and robot.name not in BUNDLED:
        return rods(robot)
    path = robot_path(robot.name if source is None else source)
    root = parse_xml(read_bytes(path), str(path))
    shapes = (_parts(root, path, robot, element) for element in elements if root.tag == "robot")
    return next(filter(None, shapes), None) or rods(robot)


def rods(robot: RobotModel) -> list[Shape]:
    """Return rods to each joint, and rods to the last frame of each link."""
    place, at = robot.placement_position.detach().cpu().numpy(), robot.frame_position.detach().cpu().numpy()
    ends = list(zip(robot.parents, place, strict=True))
    for link in range(robot.nq):
        frames = [at[i] for i, parent in enumerate(robot.frame_parents) if parent == link]
        if link not in robot.parents and frames:
            ends.append((link, max(frames, key=lambda x: float(np.linalg.norm(x)))))
    radius = 0.02 * sum(float(np.linalg.norm(end)) for _, end in ends)
    return [
        Shape(link, cylinder(radius, length) @ turn_z(end / length).T + 0.5 * end)
        for link, end in ends
        if (length := float(np.linalg.norm(end))) > LEAST
    ]


def _parts(root: Element, path: Path, robot: RobotModel, element: str) -> list[Shape]:
    """Return the visual or collision elements of those links in a URDF document that are robot frames."""
    parts = []
    for link in root.findall("link"):
        name = link.get("name", "")
        if name not in robot.frame_names:
            continue
        index = robot.frame_index(name)
        R = robot.frame_rotation[index].detach().cpu().numpy()
        p = robot.frame_position[index].detach().cpu().numpy()
        for part in link.findall(element):
            points = _corners(part, f"{path}: link {name!r}", path.parent)
            if points is not None:
                parts.append(Shape(robot.frame_parents[index], points @ R.T + p))
    return parts


def _corners(part: Element, where: str, folder: Path) -> Array | None:
    """Return the vertices of a part in the frame of its link, or `None` if it cannot be displayed."""
    origin, geometry = part.find("origin"), part.find("geometry")
    if geometry is None or not len(geometry):
        return None
    place = {} if origin is None else origin.attrib
    position = np.array(parse_numbers(place.get("xyz", "0 0 0"), f"{where}: origin xyz", 3))
    rpy = parse_numbers(place.get("rpy", "0 0 0"), f"{where}: origin rpy", 3)
    body = geometry[0]
    if body.tag == "mesh":
        file = _mesh_file(body.get("filename", ""), folder)
        scale = parse_numbers(body.get("scale", "1 1 1"), f"{where}: mesh scale", 3)
        points = None if file is None else _hull(file) * scale
    else:
        sizes = [
            number
            for name, count in SIZES.get(body.tag, {}).items()
            for number in parse_numbers(body.get(name, ""), f"{where}: {body.tag} {name}", count)
        ]
        makers = {"box": box, "cylinder": cylinder, "sphere": sphere}
        points = makers[body.tag](*sizes) if sizes else None
    return None if points is None else points @ Rotation.from_euler("xyz", rpy).as_matrix().T + position


def _hull(file: Path) -> Array:
    """Return the vertices of the convex hull of a mesh, reduced to at most `MESH_CORNERS`."""
    import trimesh

    points = np.asarray(trimesh.load(str(file), force="mesh").vertices, dtype=np.float64)  # pyright: ignore
    try:
        corners = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # flat, or with fewer than four points
        corners = points
    return corners[:: -(-len(corners) // MESH_CORNERS) or 1]


def _mesh_file(name: str, folder: Path) -> Path | None:
    """Return a mesh file named in a robot file if it is in the folder or package of the file, else `None`."""
    package, _, rest = name.removeprefix("package://").partition("/")
    if name.startswith("package://"):
        roots = [parent / package for parent in (folder, *folder.resolve().parents)] + [folder]
    elif "://" in name:
        return None
    else:
        roots, rest = [folder], name
    for root in roots:
        try:
            path = (root / rest).resolve()
            usable = path.is_file() and path.is_relative_to(root.resolve())
        except (OSError, ValueError):
            continue
        if usable and path.suffix.lower() in MESHES and path.stat().st_size <= MESH_BYTES:
            return path
    return None
