"""Scene files: a robot, its contacts and how to simulate them, in TOML (format in docs/formats.md)."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import TypeVar

import torch

from forcegp.constraints import Baumgarte, ConstrainedSystem, PointConnection, SurfaceContact
from forcegp.errors import ForceGPError, SceneError
from forcegp.robot import RobotModel, load_robot
from forcegp.robot.load import BUNDLED as BUNDLED_ROBOTS
from forcegp.scene.sections import SceneSections, config_of, validate
from forcegp.scene.toml import Document, Key
from forcegp.simulate.config import SimulationConfig

BUNDLED = ("kuka_plane", "ur5_wiping")
"""Scenes that come with the library: the paper's task, and a UR5 with undeclared friction."""

T = TypeVar("T")


@dataclass(frozen=True)
class Scene:
    """A scene file that has been read and checked; what it describes is made by `system`.

    Attributes:
        sections: the tables.
        simulation: how to simulate the scene.
        document: the file, for messages.
        folder: where relative paths start.
    """

    sections: SceneSections
    simulation: SimulationConfig
    document: Document
    folder: Path

    @property
    def noise_std(self) -> float | None:
        """Standard deviation of the noise on q̈ that models are told, or `None` for that of the data."""
        return self.sections.model.noise_std

    def robot(self, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> RobotModel:
        """The robot.

        Raises:
            SceneError: it cannot be loaded; the message names the key and line.
        """
        section = self.sections.robot
        bundled = section.model in BUNDLED_ROBOTS
        source = section.model if bundled else self.folder / section.model
        if not bundled and not Path(source).is_file():
            near = get_close_matches(section.model, BUNDLED_ROBOTS, n=1)
            raise SceneError(
                f"{self.document.place(('robot', 'model'))}: no such robot",
                expected=f"a URDF or MJCF file, or one of {', '.join(BUNDLED_ROBOTS)}",
                got=repr(section.model),
                hint=f"did you mean {near[0]!r}?" if near else f"paths start at {self.folder}",
            )
        options = section.model_dump(exclude={"model"})
        return self._made(("robot",), lambda: load_robot(source, **options, dtype=dtype, device=device))

    def system(
        self, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
    ) -> ConstrainedSystem:
        """The robot with its contacts.

        Raises:
            SceneError: a part cannot be made; the message names the key and line.
        """
        robot, parts = self.robot(dtype, device), self.sections
        contacts = [
            SurfaceContact(c.name, c.frame, c.point, self._made(("contact", i, "surface"), c.surface.build))
            for i, c in enumerate(parts.contact)
        ]
        joined = [
            PointConnection(c.name, c.frame, c.point, c.other_frame, c.other_point) for c in parts.connection
        ]
        for table, made in (("contact", contacts), ("connection", joined)):
            for i, constraint in enumerate(made):
                self._made((table, i, "frame"), lambda c=constraint: c.check(robot))
        settings = parts.baumgarte
        damped = settings and self._made(("baumgarte",), lambda: Baumgarte(**settings.model_dump()))
        everything = [*contacts, *joined]
        return self._made(("contact",), lambda: ConstrainedSystem(robot, everything, baumgarte=damped))

    def _made(self, key: Key, make: Callable[[], T]) -> T:
        """What `make` returns; its errors become errors of the scene, at this key."""
        try:
            return make()
        except ForceGPError as error:
            raise SceneError.at(self.document.place(key), error) from error


def load_scene(source: str | Path) -> Scene:
    """Read a scene file.

    Args:
        source: a path, or the name of a scene that comes with the library (`kuka_plane`, `ur5_wiping`).

    Raises:
        SceneError: no such scene, or it is not valid; the message names file, line and key.
    """
    bundled = str(source) in BUNDLED
    path = Path(str(files("forcegp.scene") / "bundled" / f"{source}.toml")) if bundled else Path(source)
    if not path.is_file():
        beside = [str(p) for p in path.parent.glob("*.toml")] if path.parent.is_dir() else []
        near = get_close_matches(str(source), [*BUNDLED, *beside], n=1)
        raise SceneError(
            f"{path}: no such scene",
            expected=f"a TOML file, or one of {', '.join(BUNDLED)}",
            hint=f"did you mean {near[0]!r}?" if near else None,
        )
    document = Document(path.read_bytes(), str(path))
    sections = validate(document)
    return Scene(sections, _simulation(document, sections), document, path.parent)


def _simulation(document: Document, sections: SceneSections) -> SimulationConfig:
    try:
        return config_of(SimulationConfig, sections.simulation)
    except ForceGPError as error:
        # The settings check themselves; the line is that of the key which their message names.
        section = document.data.get("simulation", {})
        named = next((key for key in section if re.search(rf"\b{re.escape(key)}\b", error.message)), None)
        key = ("simulation", named) if named else ("simulation",)
        raise SceneError.at(document.place(key), error) from error
