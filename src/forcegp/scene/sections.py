"""The tables of a scene file.

Surfaces, the stabilization and the simulation are described by the classes that they make, so a key of a
scene file is a parameter of that class; the other tables are described here.
"""

from __future__ import annotations

from pydantic import Field

from forcegp.constraints import Baumgarte, SurfaceSchema
from forcegp.scene.model_section import ModelSection, Section
from forcegp.simulate.config import SimulationConfig

Vector = tuple[float, float, float]


class RobotSection(Section):
    """`[robot]`: see `forcegp.load_robot`; a path is relative to the scene file."""

    model: str
    base_position: Vector = (0.0, 0.0, 0.0)
    base_rpy: Vector = (0.0, 0.0, 0.0)
    gravity: Vector = (0.0, 0.0, -9.81)
    locked_joints: dict[str, float] = Field(default_factory=dict)


class ContactSection(Section):
    """`[[contact]]`: a point of the robot that may touch a surface, or a ball of some `radius` around it."""

    name: str
    frame: str
    point: Vector = (0.0, 0.0, 0.0)
    surface: SurfaceSchema
    radius: float = 0.0


class ConnectionSection(Section):
    """`[[connection]]`: two points that coincide; without `other_frame`, the second is fixed in the world."""

    name: str
    frame: str
    point: Vector = (0.0, 0.0, 0.0)
    other_frame: str | None = None
    other_point: Vector = (0.0, 0.0, 0.0)


class SceneSections(Section):
    """All tables of a scene file; constraints are stabilized only if there is a table `[baumgarte]`."""

    robot: RobotSection
    contact: tuple[ContactSection, ...] = ()
    connection: tuple[ConnectionSection, ...] = ()
    baumgarte: Baumgarte | None = None
    simulation: SimulationConfig = Field(default_factory=SimulationConfig)
    model: ModelSection = ModelSection()
