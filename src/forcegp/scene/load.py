"""Scene files in TOML, which describe a robot, its contacts and a simulation (see docs/formats.md)."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import torch

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import SceneError, did_you_mean
from forcegp.guards import is_file
from forcegp.robot import RobotModel, load_robot
from forcegp.robot.load import BUNDLED as BUNDLED_ROBOTS
from forcegp.scene.document import Document
from forcegp.scene.sections import ModelFile, ModelSection, SceneSections
from forcegp.simulate.config import SimulationConfig

FOLDER = Path(str(files("forcegp.scene") / "bundled"))
BUNDLED = tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))
"""Names of the bundled scenes. `kuka_plane` is the task in the paper."""


@dataclass(frozen=True)
class ModelTable:
    """The table `[model]` for `forcegp.models.configured`, and the file that error messages refer to."""

    section: ModelSection
    document: Document


@dataclass(frozen=True)
class Scene:
    """A validated scene file. Its paths are relative to `folder`."""

    sections: SceneSections
    document: Document
    folder: Path

    @property
    def simulation(self) -> SimulationConfig:
        """Settings of the simulation."""
        return self.sections.simulation

    @property
    def model(self) -> ModelTable:
        """Settings of the model to fit."""
        return ModelTable(self.sections.model, self.document)

    @property
    def robot_source(self) -> str | Path:
        """Name of the bundled robot, or path of the robot file."""
        named = self.sections.robot.model
        return named if named in BUNDLED_ROBOTS else self.folder / named

    def robot(self, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> RobotModel:
        """Return the robot; raise a `SceneError` that names the key and line of an invalid entry."""
        section, source = self.sections.robot, self.robot_source
        if isinstance(source, Path) and not is_file(source):
            raise SceneError(
                f"{self.document.place(('robot', 'model'))}: no such robot",
                expected=f"a URDF or MJCF file, or one of {', '.join(BUNDLED_ROBOTS)}",
                got=repr(section.model),
                hint=did_you_mean(section.model, BUNDLED_ROBOTS) or f"paths start at {self.folder}",
            )
        options = section.model_dump(exclude={"model"})
        return self.document.at(("robot",), load_robot, source, **options, dtype=dtype, device=device)

    def system(
        self, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
    ) -> ConstrainedSystem:
        """Return the robot with its contacts; raise a `SceneError` that locates an invalid entry."""
        robot, sections, at = self.robot(dtype, device), self.sections, self.document.at
        tables = [(("contact", i), table) for i, table in enumerate(sections.contact)]
        tables += [(("connection", i), table) for i, table in enumerate(sections.connection)]
        constraints = [table.build() for _, table in tables]
        for (key, _), constraint in zip(tables, constraints, strict=True):
            at((*key, "frame"), constraint.check, robot)
        return at(("contact",), ConstrainedSystem, robot, constraints, baumgarte=sections.baumgarte)


def load_scene(source: str | Path) -> Scene:
    """Read a scene file by path, or a bundled scene by name.

    The robot file is not read at this point.

    Example:
        >>> load_scene("kuka_plane").system().contact_names
        ('table',)

    Raises:
        SceneError: the scene does not exist or is invalid. The message names the file, line and key.
    """
    path = FOLDER / f"{source}.toml" if str(source) in BUNDLED else Path(source)
    if not is_file(path):
        beside = []
        with suppress(OSError, ValueError):
            beside = [str(p) for p in path.parent.glob("*.toml")]
        text, hint = f"{path}: no such scene", did_you_mean(source, [*BUNDLED, *beside])
        raise SceneError(text, expected=f"a TOML file, or one of {', '.join(BUNDLED)}", hint=hint)
    document = Document(path.read_bytes(), str(path))
    return Scene(document.validated(SceneSections), document, path.parent)


def default_model_table() -> ModelTable:
    """Return a table `[model]` that contains only default values."""
    return ModelTable(ModelSection(), Document(b"", "default model"))


def load_model_table(path: str | Path) -> ModelTable:
    """Read a TOML file that contains only the table `[model]`; raise `SceneError` if it is invalid."""
    if not is_file(Path(path)):
        raise SceneError(f"{path}: no such model file", expected="a TOML file with a table [model]")
    document = Document(Path(path).read_bytes(), str(path))
    return ModelTable(document.validated(ModelFile).model, document)
