"""Schemas of the tables in a scene file.

The keys are constructor parameters of the class that a table describes, or fields of saved models. Keys that
are missing from `[model]` take the default values of the model.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, field_validator

from forcegp.constraints import Baumgarte
from forcegp.files import Record
from forcegp.options import Inference, Window
from forcegp.robot.tree import Base
from forcegp.simulate.config import SimulationConfig
from forcegp.storage.system import ConnectionFields, ContactFields, Point


class Section(Record, strict=True):
    """A table of a TOML file."""

    def given(self) -> dict[str, Any]:
        """Return the keys that are present in the file, with their values."""
        return {name: getattr(self, name) for name in self.model_fields_set}


State = NonNegativeFloat | tuple[NonNegativeFloat, ...]
"""Standard deviation of the noise in positions or velocities, as a single number or one number per joint."""


class LearningSection(Section):
    """`[model.learning]`: fields of `LearningOptions`, or of `BatchOptions` for models trained on batches.

    If `warm_start` is false, all samples are used from the start.
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


class NoiseSection(Section):
    """`[model.noise]`: fields of `Noise`. `torque = "none"` means that torques are exact."""

    acceleration: NonNegativeFloat | tuple[NonNegativeFloat, ...] | None = None
    learn: bool = False
    torque: PositiveFloat | tuple[PositiveFloat, ...] | Literal["auto", "learn", "none"] = "auto"
    state: tuple[State, State] | None = None
    degrees_of_freedom: PositiveFloat | None = None
    external: dict[str, PositiveFloat] | None = None


class ModelSection(Section):
    """`[model]`: arguments of models, and the additional keys that `forcegp.models.configured` uses."""

    name: str | None = None
    noise: NoiseSection = NoiseSection()
    sensor_noise_std: PositiveFloat | None = None
    mean: Literal["zero", "analytical"] | tuple[str, ...] = "analytical"
    priors: tuple[dict[str, Any], ...] = ()
    inference: Inference = Inference()
    inertia: Literal["file", "auto"] | None = None
    standardize: bool = True
    analytical_parameters: dict[str, Literal["all"] | tuple[str, ...]] = Field(default_factory=dict)
    hidden: tuple[PositiveInt, ...] = ()
    window: Window = Window()
    seed: NonNegativeInt | None = None
    learning: LearningSection = LearningSection()

    @field_validator("noise", mode="before")
    @classmethod
    def _of_accelerations(cls, value: object) -> object:
        """Interpret a number or a list of numbers as the noise in the accelerations."""
        return _tuples({"acceleration": value} if isinstance(value, int | float | list) else value)

    @field_validator("inference", mode="before")
    @classmethod
    def _of_method(cls, value: object) -> object:
        """Interpret a string as the method."""
        return {"method": value} if isinstance(value, str) else value


def _tuples(value: Any) -> Any:
    """Convert lists to tuples, since strict validation after a Python validator rejects lists."""
    if isinstance(value, dict):
        return {key: _tuples(part) for key, part in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


class ModelFile(Section):
    """A file that contains only the table `[model]`."""

    model: ModelSection


class RobotSection(Section):
    """`[robot]`: arguments of `forcegp.load_robot`. A path is relative to the folder of the scene file."""

    model: str
    base: Base = "fixed"
    base_position: Point = (0.0, 0.0, 0.0)
    base_rpy: Point = (0.0, 0.0, 0.0)
    gravity: Point | None = None
    locked_joints: dict[str, float] = Field(default_factory=dict)
    coupling: dict[str, dict[str, float]] | tuple[tuple[float, ...], ...] | None = None


class ContactSection(ContactFields, strict=True):
    """`[[contact]]`: a surface, and a point on the robot or a ball of the given `radius` around it."""


class ConnectionSection(ConnectionFields, strict=True):
    """`[[connection]]`: two coincident points. Without `other_frame`, the second is fixed in the world."""


class SceneSections(Section):
    """All tables of a scene file. Constraints are stabilized only if there is a `[baumgarte]` table."""

    robot: RobotSection
    contact: tuple[ContactSection, ...] = ()
    connection: tuple[ConnectionSection, ...] = ()
    baumgarte: Baumgarte | None = None
    simulation: SimulationConfig = Field(default_factory=SimulationConfig)
    model: ModelSection = ModelSection()
