"""Structured Gaussian processes: edge cases, transfer, two-stage training, files, and what is refused."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp.constraints import ConstrainedSystem, Plane, SurfaceContact
from forcegp.errors import DataError, ForceGPError, ModelError, NumericalError, ShapeError, UnknownNameError
from forcegp.forces.measurements import Observation
from forcegp.forces.priors.base import OperatorForcePrior
from forcegp.forces.priors.contact import ContactForcePrior, SlidingFrictionPrior
from forcegp.forces.priors.joint import JointForcePrior, JointFrictionPrior
from forcegp.forces.priors.sets import default_priors
from forcegp.forces.quantities import QUANTITIES, states
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.kernels import Linear, Matern52, SquaredExponential
from forcegp.gp.optimise import LearningOptions
from forcegp.learning.search import negative_log_prior
from forcegp.models.prediction import CHUNK
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP
from forces.cases import all_priors, conditioned, draw, logged, mixed_contacts, two_contacts
from forces.textbook import Textbook
from logs import random_log
from model_files import rewritten
from random_data import random_data, table_system

SHORT = LearningOptions(max_evaluations=4)
POSTERIOR = 1e-8
RESIDUAL = 1e-9
"""|A q̈ − b| of predicted means, relative to the acceleration."""
table = table_system()
data = random_data(table, 20)
both = (JointForcePrior(), ContactForcePrior("table"))


def fitted(
    rows: forcegp.Dataset = data, options: LearningOptions = SHORT, **settings: object
) -> StructuredFit:
    model = StructuredGP(table, **{"mean": "analytical", "force_priors": both, **settings})  # type: ignore[arg-type]
    return model.fit(rows, options=options)


@pytest.fixture(scope="module")
def model() -> StructuredFit:
    return fitted()


# -- edge cases -----------------------------------------------------------------------------------


def is_right(model: StructuredFit) -> None:
    """Finite, PSD, on the constraint, and equal to the textbook's answer."""
    q, qd, tau = draw(3, seed=11)
    active = torch.tensor([[True], [True], [False]])
    found = model.predict(q, qd, tau, active=active)
    mean, covariance = Textbook(model).predict(q, qd, tau, active, "qdd")
    assert float((found.mean - mean).abs().max()) < POSTERIOR * float(mean.abs().max())
    assert float((found.covariance - covariance).abs().max()) < POSTERIOR * float(covariance.abs().max())
    eigenvalues = torch.linalg.eigvalsh(found.covariance)
    assert float(eigenvalues.min()) > -1e-9 * float(eigenvalues.max())
    eom = model.system.equations(q, qd, active)
    residual = (eom.A @ found.mean[..., None])[..., 0] - eom.b
    assert float(residual.abs().max()) < RESIDUAL * float(found.mean.abs().max())


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_samples(n: int) -> None:
    is_right(fitted(data[:n]))


def test_duplicated_rows() -> None:
    model = fitted(data[torch.tensor([0, 0, 0, 1, 1, 2])])
    assert isinstance(model.posterior.latent, ExactPosterior)
    assert model.posterior.latent.conditioned.jitter == 0.0
    is_right(model)


def test_all_samples_free() -> None:
    rows = data[~data.contact["table"]]
    assert len(rows) > 3
    is_right(fitted(rows))


def test_a_joint_that_never_moves_is_reported_and_left_unscaled() -> None:
    q, qd = data.q.clone(), data.qd.clone()
    q[:, 2], qd[:, 2] = 0.4, 0.0
    active = data.active(["table"])
    qdd = table.equations(q, qd, active).acceleration(data.tau)
    still = dataclasses.replace(data, q=q, qd=qd, qdd=qdd, extras={})
    fit = StructuredGP(table, "analytical", both).fit(still, options=SHORT)
    assert fit.result.constant_inputs == ("joint.q[2]", "joint.qd[2]")
    is_right(fit)


