"""On a CUDA device, learning and prediction give what they give on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.constraints import ConstrainedSystem
from forcegp.evaluation.least_squares import identify_rigid
from forcegp.forces.quantities import QUANTITIES
from forcegp.gp.kernels import SquaredExponential
from forcegp.gp.optimise import LearningOptions
from forcegp.models.calibrated import sampled_robots
from forcegp.models.load import load_model
from forcegp.models.structured_fit import StructuredFit
from forces.cases import all_priors, draw, logged, mixed_contacts, two_contacts
from models import test_pairs_of_options as options
from random_data import random_data, table_system

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
DEVICES = ("cpu", "cuda")
SAME, LEARNED = 1e-8, 1e-5
"""Relative differences: of the same sums in another order, and after a search of a few steps."""
FEW = LearningOptions(max_evaluations=4, warm_start=None)
ROWS = 60


def on(system: ConstrainedSystem, device: str) -> ConstrainedSystem:
    return system.with_robot(system.robot.to(device))


def agree(found: Callable[[str], Any], tolerance: float = SAME) -> None:
    """Tensors of both devices are on them, finite and equal."""
    cpu, cuda = (found(device) for device in DEVICES)
    cpu, cuda = ([x] if isinstance(x, Tensor) else list(x) for x in (cpu, cuda))
    assert len(cpu) == len(cuda) > 0
    for x, y in zip(cpu, cuda, strict=True):
        assert (x.device.type, y.device.type) == DEVICES
        assert bool(torch.isfinite(x).all())
        assert float((x - y.cpu()).abs().max()) <= tolerance * float(x.abs().max())


@cache
def fitted(device: str, inference: str = "exact", learn: bool = False) -> StructuredFit:
    """Two contacts, joint and contact priors."""
    chosen = forcegp.models.Inference(inference, inducing_points=8)
    model = forcegp.StructuredGP(on(two_contacts(), device), "analytical", all_priors(), inference=chosen)
    data = logged(two_contacts(), ROWS).to(device)
    return model.fit(data, options=FEW) if learn else model.fit(data, learn=[])


def states(device: str, n: int = 5) -> tuple[Tensor, ...]:
    q, qd, tau = (x.to(device) for x in draw(n, seed=3))
    return q, qd, tau


def test_equations() -> None:
    def terms(device: str) -> list[Tensor]:
        q, qd, _ = states(device)
        eom = on(two_contacts(), device).equations(q, qd, mixed_contacts(5).to(device))
        return [eom.M, eom.Q_K, eom.A, eom.b, eom.L, eom.T, eom.H]

    agree(terms)


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("inference", ["exact", "sparse"])
def test_every_quantity(quantity: str, inference: str) -> None:
    def predicted(device: str) -> tuple[Tensor, Tensor]:
        active = mixed_contacts(5).to(device)
        found = fitted(device, inference).predict(*states(device), quantity, active=active)
        assert found.covariance is not None
        return found.mean, found.covariance

    agree(predicted)


@pytest.mark.parametrize("inference", ["exact", "sparse"])
def test_learning(inference: str) -> None:
    agree(lambda device: fitted(device, inference, learn=True).predict(*states(device)).mean, LEARNED)


@pytest.mark.parametrize("name", options.OPTIONS)
def test_options(name: str) -> None:
    system, data = options.log()

    def predicted(device: str) -> tuple[Tensor, Tensor]:
        settings: options.Settings = {
            "mean": "analytical",
            "force_priors": [
                forcegp.priors.JointForcePrior(SquaredExponential(("q", "qd")), inputs=("q", "qd"))
            ],
            "noise": forcegp.Noise(torque=None),
        }
        settings = options.OPTIONS[name](settings)
        if "analytical_parameters" in settings:
            robot = system.robot.to(device)
            settings["analytical_parameters"] = options.AnalyticalParameters(robot, {"mass": "all"})
        model = forcegp.StructuredGP(on(system, device), **settings)
        fit = model.fit(data.to(device), options=options.FEW)
        some = (x[::5].to(device) for x in (data.q + 0.1, data.qd, data.tau))
        found = fit.predict(*some)
        assert found.covariance is not None
        return found.mean, found.covariance

    agree(predicted, 1e-4)


@cache
def moving(device: str) -> StructuredFit:
    """The default on a log of 400 samples in order of time: priors selected, inertia in question."""
    return forcegp.StructuredGP(on(table_system(), device)).fit(long_log().to(device))


@cache
def long_log() -> forcegp.Dataset:
    """An arm that moves along sines, free of the table, with viscous and dry friction of the joints."""
    system = table_system()
    generator = torch.Generator().manual_seed(1)
    t = 0.02 * torch.arange(400, dtype=torch.float64)
    w = 1.0 + torch.rand(3, 7, generator=generator, dtype=torch.float64)
    angle = w * t[:, None, None] + 6.0 * torch.rand(3, 7, generator=generator, dtype=torch.float64)
    q, qd, qdd = (x.sum(1) / 3.0 for x in (angle.sin(), w * angle.cos(), -(w**2) * angle.sin()))
    tau = forcegp.dynamics.inverse_dynamics(system.robot, q, qd, qdd) + 0.5 * qd + torch.tanh(qd / 0.05)
    noise = 0.05 * torch.randn(400, 7, generator=generator, dtype=torch.float64)
    header = forcegp.data.DataHeader(noise_std=0.05, dt=0.02)
    free = {"table": torch.zeros(400, dtype=torch.bool)}
    return forcegp.Dataset(t, q, qd, tau, qdd + noise, system.robot.joint_names, contact=free, header=header)


def test_the_default() -> None:
    data = long_log()

    def predicted(device: str) -> Tensor:
        x = data.to(device)
        return moving(device).predict(x.q[::7], x.qd[::7], x.tau[::7], active=x.active(("table",))[::7]).mean

    agree(predicted, 1e-2)


@pytest.mark.parametrize("method", ["acceleration", "momentum"])
def test_external_wrench(method: str) -> None:
    def wrench(device: str) -> tuple[Tensor, Tensor]:
        found = moving(device).external_wrench(long_log().to(device)[:50], "lbr_iiwa_link_7", method=method)
        assert found.covariance is not None
        return found.mean, found.covariance

    agree(wrench, 5e-2)


@pytest.mark.parametrize("inference", ["exact", "sparse"])
def test_updates(inference: str) -> None:
    def changed(device: str) -> list[Tensor]:
        fit = fitted(device, inference)
        more = logged(two_contacts(), 12, seed=5).to(device)
        updated = fit.update(more)
        fits = [updated, fit.condition(more)]
        if inference == "sparse":
            fits.append(updated.forget(more[:5]))
        return [x.predict(*states(device)).mean for x in fits]

    agree(changed)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("samples", [0, 3])
def test_rollouts(samples: int, closed: bool) -> None:
    def moved(device: str) -> Tensor:
        q, qd, tau = (x[:2] for x in states(device))
        active = torch.full((2, 2), closed, device=device)
        motion = fitted(device).rollout(q, 0.1 * qd, lambda *_: 0.1 * tau[0], 0.004, samples, active=active)
        return motion.q if motion.samples is None else motion.samples.q

    agree(moved, 1e-6)


def test_files(tmp_path: Path) -> None:
    """A fit that was learned on a GPU is loaded on the CPU."""
    fit = fitted("cuda")
    fit.save(tmp_path / "model")
    loaded = load_model(tmp_path / "model")
    found, there = (x.predict(*states(d)).mean for x, d in ((loaded, "cpu"), (fit, "cuda")))
    assert float((found - there.cpu()).abs().max()) <= SAME * float(found.abs().max())


@pytest.mark.parametrize("model", ["AnalyticalModel", "NeuralNetwork", "IndependentGP"])
def test_other_models(model: str) -> None:
    data = random_data(table_system(), 40)

    def predicted(device: str) -> Tensor:
        x = data.to(device)
        given = {} if model == "AnalyticalModel" else {"options": FEW} if model == "IndependentGP" else {}
        fit = getattr(forcegp, model)(on(table_system(), device)).fit(x, **given)
        return fit.predict(x.q, x.qd, x.tau).mean

    agree(predicted, 1e-2)


def test_identified_robots() -> None:
    def links(device: str) -> list[Tensor]:
        squares = identify_rigid(on(table_system(), device), long_log().to(device))
        drawn = sampled_robots(moving(device), 3)
        assert all(robot.device.type == device for robot in drawn)
        return [squares.system.robot.mass]

    agree(links, 1e-3)
