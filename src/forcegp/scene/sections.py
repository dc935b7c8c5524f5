"""The tables of a scene file.

Surfaces, the stabilization and the simulation are described by the classes that they make, so a key of a
scene file is a parameter of that class; the other tables are described here.

The table `[model]` of a scene file or of a file of its own: which model, and how it learns.

Names and values are those of the arguments in Python and of the fields in saved models; a key that is left
out has the default of the model. Priors and kernels are described as in saved models (`settings.priors`).
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    field_validator,
)

from forcegp.constraints import Baumgarte, SurfaceSchema
from forcegp.simulate.config import SimulationConfig
from forcegp.storage.options import StructuredOptions


class Section(BaseModel):
    """A table of a TOML file: unknown keys and numbers that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    def given(self) -> dict[str, Any]:
        """The keys that are in the file, with their values."""
        return {name: getattr(self, name) for name in self.model_fields_set}


State = NonNegativeFloat | tuple[NonNegativeFloat, ...]
"""Noise of positions or velocities, as one number or one per joint."""


class LearningSection(Section):
    """`[model.learning]`: fields of `LearningOptions`, or of `BatchOptions` for what learns on batches.

    `warm_start = false` learns on all samples from the start.
    """

    optimizer: Literal["lbfgs", "adam"] = "lbfgs"
    max_evaluations: PositiveInt = 1
    tolerance: PositiveFloat = 1.0
    learning_rate: PositiveFloat = 1.0
    analytical_learning_rate: PositiveFloat = 1.0
    patience: PositiveInt = 1
    warm_start: Literal[False] | PositiveInt = False
    restarts: NonNegativeInt = 0
    seed: NonNegativeInt = 0
    hyperpriors: bool = True
    epochs: PositiveInt = 1
    batch: PositiveInt = 1
    held_out: PositiveFloat = 0.1


class WindowSection(Section):
    """`[model.window]`: how far from the robot file the model `analytical` starts."""

    relative: NonNegativeFloat = 0.0
    length: NonNegativeFloat = 0.0
    angle: NonNegativeFloat = 0.0


class NoiseSection(Section):
    """`[model.noise]`: fields of `Noise`; `torque = "none"` for none."""

    acceleration: NonNegativeFloat | tuple[NonNegativeFloat, ...] | None = None
    learn: bool = False
    torque: PositiveFloat | tuple[PositiveFloat, ...] | Literal["auto", "learn", "none"] = "auto"
    state: tuple[State, State] | None = None
    degrees_of_freedom: PositiveFloat | None = None


class ModelSection(Section, StructuredOptions):
    """`[model]`: the options of models, and what `forcegp.models.configured` reads."""

    name: str | None = None
    noise: NoiseSection = NoiseSection()
    sensor_noise_std: PositiveFloat | None = None
    mean: Literal["zero", "analytical"] | tuple[str, ...] = "zero"
    priors: str | tuple[dict[str, Any], ...] = ()
    analytical_parameters: dict[str, Literal["all"] | tuple[str, ...]] = {}
    hidden: tuple[PositiveInt, ...] = ()
    window: WindowSection = WindowSection()
    seed: NonNegativeInt | None = None
    learning: LearningSection = LearningSection()

    @field_validator("noise", mode="before")
    @classmethod
    def _of_accelerations(cls, value: object) -> object:
        """A number, or a list of them, is the noise of accelerations."""
        return _tuples({"acceleration": value} if isinstance(value, int | float | list) else value)


def _tuples(value: Any) -> Any:
    """Lists as tuples, which strict validation asks for after a validator in Python."""
    if isinstance(value, dict):
        return {key: _tuples(part) for key, part in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


class ModelFile(Section):
    """A file with the table `[model]` alone."""

    model: ModelSection


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