def test_badly_scaled_inputs_are_standardized() -> None:
    """A torque in other units only rescales its input."""
    model = fitted(force_priors=[JointForcePrior(inputs=("q", "tau"))])
    scale = model.training.scales[0]
    assert float(scale.std["tau"].max() / scale.std["q"].min()) > 1.0
    features = scale.apply({"q": data.q, "tau": data.tau})
    for x in features.values():
        assert torch.allclose(x.std(0, correction=0), torch.ones(7, dtype=torch.float64))
        assert float(x.mean(0).abs().max()) < 1e-12


@pytest.mark.parametrize("std", [1e-2, 1e-3])
def test_little_noise(std: float) -> None:
    """The mean passes through noise-free accelerations, or the jitter says how much noise was assumed."""
    clean = dataclasses.replace(data, qdd=data.qdd_clean)
    fit = StructuredGP(table, "analytical", both, noise=std).fit(clean, options=SHORT)
    found = fit.predict(data.q, data.qd, data.tau, active=data.active(["table"]))
    effective = std * math.sqrt(1.0 + fit.result.jitter)
    assert float((found.mean - clean.qdd).abs().max()) < 100.0 * effective
    assert math.isfinite(fit.result.log_marginal_likelihood or math.nan)


def test_contradicting_duplicates_without_noise_are_refused() -> None:
    rows = data[torch.tensor([0] * 6 + [1] * 6)]
    with pytest.raises(NumericalError, match="does not resolve the noise relative to the prior"):
        StructuredGP(table, "zero", both, noise=1e-7).fit(rows, options=SHORT)


# -- prediction -----------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [(), (1,), (4,), (2, 3), (0,), (2, 0)])
@pytest.mark.parametrize("quantity", list(QUANTITIES))
def test_batch_shapes(model: StructuredFit, batch: tuple[int, ...], quantity: str) -> None:
    d = {"multiplier": 1, "contact_force": 3}.get(quantity, 7)
    q, qd, tau = (x[: math.prod(batch)].reshape(*batch, 7) for x in (data.q, data.qd, data.tau))
    found = model.predict(q, qd, tau, quantity)
    assert found.mean.shape == (*batch, d)
    assert found.covariance is not None and found.covariance.shape == (*batch, d, d)
    assert found.std is not None and found.std.shape == (*batch, d)
    assert found.parts == {quantity: slice(0, d)}
    without = model.predict(q, qd, tau, quantity, covariance=False)
    assert torch.equal(without.mean, found.mean)
    assert without.covariance is None and without.variance is None and without.std is None


def test_joint_friction_is_a_part_of_the_joint_force() -> None:
    """With the forces of the other prior, of the motors and of the links, it is the whole."""
    robot = forcegp.load_robot("double_pendulum")
    robot = robot.replace(damping=torch.tensor([0.3, 0.2], dtype=torch.float64))
    free, log = ConstrainedSystem(robot), random_log(30, joints=robot.joint_names)
    fit = StructuredGP(free, "analytical", [JointFrictionPrior(), JointForcePrior()], noise=0.1).fit(log)
    state = log.q[:5], log.qd[:5], log.tau[:5]
    found = fit.predict(*state, "joint_friction")
    at = states(free, *state, torch.zeros(5, 0, dtype=torch.bool))
    rest = fit.posterior.unknown_force(free, at, [1]) + at.eom.Q_C + at.eom.Q_G + log.tau[:5]
    torch.testing.assert_close(found.mean + rest, fit.predict(*state, "joint_force").mean)
    both = fit.predict(*state, ["joint_friction", "joint_force"])
    torch.testing.assert_close(both.mean[:, both.parts["joint_friction"]], found.mean)
    assert both.covariance is not None and found.covariance is not None
    torch.testing.assert_close(both.covariance[:, :2, :2], found.covariance)
    assert bool((found.std > 0.0).all())  # type: ignore[operator]


