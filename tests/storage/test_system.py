"""A system as JSON and tensors, and back."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.errors import ModelError
from forcegp.storage.system import pack_system, unpack_system

SURFACES = [
    forcegp.Plane(normal=(0.3, -0.2, 0.7), offset=0.1),
    forcegp.constraints.Sphere(center=(0.5, 0.1, -1.0), radius=1.1),
    forcegp.constraints.Cylinder(center=(0.5, 0.0, -0.3), axis=(0.1, 1.0, 0.3), radius=0.4),
]


def system_with(
    *contacts: forcegp.SurfaceContact | forcegp.constraints.PointConnection,
) -> forcegp.ConstrainedSystem:
    robot = forcegp.load_robot("kuka_iiwa", base_position=(0.0, 0.0, 0.05), gravity=(0.0, 0.0, -9.8))
    return forcegp.ConstrainedSystem(robot, contacts, baumgarte=forcegp.constraints.Baumgarte(9.0, 0.7))


def contact(surface: object, name: str = "table") -> forcegp.SurfaceContact:
    return forcegp.SurfaceContact(name, "lbr_iiwa_link_7", (0.0, 0.01, 0.1), surface)  # type: ignore[arg-type]


def through_text(system: forcegp.ConstrainedSystem) -> tuple[dict, dict[str, Tensor]]:
    record, tensors = pack_system(system)
    return json.loads(json.dumps(record, allow_nan=False)), tensors


@pytest.mark.parametrize("surface", SURFACES, ids=lambda s: type(s).__name__)
def test_round_trip_is_exact(surface: object) -> None:
    connection = forcegp.constraints.PointConnection(
        "rod", "lbr_iiwa_link_5", (0.0, 0.0, 0.1), None, (0.1, 0.2, 0.3)
    )
    system = system_with(contact(surface), connection)
    read = unpack_system(*through_text(system), "here")
    assert read.contacts == system.contacts
    assert read.baumgarte == system.baumgarte
    assert read.robot.fingerprint == system.robot.fingerprint
    for field in dataclasses.fields(system.robot):
        old, new = getattr(system.robot, field.name), getattr(read.robot, field.name)
        assert torch.equal(old, new) if isinstance(old, Tensor) else old == new, field.name


def test_precision_is_kept() -> None:
    system = system_with(contact(SURFACES[0]))
    single = system.with_robot(system.robot.to(dtype=torch.float32))
    assert unpack_system(*through_text(single), "here").robot.dtype == torch.float32


def test_a_surface_in_python_is_given_again() -> None:
    own = contact(forcegp.constraints.ImplicitSurface(lambda p: p[2] - 0.055), "hill")
    system = system_with(contact(SURFACES[0]), own)
    packed = through_text(system)
    with pytest.raises(ModelError, match=r"'hill' is a ImplicitSurface defined in Python.*\n.*load_model"):
        unpack_system(*packed, "here")
    assert unpack_system(*packed, "here", fallback=system).contacts == system.contacts
    with pytest.raises(ModelError, match="unknown contact 'hill'"):
        unpack_system(*packed, "here", fallback=system_with())


def change(record: dict, place: str, value: object) -> None:
    *path, last = place.split(".")
    for key in path:
        record = record[int(key)] if isinstance(record, list) else record[key]
    record[int(last) if isinstance(record, list) else last] = value


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("robot.parents.3", 5),
        ("robot.frame_parents.0", 7),
        ("robot.joint_types.0", "ball"),
        ("robot.joint_names", ["only one"]),
        ("contacts.0.surface.normal", [0.0, 1.0]),
        ("contacts.0.surface.type", "cone"),
        ("contacts.0.surface.offset", float("nan")),
        ("contacts.0.surface.colour", "red"),
        ("contacts.0.colour", "red"),
        ("baumgarte.damping_ratio", None),
    ],
)
def test_a_changed_field_is_named(place: str, value: object) -> None:
    record, tensors = through_text(system_with(contact(SURFACES[0])))
    change(record, place, value)
    with pytest.raises(ModelError) as error:
        unpack_system(record, tensors, "model.json")
    assert "model.json" in str(error.value)
    assert place.split(".")[1] in str(error.value) or "joint" in str(error.value)


@pytest.mark.parametrize("place", ["contacts.0.surface.normal", "contacts.0.frame"])
def test_a_valid_field_that_does_not_fit_is_named(place: str) -> None:
    record, tensors = through_text(system_with(contact(SURFACES[0])))
    change(record, place, [0.0, 0.0, 0.0] if place.endswith("normal") else "no_such_link")
    with pytest.raises(ModelError, match=r"model\.json: field 'system.*': .*(direction|frame)"):
        unpack_system(record, tensors, "model.json")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("mass", None, "is missing"),
        ("inertia", torch.zeros(7, 3, dtype=torch.float64), "does not fit"),
        ("com", torch.zeros(7, 3, dtype=torch.float32), "does not fit"),
        ("gravity", torch.tensor([0.0, float("nan"), 0.0], dtype=torch.float64), "not finite"),
        ("base_position", torch.full((3,), float("inf"), dtype=torch.float64), "not finite"),
    ],
)
def test_a_changed_tensor_is_named(name: str, value: Tensor | None, message: str) -> None:
    record, tensors = through_text(system_with())
    if value is None:
        del tensors[f"system.{name}"]
    else:
        tensors[f"system.{name}"] = value
    with pytest.raises(ModelError, match=rf"model\.json: tensor 'system\.{name}' .*{message}"):
        unpack_system(record, tensors, "model.json")
