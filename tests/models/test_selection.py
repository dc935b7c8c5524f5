"""The data choose the force priors: the right set on logs of known forces, whatever their header says."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp.data import DataHeader
from forcegp.errors import NumericalError, UnknownNameError
from forcegp.forces.measurements import training_of
from forcegp.forces.priors.sets import SETS
from forcegp.models.selection import Candidate, Trial, behind_best, candidates_of, halves_of, log_density
from forcegp.models.structured_fit import StructuredFit
from forcegp.simulate import simulate

ROWS = 160


@cache
def scene_log(name: str) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    scene = forcegp.load_scene(name)
    config = dataclasses.replace(scene.simulation, duration=12.0, seed=2)
    data = simulate(scene.system(), config).data
    return scene.system(), data[:: max(1, len(data) // ROWS)]


def pendulum_log(force: str, seed: int = 0) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    """Random motion of a double pendulum with a joint force that the robot file lacks."""
    generator = torch.Generator().manual_seed(seed)
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    t = 0.02 * torch.arange(ROWS, dtype=torch.float64)
    phase = 6.28 * torch.rand(6, 2, generator=generator, dtype=torch.float64)
    w = 0.5 + 2.0 * torch.rand(6, 2, generator=generator, dtype=torch.float64)
    angle = w * t[:, None, None] + phase
    q, qd, qdd = angle.sin().sum(1), (w * angle.cos()).sum(1), -(w**2 * angle.sin()).sum(1)
    unknown = {
        "friction": -0.5 * qd - torch.tanh(qd / 0.02),
        "spring": 3.0 * torch.sin(2.0 * q) - 0.1 * qd,
    }[force]
    tau = forcegp.dynamics.inverse_dynamics(system.robot, q, qd, qdd) - unknown
    noise = 0.1 * torch.randn(ROWS, 2, generator=generator, dtype=torch.float64)
    header = DataHeader(noise_std=0.1)
    return system, forcegp.Dataset(t, q, qd, tau, qdd + noise, system.robot.joint_names, header=header)


def fitted(system: forcegp.ConstrainedSystem, data: forcegp.Dataset) -> StructuredFit:
    return forcegp.StructuredGP(system, "analytical").fit(data)


def chosen(fit: StructuredFit) -> str:
    return next(each.name for each in fit.result.comparison if each.chosen)


def test_the_log_of_the_papers_simulator_asks_for_friction_of_the_contact_alone() -> None:
    fit = fitted(*scene_log("kuka_plane"))
    assert chosen(fit) == "sliding"
    assert [prior.name for prior in fit.force_priors] == ["contact_table"]
    assert fit.torque_std is None


def test_a_header_does_not_choose() -> None:
    system, data = scene_log("kuka_plane")
    plain = dataclasses.replace(
        data,
        header=data.header.model_copy(update={"seed": None, "provenance": None}),
        extras={k: v for k, v in data.extras.items() if k != "qdd_clean"},
    )
    one, two = fitted(system, data), fitted(system, plain)
    assert one.result.comparison == two.result.comparison
    assert one.hyperparameters.keys() == two.hyperparameters.keys()
    for key, value in one.hyperparameters.items():
        assert torch.equal(value, two.hyperparameters[key])


def test_joint_friction_and_a_spring_ask_for_different_sets() -> None:
    assert chosen(fitted(*pendulum_log("friction"))) == "friction"
    assert chosen(fitted(*pendulum_log("spring"))).startswith("friction+residual")


def test_a_row_that_nothing_explains_does_not_choose() -> None:
    """A wrong label or a glitch is worth thousands of nats, more than 160 rows of a spring."""
    system, data = pendulum_log("spring")
    qdd = data.qdd.clone()
    qdd[75] += 20.0
    fit = fitted(system, data.replace(qdd=qdd))
    assert chosen(fit).startswith("friction+residual")
    assert all(each.behind < 100.0 for each in fit.result.comparison if each.behind is not None)


def test_scores_of_different_halves_do_not_stand_side_by_side() -> None:
    """A candidate that was tested on one half has a deficit on that half, and no density to compare."""
    halves = [torch.tensor([-5.0, -4.0]), torch.tensor([-20.0, -30.0])]
    one_half = Trial(Candidate(SETS["sliding"]), [torch.tensor([-8.0, -6.0])], [0.9], note="dropped")
    both = Trial(Candidate(SETS["friction"]), halves, [0.9, 0.9])
    best = torch.cat(both.scores)
    dropped, chosen = one_half.row(best, False), both.row(best, True)
    assert dropped.log_density is None and dropped.behind == 2.5
    assert str(dropped) == "sliding: 2.50 ± 0.50 behind, dropped"
    assert chosen.log_density == -14.75 and chosen.behind == 0.0


def test_the_table_states_whether_links_or_only_drives_were_identified() -> None:
    trial = Trial(Candidate(SETS["friction"], inertia=True))
    assert trial.name == "friction, inertia identified"
    trial.inertia_found = True
    assert trial.name == "friction, drives identified"
    trial.links_found = True
    assert trial.name == "friction, inertia identified"


def test_a_soft_contact_does_not_choose() -> None:
    """Accelerations along the normal, which no candidate predicts, are no evidence."""
    system, data = scene_log("kuka_plane")
    A = system.equations(data.q, data.qd, data.active(system.contact_names)).A
    generator = torch.Generator().manual_seed(0)
    bounce = 100.0 * torch.randn(len(data), 1, 1, generator=generator, dtype=torch.float64)
    fit = forcegp.StructuredGP(system, "analytical", "friction", noise=0.1).fit(data[::2], learn=[])
    rigid, soft = (
        log_density(fit, training_of(each, system, (), 0.1, {}))[0]
        for each in (data, data.replace(qdd=data.qdd + (A.mT @ bounce)[..., 0]))
    )
    torch.testing.assert_close(soft, rigid, rtol=0.0, atol=1e-6)


def test_a_residual_is_no_candidate_where_contact_hides_forces() -> None:
    system, data = scene_log("kuka_plane")
    spec = forcegp.StructuredGP(system, "analytical").specification

    def names(rows: forcegp.Dataset | list[forcegp.Observation]) -> set[str]:
        return {each.set.name for each in candidates_of(spec, training_of(rows, system, (), 0.1, {}))}

    force = forcegp.Observation(data, "multiplier", noise_std=0.5)
    free = data.replace(contact={"table": torch.zeros(len(data), dtype=torch.bool)})
    assert names(data) == {"sliding", "friction"}
    assert names(free) == names([forcegp.Observation(data), force]) == set(SETS)


def test_rows_without_order_are_halved_by_distance() -> None:
    system, data = pendulum_log("spring")
    shuffled = data[torch.randperm(ROWS, generator=torch.Generator().manual_seed(1))]
    shuffled = dataclasses.replace(shuffled, header=data.header.model_copy(update={"ordered": False}))
    half = halves_of(shuffled.q, shuffled.qd, in_order=False)
    assert half.bincount().tolist() == [ROWS // 2, ROWS // 2]
    other = torch.randperm(ROWS, generator=torch.Generator().manual_seed(3))
    assert torch.equal(halves_of(shuffled.q[other], shuffled.qd[other], in_order=False), half[other])
    assert chosen(fitted(system, shuffled)).startswith("friction+residual")


def test_few_samples_get_a_stated_set() -> None:
    system, data = pendulum_log("spring")
    (only,) = fitted(system, data[:60]).result.comparison
    assert (only.name, only.chosen, only.note) == ("friction", True, "fewer than 100 samples")
    held = forcegp.StructuredGP(system, "analytical").fit(data, learn=[])
    assert [each.name for each in held.result.comparison] == ["friction"]


@pytest.mark.parametrize(("independent", "name"), [(20.0, "friction"), (400.0, "friction+residual")])
def test_parameters_cost_if_few_samples_are_independent(independent: float, name: str) -> None:
    """A gain of 0.5 nats per sample by ten more parameters, whose cost is 0.7 for 20 independent samples."""
    trials = []
    for each, parameters, score in (("friction", 5, 1.0), ("friction+residual", 15, 1.5)):
        scores = [torch.tensor([score, score + 0.1]), torch.tensor([score + 0.1, score])]
        begin = {f"{each}.log_scale": torch.zeros(parameters)}
        trials.append(Trial(Candidate(SETS[each]), scores, begin=begin, independent=independent))
    fits = [trial.candidate.name for trial, behind, error in behind_best(trials) if behind <= error]
    assert fits[0] == name


def test_a_log_that_no_candidate_can_explain_gets_the_error_of_the_fit() -> None:
    system, data = scene_log("kuka_plane")
    exact = data.replace(header=data.header.model_copy(update={"noise_std": 1e-9}))
    with pytest.raises(NumericalError, match="does not resolve"):
        forcegp.StructuredGP(system, "analytical", noise=forcegp.Noise(1e-9, torque=None)).fit(exact)


def test_few_samples_of_one_of_two_measurements_get_a_stated_set() -> None:
    system, data = scene_log("kuka_plane")
    force = forcegp.Observation(data[:20], "multiplier", noise_std=0.5)
    fit = forcegp.StructuredGP(system, "analytical").fit([forcegp.Observation(data), force])
    assert [each.note for each in fit.result.comparison] == ["fewer than 100 samples"]


def test_the_comparison_is_saved(tmp_path: Path) -> None:
    fit = fitted(*pendulum_log("friction"))
    file = fit.save(tmp_path / "model.safetensors")
    loaded = forcegp.load_model(file if file is not None else tmp_path / "model.safetensors")
    assert isinstance(loaded, StructuredFit)
    assert loaded.result.comparison == fit.result.comparison and len(fit.result.comparison) >= 2


def test_no_candidate_reads_the_motor_torque() -> None:
    system, data = scene_log("kuka_plane")
    spec = forcegp.StructuredGP(system, "analytical").specification
    log = training_of(data, system, (), 0.1, {})
    assert {each.set.name for each in candidates_of(spec, log)} == {"sliding", "friction"}
    for each in SETS.values():
        fit = forcegp.StructuredGP(system, "analytical", each.name).fit(data[::6], learn=[])
        q, qd, tau = data.q[::40], data.qd[::40], data.tau[::40]
        before, after = (fit.predict(q, qd, x, "joint_force").mean for x in (tau, tau + 1.0))
        # The force changes by the motor torque alone.
        torch.testing.assert_close(after - before, torch.ones_like(before), rtol=1e-9, atol=0.0)


def test_an_unknown_set_lists_those_that_exist() -> None:
    with pytest.raises(UnknownNameError, match=r"'frictoin'(.|\n)*'friction'"):
        forcegp.StructuredGP(scene_log("kuka_plane")[0], "analytical", "frictoin")