def test_states_broadcast_and_each_is_predicted_by_itself(model: StructuredFit) -> None:
    wide = model.predict(data.q[:2, None], data.qd[:3], data.tau[0])
    assert wide.mean.shape == (2, 3, 7)
    one = model.predict(data.q[1], data.qd[2], data.tau[0])
    assert torch.allclose(wide.mean[1, 2], one.mean, rtol=1e-10, atol=1e-10)
    assert torch.allclose(wide.covariance[1, 2], one.covariance, rtol=1e-9, atol=1e-10)  # type: ignore[index]


def test_transfer_to_another_surface_and_to_free_motion() -> None:
    """The forces are learned, not the accelerations: read on a slope, and with no contact at all."""
    model = fitted(random_data(table, 40), options=LearningOptions(max_evaluations=25))
    slope = SurfaceContact("table", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), Plane((0.3, 0.1, 1.0), 0.2))
    new = random_data(ConstrainedSystem(table.robot, [slope]), 30, seed=5)
    closed = new.active(["table"])
    found = model.predict(
        new.q, new.qd, new.tau, active=closed, system=ConstrainedSystem(table.robot, [slope])
    )
    eom = ConstrainedSystem(table.robot, [slope]).equations(new.q, new.qd, closed)
    residual = (eom.A @ found.mean[..., None])[..., 0] - eom.b
    assert float(residual.abs().max()) < RESIDUAL * float(found.mean.abs().max())
    known = eom.acceleration(eom.Q_K + new.tau)
    error = [float((x - new.qdd_clean)[closed[:, 0]].abs().mean()) for x in (found.mean, known)]
    assert error[0] < 0.5 * error[1], "friction learned on the table helps on the slope"
    free = model.predict(new.q, new.qd, new.tau, system=ConstrainedSystem(table.robot))
    opened = model.predict(new.q, new.qd, new.tau, active=torch.zeros(1, dtype=torch.bool))
    assert torch.allclose(free.mean, opened.mean, rtol=1e-9, atol=1e-9)
    assert torch.allclose(free.covariance, opened.covariance, rtol=1e-8, atol=1e-9)  # type: ignore[arg-type]
    none = model.predict(new.q, new.qd, new.tau, "multiplier", system=ConstrainedSystem(table.robot))
    assert none.mean.shape == (30, 0) and none.covariance is not None and none.covariance.shape == (30, 0, 0)


def test_transfer_without_the_contact_of_a_prior_is_refused(model: StructuredFit) -> None:
    other = dataclasses.replace(table.contacts[0], name="floor")  # type: ignore[type-var]
    with pytest.raises(UnknownNameError, match=r"unknown contact 'table'[\s\S]*floor"):
        model.predict(data.q, data.qd, data.tau, system=ConstrainedSystem(table.robot, [other]))


# -- learning -------------------------------------------------------------------------------------


def test_two_stages_hold_the_first_prior_and_its_scales() -> None:
    free, closed = data[~data.contact["table"]], data[data.contact["table"]]
    model = StructuredGP(table, "analytical", both)
    one = model.fit(free, options=SHORT, learn=["joint"])
    first, scale = dict(one.hyperparameters), one.training.scales[0]
    assert bool((one.predict(data.q, data.qd, data.tau, "contact_friction").mean == 0.0).all())
    two = model.fit(closed, options=SHORT, learn=["contact_table"], after=one)
    for key, value in first.items():
        assert torch.equal(two.hyperparameters[key], value) == key.startswith("joint."), key
    assert two.training.scales[0] is scale
    position = two.training.scales[1].mean["position"]
    point = table.equations(closed.q, closed.qd).contact_points["table"].position
    assert torch.allclose(position, point.mean(0)[:2])
    whole = two.condition([Observation(free), Observation(closed)])
    assert whole.hyperparameters == two.hyperparameters
    assert float(whole.predict(data.q, data.qd, data.tau, "contact_friction").mean.abs().max()) > 0.0
    is_right(whole)


