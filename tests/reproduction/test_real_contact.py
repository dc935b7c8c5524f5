"""A log of MuJoCo's solver, exported as a foreign one: what is imported is what was simulated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.foreign_log import mapping_of, rows_of, rows_right, surface_error, write_foreign_log
from benchmarks.sensed_forces import with_sensed_forces
from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.data import Dataset
from forcegp.errors import DataError, ModelError
from forcegp.evaluation import evaluate
from forcegp.forces.measurements import measurement_of
from forcegp.gp.optimise import LearningOptions
from forcegp.logs import import_log
from forcegp.models.registry import create
from forcegp.models.sensed import (
    force_from_sensor,
    sensed_force,
    sensor_noise_std,
    with_sensor,
)
from forcegp.models.structured_gp import StructuredGP
from forcegp.scene import load_scene
from forcegp.simulate import simulate
from reproduction.real_contact_page import findings, tables

pytest.importorskip("mujoco")

SCENE = load_scene("panda_sphere")
SYSTEM = SCENE.system()
FORCE_NOISE = 0.3
"""Of the exported sensor [N]."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Dataset]:
    """The simulated log, and the exported one imported by each source of the contact."""
    folder: Path = tmp_path_factory.mktemp("logs")
    # With this seed two lines are on the ball and two above it.
    config = replace(SCENE.simulation, duration=4.8, lift_probability=0.4, seed=4)
    found = {"truth": simulate(SYSTEM, config).data}
    write_foreign_log(folder / "run.csv", found["truth"], SYSTEM, force_noise=FORCE_NOISE)
    for source in ("distance", "wrench"):
        (folder / f"{source}.toml").write_text(mapping_of(SYSTEM, source))
        found[source] = import_log(folder / "run.csv", SYSTEM, folder / f"{source}.toml").data
    return found


def test_the_imported_rows_are_the_simulated_ones(logs: dict[str, Dataset]) -> None:
    truth, log = logs["truth"], logs["distance"]
    rows = rows_of(log, truth)
    # Six decimals of degrees; of degrees per second.
    np.testing.assert_allclose(log.q, truth.q[rows], atol=1e-8, rtol=0.0)
    np.testing.assert_allclose(log.qd, truth.qd[rows], atol=1e-8, rtol=0.0)
    with pytest.raises(DataError, match="not those of the simulation"):
        rows_of(log.replace(q=log.q + 1e-3), truth)


def test_contact_and_surface_are_found(logs: dict[str, Dataset]) -> None:
    assert 0.1 < float(logs["truth"].contact["ball"].double().mean()) < 0.95, "both states occur"
    for source in ("distance", "wrench"):
        assert rows_right(logs[source], logs["truth"], SYSTEM) >= 0.99
    error = surface_error(logs["distance"], SYSTEM)
    assert error["offset_mm"] < 0.2 and error["tilt_degrees"] < 0.2
    # A surface that is 1 mm too high is seen as such.
    (ball,) = SYSTEM.contacts
    assert isinstance(ball, SurfaceContact)
    high = ConstrainedSystem(SYSTEM.robot, [replace(ball, surface=ball.surface.raised(1e-3))])
    assert surface_error(logs["distance"], high)["offset_mm"] == pytest.approx(1.0, abs=0.2)


def test_the_sensor_measures_the_force_on_the_tip(logs: dict[str, Dataset]) -> None:
    log, truth = logs["wrench"], logs["truth"]
    force = truth.contact_extras["F_I"]["ball"] + truth.contact_extras["F_z"]["ball"]
    error = log.contact_extras["F_sensor"]["ball"] - force[rows_of(log, truth)]
    assert float(error.mean().abs()) < 0.05
    assert float(error.std()) == pytest.approx(FORCE_NOISE, rel=0.1)
    _, sensed = with_sensor(log, SYSTEM, 0.5)
    measured, noise = measurement_of(sensed, SYSTEM)
    assert sensed.quantity == "multiplier" and noise.tolist() == [0.5]
    assert bool(measured.active.all())
    closed = log.contact["ball"]
    # The tip's friction is tangential, so what is left of the difference is the noise along the normal.
    difference = (
        measured.values[:, 0] - truth.contact_extras["multiplier"]["ball"][rows_of(log, truth)][closed]
    )
    assert float(difference.std()) == pytest.approx(FORCE_NOISE, rel=0.2)


def test_sensor_and_accelerations_show_the_joint_forces(logs: dict[str, Dataset]) -> None:
    """Q̄ = M q̈ − J_EᵀF of MuJoCo's own forces, within what the noise of both leaves."""
    log = logs["wrench"]
    (observation,) = with_sensed_forces(log, SYSTEM, FORCE_NOISE)
    measured, noise = measurement_of(observation, SYSTEM)
    exact = ConstrainedSystem(SYSTEM.robot).equations(log.q, log.qd).Q_K + log.tau
    left = measured.values - exact
    friction = -torch.tensor(SCENE.simulation.solver.joint_friction, dtype=torch.float64) * log.qd.sign()
    assert float((left - friction).std()) < float(left.std()), "what is left is friction of the joints"
    open_ = ~log.contact["ball"]
    assert bool((noise[open_].mean(0) < noise[~open_].mean(0)).all()), "no force, no noise of it"
    with pytest.raises(ModelError, match="no sensor force"):
        with_sensed_forces(logs["truth"], SYSTEM, FORCE_NOISE)


