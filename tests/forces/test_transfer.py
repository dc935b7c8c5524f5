"""Friction that is learned on one surface holds on another, and a reading in free motion knows its error."""

from __future__ import annotations

import dataclasses
import math
from functools import cache

import pytest
import torch

import forcegp
from forcegp.constraints.surface import Surface
from forcegp.data import farthest_points, standardized
from forcegp.forces.priors.sets import default_priors
from forcegp.gp.features import FLOOR, Standardization
from forcegp.models.structured_fit import StructuredFit
from forcegp.scene.load import load_scene
from forcegp.simulate import simulate

OFFSET, TILT = 0.055, math.radians(20.0)
NORMAL = (math.sin(TILT), 0.0, math.cos(TILT))
SURFACES: dict[str, Surface] = {
    "learned": forcegp.Plane((0, 0, 1), OFFSET),
    "raised": forcegp.Plane((0, 0, 1), OFFSET + 0.01),
    "tilted": forcegp.Plane(NORMAL, 0.5 * NORMAL[0] + OFFSET * NORMAL[2]),
    "sphere": forcegp.constraints.Sphere((0.5, 0.0, OFFSET - 1.0), 1.0),
}
SHORT = forcegp.models.LearningOptions(max_evaluations=60)
EXACT = 1e-9
"""Rounding of accelerations that a model knows exactly [rad/s²]."""


def on(surface: str) -> forcegp.ConstrainedSystem:
    system = load_scene("kuka_plane").system()
    (contact,) = system.contacts
    return dataclasses.replace(system, contacts=[dataclasses.replace(contact, surface=SURFACES[surface])])


@cache
def motion(surface: str, seed: int, duration: float) -> forcegp.Dataset:
    config = load_scene("kuka_plane").simulation
    return simulate(on(surface), dataclasses.replace(config, seed=seed, duration=duration)).data


@cache
def fitted(kind: str) -> StructuredFit:
    data = motion("learned", 0, 4.0)
    few = data[farthest_points(standardized(torch.cat([data.q, data.qd, data.tau], -1)), 60)]
    priors = {
        "sliding": [forcegp.priors.SlidingFrictionPrior("table")],
        "any force": [forcegp.priors.ContactForcePrior("table")],
        "defaults": default_priors(on("learned"), "analytical"),
    }
    return forcegp.StructuredGP(on("learned"), "analytical", priors[kind], noise=0.1).fit(few, options=SHORT)


def score(kind: str, surface: str, quantity: str = "qdd") -> tuple[float, float]:
    """Mean absolute error against the truth without noise, and the share of it that ±2σ hold."""
    system, data = on(surface), motion(surface, 1, 1.0)[::4]
    active = data.active(system.contact_names)
    found = fitted(kind).predict(data.q, data.qd, data.tau, quantity, system=system, active=active)
    truth = {
        "qdd": data.extras["qdd_clean"],
        "qdd_free": system.equations(data.q, data.qd, active).free_acceleration(data.Q),
    }[quantity]
    error = (found.mean - truth).abs()
    return float(error.mean()), float((error <= 2.0 * found.std + EXACT).double().mean())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sliding", "any force", "defaults"])
@pytest.mark.parametrize("surface", ["raised", "tilted", "sphere"])
def test_friction_holds_on_another_surface(kind: str, surface: str) -> None:
    here, there = score(kind, "learned"), score(kind, surface)
    assert there[0] <= 2.0 * here[0]
    assert there[1] >= 0.85


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sliding", "defaults"])
@pytest.mark.parametrize("surface", list(SURFACES))
def test_free_motion_read_from_contact_knows_its_error(kind: str, surface: str) -> None:
    assert score(kind, surface, "qdd_free")[1] >= 0.85


def test_the_coordinate_off_a_plane_is_no_input() -> None:
    """A point of the robot has the same inputs whatever the height of the surface."""
    model = fitted("any force")
    data = motion("learned", 0, 4.0)[::40]
    forces = [
        model.predict(data.q, data.qd, data.tau, "contact_friction", system=on(s))
        for s in ("learned", "raised")
    ]
    torch.testing.assert_close(forces[0].mean, forces[1].mean)


def test_a_column_that_hardly_varies_is_not_magnified() -> None:
    x = torch.randn(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x = x * torch.tensor([1.0, 0.5, 1e-5])
    alone, vector = Standardization.of({"x": x}), Standardization.of({"x": x}, ("x",))
    spread = x.std(0, correction=0)
    whole = float(spread.square().mean().sqrt())
    torch.testing.assert_close(alone.std["x"][:2], spread[:2])
    assert float(alone.std["x"][2]) == pytest.approx(FLOOR * whole)
    assert vector.std["x"].tolist() == pytest.approx([whole] * 3)


def test_features_whose_zero_means_something_are_scaled_and_not_shifted() -> None:
    x = 3.0 + torch.randn(500, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    scales = Standardization.of({"x": x}, centred=False)
    assert float(scales.apply({"x": torch.zeros_like(x)})["x"].abs().max()) == 0.0
    assert scales.apply({"x": x})["x"].square().mean(0).tolist() == pytest.approx([1.0, 1.0])