def test_conditioning_on_other_data_is_a_fit_that_learns_nothing(model: StructuredFit) -> None:
    other = random_data(table, 6, seed=3)
    again = fitted().condition(other)
    for key, value in model.hyperparameters.items():
        assert torch.equal(again.hyperparameters[key], value)
    assert again.training.scales[0].mean["q"].tolist() == model.training.scales[0].mean["q"].tolist()
    mean = again.predict(other.q, other.qd, other.tau).mean
    held = StructuredGP(table, "analytical", both).fit(other, learn=[], after=model)
    assert (held.result.converged, held.result.evaluations, held.result.message) == (
        True,
        0,
        "conditioned, nothing learned",
    )
    assert torch.equal(held.predict(other.q, other.qd, other.tau).mean, mean)
    assert held.result.log_marginal_likelihood == again.result.log_marginal_likelihood


def test_learned_noise_and_honest_flags() -> None:
    rows = random_data(table, 60, seed=2)
    model = StructuredGP(
        table,
        "analytical",
        both,
        noise=forcegp.Noise(acceleration=0.3, learn=True),
    )
    began = time.perf_counter()
    fit = model.fit(rows, options=LearningOptions(max_evaluations=40))
    elapsed = time.perf_counter() - began
    noise = fit.hyperparameters["noise.0.log_noise_std"].exp()
    assert noise.shape == (7,)
    # Sixty samples leave room to take some noise of single joints for force.
    assert abs(float(noise.log().mean()) - math.log(0.1)) < 0.4, "the data have noise of 0.1"
    assert fit.result.evaluations == len(fit.result.history) and fit.result.seconds > 0.0
    assert 0.5 * elapsed < fit.result.seconds < elapsed, "the duration is that of the whole fit"
    again = fit.condition(rows)
    assert again.result.log_marginal_likelihood == pytest.approx(fit.result.log_marginal_likelihood)
    assert (
        not StructuredGP(table, "zero").fit(rows, options=LearningOptions(max_evaluations=2)).result.converged
    )
    with pytest.raises(
        ModelError, match=r"learned noise belongs to other measurements[\s\S]*expected: qdd\n"
    ):
        fit = fit.condition([Observation(rows), Observation(rows)])


def test_progress_is_reported() -> None:
    seen: list[tuple[int, int, float]] = []
    StructuredGP(table, "zero").fit(data, options=SHORT, progress=lambda *args: seen.append(args))
    assert [n for n, _, _ in seen] == [1, 2, 3, 4, 4], "the last one says that all is done"
    assert {most for _, most, _ in seen} == {4}


# -- files ----------------------------------------------------------------------------------------


def same(one: StructuredFit, two: object, seed: int = 1) -> None:
    assert isinstance(two, StructuredFit)
    (q, qd, tau), n = draw(5, seed), len(one.system.contacts)
    active = mixed_contacts(5)[:, :n]
    for quantity in ("qdd", "multiplier", "contact_friction"):
        a, b = (m.predict(q, qd, tau, quantity, active=active) for m in (one, two))
        assert torch.equal(a.mean, b.mean) and torch.equal(a.covariance, b.covariance)  # type: ignore[arg-type]
    assert one.result.log_marginal_likelihood == two.result.log_marginal_likelihood


def test_saved_models_are_exact_whatever_they_are_made_of(tmp_path: Path) -> None:
    kernel = SquaredExponential(("q",)) * Matern52(("qd",)) + Linear(("qd", "tau"))
    priors = [JointForcePrior(kernel, periodic=False, name="noisy"), *all_priors()[1:]]
    noise = forcegp.Noise([0.1, 0.2, 0.3, 0.1, 0.1, 0.1, 0.2], learn=True)
    observations = [
        Observation(logged(two_contacts(), 6)),
        Observation(logged(two_contacts(), 5, seed=4), "multiplier", [1.0, 2.0]),
    ]
    mean = forcegp.priors.AnalyticalMean(("gravity",))
    model = conditioned(observations, force_priors=priors, mean=mean, noise=noise)
    model.save(tmp_path / "model")
    same(model, forcegp.load_model(tmp_path / "model"))