def test_the_noise_of_the_sensor_is_read_off_the_log(logs: dict[str, Dataset]) -> None:
    assert sensor_noise_std(logs["wrench"], SYSTEM) == pytest.approx(FORCE_NOISE, rel=0.15)
    with pytest.raises(ModelError, match="noise cannot be estimated"):
        sensor_noise_std(logs["wrench"][~logs["wrench"].contact["ball"]], SYSTEM)


def test_with_the_sensor_at_each_state_the_force_is_better_than_either(logs: dict[str, Dataset]) -> None:
    log, truth = logs["wrench"], logs["truth"]
    rows = torch.arange(len(log))
    train, test = log[rows[(rows // 200) % 2 == 0]], log[rows[(rows // 200) % 2 == 1]]
    logged = {"ball": truth.contact_extras["multiplier"]["ball"][rows_of(test, truth)]}
    test = test.replace(contact_extras={**test.contact_extras, "multiplier": logged})
    model = create("sgp", SYSTEM)
    assert isinstance(model, StructuredGP)
    few = LearningOptions(max_evaluations=15)
    model = model.fit(with_sensor(train[::8], SYSTEM, FORCE_NOISE), options=few)
    found = evaluate(model, test, compare=False)
    (own,), (sensed,) = found.multipliers, found.sensed
    assert sensed.spread < min(own.spread, FORCE_NOISE)
    # An independent formula: the mean of two independent measurements, weighted by their precisions.
    test = test[test.contact["ball"]]
    mean, std = force_from_sensor(model, test)
    states = test.q, test.qd, test.tau
    active = test.active(SYSTEM.contact_names)
    alone = model.predict(*states, "multiplier", active=active)
    assert alone.variance is not None
    w2 = (alone.variance + model.noise_variance(*states, "multiplier", active, sensor=False))[:, 0]
    precision = 1.0 / w2 + 1.0 / FORCE_NOISE**2
    expected = (alone.mean[:, 0] / w2 + sensed_force(test, SYSTEM) / FORCE_NOISE**2) / precision
    np.testing.assert_allclose(mean, expected, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(std, precision**-0.5, rtol=1e-9)
    with pytest.raises(ModelError, match="not fitted to a force sensor"):
        force_from_sensor(model, truth)


def test_a_sensor_needs_one_contact_and_its_columns(logs: dict[str, Dataset]) -> None:
    with pytest.raises(ModelError, match=r"no sensor force at contact 'ball'"):
        with_sensor(logs["truth"], SYSTEM, 0.5)
    with pytest.raises(ModelError, match="a force sensor measures one contact"):
        with_sensor(logs["wrench"], ConstrainedSystem(SYSTEM.robot), 0.5)
    with pytest.raises(DataError, match="force of a single contact"):
        write_foreign_log(Path("run.csv"), logs["wrench"], SYSTEM)


def test_the_axes_of_the_exported_sensor_are_those_of_its_frame(logs: dict[str, Dataset]) -> None:
    truth = logs["truth"]
    rotation, _ = kinematics.frame_pose(SYSTEM.robot, truth.q, "panda_link8")
    force = truth.contact_extras["F_I"]["ball"]
    inside = (rotation.mT @ force[..., None])[..., 0][truth.contact["ball"]]
    # The flange's z axis points into the ball, which pushes against it.
    assert float((inside[:, 2] / torch.linalg.vector_norm(inside, dim=-1)).max()) < -0.9


def test_findings_say_what_was_asked_and_what_was_found() -> None:
    score = {"bias": 0.1, "spread": 1.0, "correlation": 0.97, "coverage": 0.95, "qdd_coverage": 0.95}
    score |= {"acceleration_rmse": 0.1}
    file = score | {"bias": 9.0, "coverage": None, "qdd_coverage": None}
    found = {
        "rows_right": {"distance": 0.995, "wrench": 0.98},
        "surface": {"offset_mm": 0.1, "tilt_degrees": 0.01},
        "check": {"verdict": "verdict: go on"},
        "file": file,
        "torques": score,
        "sensor": score | {"coverage": 0.7},
    }
    said = {finding.topic: finding.agrees for finding in findings({"ur5_wiping": found})}
    assert list(said.values()) == [False, True, True, False]
    first, second = tables({"ur5_wiping": found})
    assert first.rows[0][1:3] == ("99.50 %", "98.00 %") and first.rows[0][-1] == "go on"
    assert second.rows[0][1:4] == ("+9.00 ± 1.00", "0.97", "–")
