"""The tables of a scene file, as they are validated, and the messages for what is wrong in them."""

from __future__ import annotations

import json
import re
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model
from pydantic_core import ErrorDetails

from forcegp.constraints import Cylinder, Plane, Sphere
from forcegp.errors import SceneError
from forcegp.scene.toml import Document, Key
from forcegp.simulate.config import SimulationConfig

Vector = tuple[float, float, float]
T = TypeVar("T")


class Section(BaseModel):
    """A table of a scene file: no key that is not known, no number that is not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def _section_of(config: type) -> type[Section]:
    """The table whose keys are the fields of a data class of settings, with its defaults."""
    hints, default = get_type_hints(config), config()
    keys: dict[str, Any] = {}
    for field in fields(config):
        value = getattr(default, field.name)
        if is_dataclass(value):
            inner = _section_of(type(value))
            keys[field.name] = (inner, inner())
        else:
            keys[field.name] = (hints[field.name], value)
    return create_model(config.__name__, __base__=Section, **keys)


def config_of(config: type[T], section: BaseModel) -> T:
    """The data class of settings with the values of its table."""
    default = config()
    values: dict[str, Any] = {}
    for name, value in section:
        nested = getattr(default, name)
        values[name] = config_of(type(nested), value) if is_dataclass(nested) else value
    return config(**values)


class RobotSection(Section):
    """`[robot]`: see `forcegp.load_robot`; a path is relative to the scene file."""

    model: str
    base_position: Vector = (0.0, 0.0, 0.0)
    base_rpy: Vector = (0.0, 0.0, 0.0)
    gravity: Vector = (0.0, 0.0, -9.81)
    locked_joints: dict[str, float] = {}


class PlaneSection(Section):
    """A plane, n·p = offset."""

    type: Literal["plane"]
    normal: Vector = (0.0, 0.0, 1.0)
    offset: float = 0.0

    def build(self) -> Plane:
        return Plane(self.normal, self.offset)


class SphereSection(Section):
    """A sphere, touched from outside."""

    type: Literal["sphere"]
    center: Vector
    radius: float

    def build(self) -> Sphere:
        return Sphere(self.center, self.radius)


class CylinderSection(Section):
    """An infinite cylinder, touched from outside."""

    type: Literal["cylinder"]
    center: Vector
    axis: Vector
    radius: float

    def build(self) -> Cylinder:
        return Cylinder(self.center, self.axis, self.radius)


class ContactSection(Section):
    """`[[contact]]`: a point of the robot that may touch a surface."""

    name: str
    frame: str
    point: Vector = (0.0, 0.0, 0.0)
    surface: Annotated[PlaneSection | SphereSection | CylinderSection, Field(discriminator="type")]


class ConnectionSection(Section):
    """`[[connection]]`: two points that coincide; without `other_frame`, the second is fixed in the world."""

    name: str
    frame: str
    point: Vector = (0.0, 0.0, 0.0)
    other_frame: str | None = None
    other_point: Vector = (0.0, 0.0, 0.0)


class BaumgarteSection(Section):
    """`[baumgarte]`: stabilization of the constraints; without the table there is none."""

    natural_frequency: float = 10.0
    damping_ratio: float = 1.0


class ModelSection(Section):
    """`[model]`: what the models are told."""

    noise_std: float | None = Field(default=None, ge=0.0)


if TYPE_CHECKING:

    class SimulationSection(Section):
        """`[simulation]`: the fields of `SimulationConfig`."""
else:
    SimulationSection = _section_of(SimulationConfig)


class SceneSections(Section):
    """All tables of a scene file."""

    robot: RobotSection
    contact: tuple[ContactSection, ...] = ()
    connection: tuple[ConnectionSection, ...] = ()
    baumgarte: BaumgarteSection | None = None
    simulation: SimulationSection = SimulationSection()
    model: ModelSection = ModelSection()


def validate(document: Document) -> SceneSections:
    """Check a document against the tables.

    Raises:
        SceneError: the first thing that is wrong, with its line and key.
    """
    # JSON is the form in which strict validation takes a list for a tuple and an integer for a number.
    text = json.dumps(document.data, default=str)
    try:
        return SceneSections.model_validate_json(text)
    except ValidationError as error:
        # A misspelt key is also a missing one: the spelling is what there is to correct.
        errors = sorted(error.errors(), key=lambda found: found["type"] != "extra_forbidden")
        raise _scene_error(document, errors[0]) from error


def _scene_error(document: Document, error: ErrorDetails) -> SceneError:
    """The message of the first thing that is wrong."""
    key, context = error["loc"], error.get("ctx", {})
    place = document.place(key)
    if error["type"] == "extra_forbidden":
        known = _known_keys(key)
        near = get_close_matches(str(key[-1]), known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else None
        return SceneError(f"{place}: unknown key", expected=f"one of {', '.join(known)}", hint=hint)
    if error["type"] == "missing" and isinstance(key[-1], int):
        return SceneError(f"{place}: too few numbers", expected=f"more than {key[-1]}")
    if error["type"] == "union_tag_not_found":
        return SceneError(f"{place}: key 'type' is missing", expected="plane, sphere or cylinder")
    if error["type"] == "missing":
        return SceneError(f"{place}: key {str(key[-1])!r} is missing", expected=f"{key[-1]} = …")
    if error["type"] == "union_tag_invalid":
        tags = re.findall(r"'(\w+)'", context["expected_tags"])
        near = get_close_matches(str(context["tag"]), tags, n=1)
        return SceneError(
            f"{document.place((*key, 'type'))}: unknown kind of surface",
            expected=f"one of {', '.join(tags)}",
            got=repr(context["tag"]),
            hint=f"did you mean {near[0]!r}?" if near else None,
        )
    return SceneError(f"{place}: {error['msg'][0].lower()}{error['msg'][1:]}", got=repr(error["input"]))


def _known_keys(key: Key) -> list[str]:
    """The keys of the table that a key stands in."""
    tables: list[type[Section]] = [SceneSections]
    for part in key[:-1]:
        named = [table.model_fields[part].annotation for table in tables if part in table.model_fields]
        if named:
            tables = [table for annotation in named for table in _tables_in(annotation)]
        elif isinstance(part, str):  # the tag of a union, such as the kind of a surface
            tables = [table for table in tables if part in get_args(table.model_fields["type"].annotation)]
    return [name for table in tables for name in table.model_fields]


def _tables_in(annotation: Any) -> list[type[Section]]:
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [table for part in get_args(annotation) for table in _tables_in(part)]