def test_saved_models_keep_learned_analytical_parameters(tmp_path: Path) -> None:
    theta = forcegp.robot.AnalyticalParameters(
        table.robot, {"mass": table.robot.joint_names[-2:], "damping": "all"}
    )
    model = fitted(analytical_parameters=theta)
    assert not torch.equal(model.system.robot.mass, table.robot.mass)
    assert torch.equal(theta().mass, table.robot.mass), "the caller's module is left as it was"
    model.save(tmp_path / "model")
    read = forcegp.load_model(tmp_path / "model")
    assert torch.equal(read.system.robot.mass, model.system.robot.mass)
    same(model, read)


def test_models_of_python_code_are_not_saved(tmp_path: Path) -> None:
    own = OperatorForcePrior(
        "own", 7, lambda system, at: torch.eye(7, dtype=torch.float64).expand(len(at.q), 7, 7)
    )
    with pytest.raises(ModelError, match=r"OperatorForcePrior contains Python code"):
        fitted(force_priors=[own]).save(tmp_path / "model")
    assert not any(tmp_path.iterdir())


def deep(header: dict, tensors: dict, depth: int = 200) -> None:
    kernel = {"type": "linear", "inputs": None}
    for _ in range(depth):
        kernel = {"type": "sum", "left": kernel, "right": {"type": "linear", "inputs": None}}
    header["settings"]["priors"][0]["kernel"] = kernel


