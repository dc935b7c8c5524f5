"""Joint friction and contact friction, both unknown, on a short simulated run."""

from __future__ import annotations

import dataclasses

import pytest

import forcegp
from benchmarks.separation import judge, separate, unfitted
from forcegp.data.fields import DataHeader
from forcegp.forces.measurements import Observation
from random_data import NOISE_STD, random_data, table_system

SHORT = 0.35
"""Relative error that a few seconds of motion allow; a model that confuses the two is off by 1 and more."""


@pytest.mark.slow
def test_each_way_recovers_both_frictions() -> None:
    scene = forcegp.load_scene("kuka_plane")
    config = dataclasses.replace(scene.simulation, duration=8.0, seed=1)
    found = {way.way: way for way in separate(scene.system(), config, samples=40, test_samples=100)}
    assert set(found) == {"contact", "two_stages", "both"}
    for way in ("two_stages", "both"):
        assert found[way].joint_error < SHORT, way
        assert found[way].contact_error < SHORT, way
        assert -0.9 < found[way].correlation <= 0.0, way
        assert found[way].correlation_free == pytest.approx(0.0, abs=1e-9), way


def test_the_correlation_does_not_depend_on_the_order_of_observations() -> None:
    system = table_system()
    data = random_data(system, 60)
    closed = data.contact["table"]
    data = data.replace(extras={**data.extras, "Q_z": data.tau}, header=DataHeader(noise_std=NOISE_STD))
    parts = [Observation(data[:40][closed[:40]]), Observation(data[:40][~closed[:40]])]
    found = []
    for observations in (parts, parts[::-1]):
        model = unfitted(system, NOISE_STD)
        model = model.fit(observations, learn=[])
        found.append(judge("both", model, data[40:][closed[40:]], data[40:][~closed[40:]]))
    # The two posteriors differ by the rounding of a factorisation in another order.
    assert found[0].correlation == pytest.approx(found[1].correlation, abs=1e-8)
    assert found[0].correlation < 0.0 and found[0].correlation_free == 0.0
