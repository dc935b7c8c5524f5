"""The multiplier without a force sensor, on a contact that this library did not compute (MuJoCo's solver)."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import forcegp
from forcegp.evaluation import evaluate
from forcegp.forces.priors.contact import coulomb_keys
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
    """On the last six seconds of three logs: a stroke has one error, and six seconds hold few strokes."""
    scene = load_scene("ur5_wiping")
    errors, inside, read, truth = [], [], [], []
    for seed in range(3):
        log = simulate(scene.system(), replace(scene.simulation, duration=24.0, seed=seed)).data
        train, test = log[: 18 * 250 : EVERY], log[18 * 250 :]
        test = test[in_contact(test)]
        model = create("sgp", scene.system())
        fit = model.fit(train)
        found = fit.predict(
            test.q, test.qd, test.tau, "multiplier", active=test.active(("table",)), noise=True
        )
        truth.append(test.multiplier["table"])
        read.append(found.mean[:, 0])
        errors.append(read[-1] - truth[-1])
        inside.append((errors[-1].abs() <= 2.0 * found.std[:, 0]).double())
        assert abs(float(errors[-1].mean())) < 0.4 and float(errors[-1].std()) < 1.0
        coefficient = float(fit.hyperparameters[coulomb_keys("table")[0]].exp())
        assert coefficient == pytest.approx(scene.simulation.solver.friction, rel=0.05)
        (mu,) = (x for x in fit.robot_parameters() if x.name == "friction coefficient")
        assert abs(mu.value - scene.simulation.solver.friction) < 3.0 * mu.std
        scored = evaluate(fit, test, compare=False).multipliers[0]
        assert scored.coverage == pytest.approx(float(inside[-1].mean()))
    assert float(torch.corrcoef(torch.stack([torch.cat(read), torch.cat(truth)]))[0, 1]) > 0.95
    assert 0.9 <= float(torch.cat(inside).mean()) <= 0.98


@pytest.mark.slow
def test_the_surface_is_found_from_the_path() -> None:
    """Offset to 0.2 mm, half of which the soft contact gives way, and tilt to 0.2°."""
    scene = load_scene("ur5_wiping")
    log = simulate(scene.system(), replace(scene.simulation, duration=8.0)).data
    found = fit_surface(log, scene.system(), "table").surface
    contact = scene.system().contact("table")
    assert isinstance(contact, forcegp.SurfaceContact)
    true = contact.surface
    assert isinstance(true, forcegp.Plane)
    middle = torch.tensor([*scene.simulation.center[:2], true.offset], dtype=torch.float64)
    assert isinstance(found, forcegp.Plane)
    normal = torch.tensor(found.normal, dtype=torch.float64)
    assert abs(float(normal @ middle) - found.offset) < 0.2e-3
    assert math.degrees(math.acos(min(1.0, float(normal[2])))) < 0.2