HOSTILE: dict[str, Callable[[dict, dict], object]] = {
    "unknown kernel": lambda h, t: h["settings"]["priors"][0]["kernel"].update(type="__import__"),
    "unknown contact": lambda h, t: h["settings"]["priors"][1].update(contact="wall"),
    "unknown mean": lambda h, t: h["settings"].update(mean=["magic"]),
    "unknown quantity": lambda h, t: h["settings"].update(measured=["luck"]),
    "more measurements": lambda h, t: h["settings"].update(measured=["qdd"] * 3),
    "no measurement": lambda h, t: h["settings"].update(measured=[]),
    "no prior": lambda h, t: h["settings"].update(priors=[]),
    "negative noise": lambda h, t: h["settings"]["noise"].update(acceleration="much"),
    "extra setting": lambda h, t: h["settings"].update(code="import os"),
    "deep kernel": deep,
    "kernel beyond recursion": lambda h, t: deep(h, t, 4000),
    "no alpha": lambda h, t: t.pop("alpha"),
    "short alpha": lambda h, t: t.update(alpha=t["alpha"][:-1]),
    "alpha not finite": lambda h, t: t.update(alpha=t["alpha"] * float("nan")),
    "hyperparameter missing": lambda h, t: t.pop("hyper.joint.log_std"),
    "hyperparameter of another shape": lambda h, t: t.update(
        {"hyper.joint.log_std": t["hyper.joint.log_std"][:2]}
    ),
    "hyperparameter not finite": lambda h, t: t["hyper.joint.log_std"].fill_(float("nan")),
    "data of another shape": lambda h, t: t.update({"data.0.q": t["data.0.q"][:, :5].contiguous()}),
    "data not finite": lambda h, t: t["data.0.values"].fill_(float("inf")),
    "data in single precision": lambda h, t: t.update({"data.0.q": t["data.0.q"].float()}),
    "contacts as numbers": lambda h, t: t.update({"data.0.active": t["data.0.active"].double()}),
    "no scale": lambda h, t: t.pop("scale.joint.mean.q"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("change", HOSTILE.values(), ids=HOSTILE.keys())
def test_hostile_files_are_refused_when_they_are_read(
    model: StructuredFit, change: Callable, tmp_path: Path
) -> None:
    model.save(tmp_path / "model")
    with pytest.raises(ForceGPError):
        forcegp.load_model(rewritten(tmp_path / "model", tmp_path / "changed", change))


# -- what is refused ------------------------------------------------------------------------------


@pytest.mark.usefixtures("unchecked")
def test_a_name_is_no_prior() -> None:
    with pytest.raises(ModelError, match="not a force prior"):
        StructuredGP(table, "zero", force_priors="friction")  # pyright: ignore[reportArgumentType]


REFUSED: dict[str, tuple[Callable[[], object], type[Exception], str]] = {
    "no prior": (
        lambda: StructuredGP(table, "zero", force_priors=[]),
        ModelError,
        "distinct names, and at least one prior",
    ),
    "same names": (
        lambda: StructuredGP(table, "zero", force_priors=[both[0], both[0]]),
        ModelError,
        "distinct names",
    ),
    "name": (
        lambda: StructuredGP(table, "zero", force_priors=[JointForcePrior(name="noise")]),
        ModelError,
        "'noise'",
    ),
    "dots": (
        lambda: StructuredGP(table, "zero", force_priors=[JointForcePrior(name="a.b")]),
        ModelError,
        "without dots",
    ),
    "mean": (lambda: StructuredGP(table, "analytcal"), UnknownNameError, r"did you mean 'analytical'"),
    "terms": (lambda: forcegp.priors.AnalyticalMean(("bias", "bias")), ModelError, "'bias'.*twice"),
    "term": (lambda: forcegp.priors.AnalyticalMean(("gravty",)), UnknownNameError, "did you mean 'gravity'"),
    "contact": (
        lambda: fitted(force_priors=[ContactForcePrior("tabel")]),
        UnknownNameError,
        "did you mean 'table'",
    ),
    "inputs": (
        lambda: JointForcePrior(inputs=("qdd",)),
        UnknownNameError,
        r"unknown input of force prior 'joint'",
    ),
    "no inputs": (lambda: JointForcePrior(inputs=()), ModelError, "has no inputs"),
    "contact inputs": (lambda: ContactForcePrior("table", inputs=("q",)), UnknownNameError, "contact_table"),
    "smoothing": (lambda: SlidingFrictionPrior("table", smoothing=0.0), ModelError, "smoothing speed"),
    "kernel": (
        lambda: fitted(force_priors=[JointForcePrior(Linear(("x",)))]),
        UnknownNameError,
        "kernel input 'x'",
    ),
    "learn": (
        lambda: StructuredGP(table, "zero").fit(data, learn=["jont"]),
        UnknownNameError,
        "did you mean 'joint'",
    ),
    "noise length": (
        lambda: fitted(noise=[0.1, 0.2]),
        ModelError,
        r"one number, 7, or \(20, 7\)[\s\S]*\(2,\)",
    ),
    "noise zero": (lambda: fitted(noise=0.0), ModelError, "must be positive and finite"),
    "no rows": (lambda: fitted(data[:0]), ModelError, "no samples to learn from"),
    "no observation": (lambda: StructuredGP(table, "zero").fit([]), ModelError, "no samples to learn from"),
    "noise of a sensor": (
        lambda: StructuredGP(table, "zero").fit([Observation(data, "joint_force")]),
        DataError,
        "'Q' is not logged",
    ),
    "quantity": (
        lambda: StructuredGP(table, "zero").fit([Observation(data, "qdd_free")]),
        UnknownNameError,
        "qdd_free",
    ),
    "sensor": (
        lambda: StructuredGP(table, "zero").fit([Observation(data, "multiplier", 1.0)]),
        UnknownNameError,
        "unknown contact with a logged multiplier 'table'",
    ),
    "after another model": (
        lambda: StructuredGP(table, "zero", [both[0]]).fit(data, after=fitted(force_priors=[both[1]])),
        ModelError,
        r"fit of a different model[\s\S]*expected: priors joint[\s\S]*got: priors contact_table",
    ),
}


@pytest.mark.parametrize(("make", "error", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_what_does_not_fit_is_refused(
    make: Callable[[], object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make()


@pytest.mark.usefixtures("unchecked")
def test_states_that_do_not_fit_are_refused(model: StructuredFit) -> None:
    q, qd, tau = data.q, data.qd, data.tau
    with pytest.raises(ShapeError, match=r"q has the wrong shape for robot 'kuka_iiwa'[\s\S]*got: \(20, 6\)"):
        model.predict(q[:, :6], qd, tau)
    with pytest.raises(ShapeError, match=r"q, qd and tau do not broadcast[\s\S]*'qd': \(3, 7\)"):
        model.predict(q, qd[:3], tau)
    with pytest.raises(ShapeError, match="tau contains values that are not finite"):
        model.predict(q, qd, tau * float("nan"))
    with pytest.raises(ShapeError, match=r"torch.float64 on cpu[\s\S]*hint: convert q"):
        model.predict(q.float(), qd, tau)
    with pytest.raises(
        ShapeError, match=r"active does not match the contacts table[\s\S]*bool of shape \(20, 1\)"
    ):
        model.predict(q, qd, tau, active=torch.ones(20, 2, dtype=torch.bool))
    with pytest.raises(UnknownNameError, match=r"unknown quantity 'qddd'[\s\S]*did you mean 'qdd'"):
        model.predict(q, qd, tau, "qddd")
    with pytest.raises(ModelError, match="no quantity is named"):
        model.predict(q, qd, tau, [])


@pytest.mark.slow
def test_warm_start_ends_as_well_and_restarts_no_worse() -> None:
    data = logged(two_contacts(), 24)
    cold, warm, many = (
        forcegp.StructuredGP(two_contacts(), "zero").fit(
            data, options=forcegp.models.LearningOptions(**options)
        )
        for options in ({"warm_start": None}, {"warm_start": 8}, {"warm_start": None, "restarts": 1})
    )
    assert cold.result.converged and warm.result.converged
    assert (
        warm.result.objective < cold.result.objective + 1.0
    )  # a different optimum may be found, not a worse one by much
    assert many.result.objective <= cold.result.objective


def test_a_fit_begins_at_the_hyperparameters_of_another() -> None:
    data = logged(two_contacts(), 24)
    priors = default_priors(two_contacts(), "analytical")
    model = forcegp.StructuredGP(two_contacts(), "analytical", priors)
    small = model.fit(data[:12])
    seen: list[float] = []
    model.fit(data, after=small, progress=lambda e, m, value: seen.append(value))
    start = model.fit(data, learn=[])
    prior = float(negative_log_prior(small.hyperparameters, start.hyperparameters))
    again = start.condition(data, small.hyperparameters)
    assert seen[0] == pytest.approx(prior - again.result.log_marginal_likelihood, rel=1e-9)
    assert min(seen) < seen[0]
    missing = {key: value for key, value in small.hyperparameters.items() if "bias" not in key}
    with pytest.raises(
        ModelError, match=r"incompatible initial hyperparameters: joint\.left\.left\.log_bias_std"
    ):
        model.fit(data, after=dataclasses.replace(small, hyperparameters=missing))


def test_a_part_of_the_data_has_distinct_states() -> None:
    data = logged(two_contacts(), 10)
    fit = forcegp.StructuredGP(two_contacts(), "zero").fit(data[torch.arange(10).repeat(3)], learn=[])
    (few,) = fit.training.thinned(6).measurements
    assert len(few.q) == 6 and len(few.q.unique(dim=0)) == 6
    (all_,) = fit.training.thinned(30).measurements
    assert len(all_.q) == 10


def test_the_normal_force_prior_changes_multipliers_alone() -> None:
    data = logged(two_contacts(), 10)
    joint = forcegp.priors.JointForcePrior()
    normal = forcegp.priors.NormalForcePrior(joint)
    plain = forcegp.StructuredGP(two_contacts(), "zero", force_priors=[joint]).fit(
        data, options=forcegp.models.LearningOptions(max_evaluations=5)
    )
    open_ = forcegp.StructuredGP(two_contacts(), "zero", force_priors=[joint, normal]).fit(data, learn=[])
    start, learned = open_.hyperparameters, plain.hyperparameters
    for values in (start, learned):
        # The search itself amplifies rounding: data that differ by 10⁻¹⁵ are learned 10⁻⁵ apart.
        plain, open_ = plain.condition(data, values), open_.condition(data, values)
        assert open_.result.log_marginal_likelihood == pytest.approx(
            plain.result.log_marginal_likelihood, rel=1e-12
        )
    assert learned.keys() == start.keys()
    state = (data.q, data.qd, data.tau)
    a, b = plain.predict(*state), open_.predict(*state)
    torch.testing.assert_close(a.mean, b.mean)
    torch.testing.assert_close(a.covariance, b.covariance)
    a, b = plain.predict(*state, "multiplier"), open_.predict(*state, "multiplier")
    torch.testing.assert_close(a.mean, b.mean)
    assert bool((b.variance > a.variance).all())


def test_contact_data_alone_tell_the_sum_of_two_forces() -> None:
    """Two priors on the same force cannot be told apart; one on free motion too can."""
    system = two_contacts()
    same = forcegp.priors.OperatorForcePrior(
        "shadow",
        7,
        lambda s, at: torch.eye(7, dtype=at.q.dtype).expand(len(at.q), -1, -1),
        target="contact",
    )
    closed = logged(system, 12, active=torch.ones(12, 2, dtype=torch.bool))
    model = forcegp.StructuredGP(system, "zero", force_priors=[forcegp.priors.JointForcePrior(), same])
    held = model.fit(closed, options=forcegp.models.LearningOptions(max_evaluations=2))
    assert held.result.force_correlation is not None
    assert held.result.force_correlation < -0.2


MEMORY = """
import resource, sys
import torch
import forcegp

fit = forcegp.load_model(sys.argv[1])
states = torch.linspace(-1.0, 1.0, 40_000 * 7, dtype=torch.float64).reshape(40_000, 7)
fit.predict(states[:3000], states[:3000], states[:3000], noise=True)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
found = fit.predict(states, states, states, noise=True)
fit.noise_variance(states, states, states)
size = sum(x.numel() * 8 for x in (found.mean, found.covariance))
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024, size / (1 << 20))
"""
BESIDE = 150.0
"""Memory of a prediction beside its result [MiB], for any number of states."""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="peak memory in KiB")
def test_many_states_take_little_memory_beside_the_result(model: StructuredFit, tmp_path: Path) -> None:
    model.save(tmp_path / "model")
    command = [sys.executable, "-c", MEMORY, str(tmp_path / "model")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    peak, result = map(float, done.stdout.split()[-2:])
    assert peak < result + BESIDE


def test_states_of_any_batch_are_predicted_in_pieces(model: StructuredFit) -> None:
    q, qd, tau = draw(2 * CHUNK + 30, seed=5)
    whole = model.predict(q, qd, tau, ("qdd", "multiplier"), noise=True)
    folded = model.predict(*(x.reshape(2, -1, 7) for x in (q, qd, tau)), ("qdd", "multiplier"), noise=True)
    last = model.predict(q[-7:], qd[-7:], tau[-7:], ("qdd", "multiplier"), noise=True)
    for name in ("mean", "covariance"):
        torch.testing.assert_close(
            getattr(folded, name).reshape(getattr(whole, name).shape), getattr(whole, name)
        )
        torch.testing.assert_close(getattr(whole, name)[-7:], getattr(last, name), rtol=1e-9, atol=1e-9)
    assert list(whole.parts) == ["qdd", "multiplier"]
