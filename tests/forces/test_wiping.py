"""The multiplier without a force sensor, on a contact that this library did not compute (MuJoCo's solver)."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import forcegp
from forcegp.evaluation import evaluate
from forcegp.forces.coulomb import coulomb_keys
from forcegp.logs.surface_fit import fit_surface
from forcegp.models.registry import create
from forcegp.scene import load_scene
from forcegp.simulate import simulate

pytest.importorskip("mujoco")

SETTLED = 25
"""Samples after a contact closes until the soft contact no longer bounces, 0.1 s."""
EVERY = 15
"""The soft contact is sampled at 250 Hz; so many samples apart, they are nearly independent."""


def in_contact(data: forcegp.Dataset) -> torch.Tensor:
    """Rows in which the contact has been closed for 0.1 s, and stays closed for one sample more."""
    closed = data.contact["table"]
    calm = closed.clone()
    for row in (closed[1:] != closed[:-1]).nonzero()[:, 0].tolist():
        calm[max(0, row - 1) : row + 1 + SETTLED] = False
    calm[:SETTLED] = False
    return calm.nonzero()[:, 0]


@pytest.mark.slow
def test_the_normal_force_is_found_without_a_force_sensor() -> None:
    scene = load_scene("ur5_wiping")
    log = simulate(scene.system(), replace(scene.simulation, duration=24.0)).data
    train, test = log[: 18 * 250 : EVERY], log[18 * 250 :]
    test = test[in_contact(test)]
    model = create("sgp-real", scene.system())
    fit = model.fit(train)
    read = fit.predict(test.q, test.qd, test.tau, "multiplier", active=test.active(("table",)), noise=True)
    truth = test.multiplier["table"]
    error = read.mean[:, 0] - truth
    assert abs(float(error.mean())) < 0.4 and float(error.std()) < 1.0
    assert float(torch.corrcoef(torch.stack([read.mean[:, 0], truth]))[0, 1]) > 0.95
    assert 0.9 <= float((error.abs() <= 2.0 * read.std[:, 0]).double().mean()) <= 0.98
    scored = evaluate(model, test, compare=False).multipliers[0]
    assert scored.coverage is not None and 0.9 <= scored.coverage <= 0.98
    coefficient = float(fit.hyperparameters[coulomb_keys("table")[0]].exp())
    assert coefficient == pytest.approx(scene.simulation.solver.friction, rel=0.05)


@pytest.mark.slow
def test_the_surface_is_found_from_the_path() -> None:
    """Offset to 0.2 mm, half of which the soft contact gives way, and tilt to 0.2°."""
    scene = load_scene("ur5_wiping")
    log = simulate(scene.system(), replace(scene.simulation, duration=8.0)).data
    found = fit_surface(log, scene.system(), "table").surface
    true = scene.system().contact("table").surface
    middle = torch.tensor([*scene.simulation.center[:2], true.offset], dtype=torch.float64)
    normal = torch.tensor(found.normal, dtype=torch.float64)
    assert abs(float(normal @ middle) - found.offset) < 0.2e-3
    assert math.degrees(math.acos(min(1.0, float(normal[2])))) < 0.2
