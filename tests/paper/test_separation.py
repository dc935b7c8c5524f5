"""Joint friction and contact friction, both unknown, on a short simulated run."""

from __future__ import annotations

import dataclasses

import pytest

import forcegp
from forcegp.paper.separation import separate

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
