"""Learning online in C: the numbers of `update` and `forget` of the fit, stable over thousands of samples."""

from __future__ import annotations

import ctypes
import subprocess
from functools import cache
from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.errors import ModelError, ShapeError, UnknownNameError
from forcegp.forces.measurements import Observation
from forcegp.forces.priors.inertial import PayloadPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.priors.sets import friction_priors
from forcegp.models.export.library import CompiledFit
from forcegp.models.prediction import Predictor
from forcegp.models.structured_fit import StructuredFit
from forces.cases import draw, logged, two_contacts
from models.test_export import COMPILERS, SAME, STRICT, ZERO, compiled, fitted, free_log, needs_gcc, states
from slow import slow_except

FEW = slice(0, 24)


def accelerations(fit: StructuredFit) -> Tensor:
    """Noisy ones at `states`."""
    (q, qd, tau), active = states(fit)
    qdd = fit.predict(q, qd, tau, active=active, covariance=False).mean
    return qdd + 0.2 * torch.randn(qdd.shape, dtype=qdd.dtype, generator=torch.Generator().manual_seed(5))


def samples(fit: StructuredFit, rows: slice = FEW) -> tuple[tuple[Tensor, ...], Tensor, forcegp.Dataset]:
    """Some of them as tensors (q, q̇, τ, q̈), closed contacts, and a log."""
    state, active = states(fit)
    *state, qdd, active = (x[rows] for x in (*state, accelerations(fit), active))
    closed = {name: active[:, i] for i, name in enumerate(fit.system.contact_names)}
    t = torch.arange(len(qdd), dtype=torch.float64)
    data = forcegp.Dataset(t, *state, qdd, fit.system.robot.joint_names, contact=closed)
    return (*state, qdd), active, data


def differs(ours: Predictor, theirs: Predictor, fit: StructuredFit) -> float:
    """Largest difference of means in max(|mean|, σ), and of covariances in σσ, of q̈ and λ."""
    (q, qd, tau), active = states(fit)
    names = ["qdd", "multiplier"] if fit.system.contacts else ["qdd"]
    a, b = (x.predict(q, qd, tau, names, active=active) for x in (ours, theirs))
    assert a.covariance is not None and b.covariance is not None and b.std is not None
    std = b.std.maximum(ZERO * b.std.amax(-1, keepdim=True))
    size = b.mean.abs().maximum(b.std)
    size = size.maximum(ZERO * size.amax(-1, keepdim=True))
    mean = ((a.mean - b.mean).abs() / size).max()
    spread = ((a.covariance - b.covariance).abs() / (std[..., :, None] * std[..., None, :])).max()
    return max(float(mean), float(spread))


@cache
def updated(name: str) -> tuple[CompiledFit, StructuredFit]:
    """A fit with further samples, by C and in Python."""
    fit = fitted(name)
    state, active, data = samples(fit)
    for i in range(len(data)):  # several at once are searched for impacts
        fit = fit.update(data[i : i + 1])
    return compiled(name).update(*state, active=active), fit


CASES = [
    "free_friction",
    "free_inertial",
    "uncertain_inertia",
    "one_contact",
    "sparse",
    "zero_mean",
    "rounded_tip",
]


@pytest.mark.parametrize("name", slow_except(CASES, "free_inertial", "one_contact", "zero_mean"))
def test_samples_are_learned_as_by_the_fit(name: str) -> None:
    fit, (fast, slow) = fitted(name), updated(name)
    assert differs(fast, slow, fit) < SAME
    assert differs(fast, fit, fit) > 1e3 * SAME, "the samples changed nothing"
    assert differs(compiled(name), fit, fit) < SAME, "the fit itself was changed"
    with pytest.raises(ModelError, match="not part of the force field in PyTorch"):
        fast.force_field()


@pytest.mark.parametrize("name", ["one_contact", "sparse", "zero_mean"])
def test_samples_fade_and_priors_drift_as_in_the_fit(name: str) -> None:
    fit, (fast, slow) = fitted(name), updated(name)
    faded = fast.forget(0.8), slow.forget(0.8)
    assert differs(*faded, fit) < SAME and differs(faded[0], fast, fit) > 1e3 * SAME
    names = [prior.name for prior in fit.force_priors]
    for priors in ([names[0]], names[-1:], names):
        drifted = fast.forget(0.7, priors), slow.forget(0.7, priors=priors)
        assert differs(*drifted, fit) < SAME
        assert priors == names[-1:] or differs(drifted[0], fast, fit) > 1e3 * SAME
    reset = fast.forget(0.0, names), slow.forget(0.0, priors=names)
    assert differs(*reset, fit) < SAME


@pytest.mark.parametrize("name", ["free_friction", "sparse"])
def test_thousands_of_samples_one_by_one_are_those_together(name: str) -> None:
    fit, fast = fitted(name), compiled(name)
    state, active, data = samples(fit)
    rounds = -(-5000 // len(active))
    fast = fast.update(*(x.repeat(rounds, 1) for x in state), active=active.repeat(rounds, 1))
    rows = torch.arange(len(active)).repeat(rounds)
    assert len(rows) >= 5000
    assert differs(fast, fit.update(data[rows]), fit) < SAME


def test_a_budget_renews_the_prior_in_turns() -> None:
    fit, fast = fitted("sparse"), compiled("sparse")
    functions, turns, factor = (
        sum(part.roots[0].shape[0] * part.components for part in fast.model.parts()),
        8,
        0.98,
    )
    budget = -(-functions // turns)
    state, active, data = samples(fit, slice(0, 2 * turns))
    few, all_, stds = fast, fast, []
    for i in range(2 * turns):
        one = [x[i] for x in state]
        few = few.forget(factor, budget=budget).update(*one, active=active[i])
        all_ = all_.forget(factor).update(*one, active=active[i])
    assert differs(all_, _faded(fit, data, factor), fit) < SAME
    (q, qd, tau), at = states(fit)
    stds = [x.predict(q, qd, tau, active=at).std for x in (few, all_)]
    assert stds[0] is not None and stds[1] is not None
    # The precision of the prior is that of all_, or factor^turns of it: so is A, in between.
    ratio = stds[0][stds[1] > ZERO] / stds[1][stds[1] > ZERO]
    assert float(ratio.min()) > 1.0 - 1e-9 and float(ratio.max()) < factor ** (-turns / 2)
    assert float(ratio.max()) > 1.0 + 1e-6


def _faded(fit: StructuredFit, data: forcegp.Dataset, factor: float) -> StructuredFit:
    for i in range(len(data)):
        fit = fit.forget(factor).update(data[i : i + 1])
    return fit


@pytest.mark.slow
def test_another_measured_quantity() -> None:
    system, log = two_contacts(), logged(two_contacts(), 40)
    values = torch.randn(40, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    names = system.contact_names
    log = log.replace(contact_extras={"multiplier": {name: values[:, i] for i, name in enumerate(names)}})
    first, later = log[:30], log[30:]

    def observed(data: forcegp.Dataset) -> list[Observation]:
        return [Observation(data, noise_std=0.2), Observation(data, "multiplier", noise_std=1.5)]

    fit = forcegp.StructuredGP(system, "analytical", friction_priors(system)).fit(observed(first), learn=[])
    state, active = (later.q, later.qd, later.tau), later.active(names)
    fast = fit.compiled().update(*state, later.qdd, active=active)
    fast = fast.update(*state, values[30:], "multiplier", active=active)
    theirs = fit.update(observed(later))
    a, b = (x.predict(*state, active=active) for x in (fast, theirs))
    torch.testing.assert_close(a.mean, b.mean, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(a.covariance, b.covariance, rtol=1e-9, atol=1e-9)
    force = torch.zeros(10, 7, dtype=torch.float64)
    with pytest.raises(ModelError, match="pass noise_std"):
        fast.update(*state, force, "joint_force", active=active)
    assert fast.update(*state, force, "joint_force", active=active, noise_std=torch.tensor(2.0)) is not fast


def payload_model() -> StructuredFit:
    robot = forcegp.load_robot("kuka_iiwa")
    priors = [JointFrictionPrior(speeds=(0.1, 0.5)), PayloadPrior(mass=2.0)]
    noise = forcegp.Noise(0.05, torque=0.2)
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(robot), "analytical", priors, noise, inference="sparse"
    )
    return model.fit(free_log(robot, 80), learn=[])


@pytest.mark.slow
def test_a_payload_that_appears_is_followed() -> None:
    fit = payload_model()
    fast, robot = fit.compiled(), fit.system.robot
    q, qd, tau = draw(40, 8)
    assert differs(fast, fit, fit) < SAME
    carried = PayloadPrior(known=(1.5, 0.0, 0.0, 0.0)).loaded(robot)
    qdd = forcegp.dynamics.forward_dynamics(carried, q, qd, tau - 2.0 * torch.tanh(qd / 0.1) - qd)
    slow, log = fit, forcegp.Dataset(torch.arange(40).double(), q, qd, tau, qdd, robot.joint_names)
    for i in range(40):
        fast = fast.forget(0.95, ["payload"]).update(q[i], qd[i], tau[i], qdd[i])
        slow = slow.forget(0.95, priors=["payload"]).update(log[i : i + 1])
    assert differs(fast, slow, fit) < SAME
    before, after = (x.predict(q, qd, tau).mean - qdd for x in (fit, fast))
    assert float(after.square().mean()) < 0.1 * float(before.square().mean())


def test_a_robot_at_rest_teaches_nothing() -> None:
    fit, fast = fitted("free_friction"), compiled("free_friction")
    (q, qd, tau), _ = states(fit)
    assert differs(fast.update(q, 0.0 * qd, tau, q), fit, fit) < SAME


@pytest.mark.slow
def test_what_cannot_learn_is_refused() -> None:
    fast = compiled("sparse")
    state, active, _ = samples(fitted("sparse"))
    with pytest.raises(ModelError, match="cannot learn online in C"):
        fitted("sparse").compiled(functions=30).update(*state, active=active)
    with pytest.raises(ShapeError, match="values of 'qdd' do not match"):
        fast.update(*state[:3], state[3][:, :6], active=active)
    with pytest.raises(ShapeError, match="not finite"):
        fast.update(*state[:3], torch.nan * state[3], active=active)
    with pytest.raises(UnknownNameError, match="force prior to forget 'wind'"):
        fast.forget(0.5, ["wind"])
    for factor, priors in ((0.0, None), (1.5, None), (-0.1, ["joint"]), (float("nan"), None)):
        with pytest.raises(ModelError, match="invalid forgetting factor"):
            fast.forget(factor, priors)


@needs_gcc
def test_the_library_reports_what_it_does_not_learn() -> None:
    fast = compiled("one_contact").update(*samples(fitted("one_contact"))[0])
    q, qd, tau, qdd = (torch.ones(7, dtype=torch.float64) for _ in range(4))
    before, update = fast._learned.clone(), fast.library.forcegp_update  # type: ignore[union-attr]

    def status(quantity: int = 1) -> int:
        at = [x.data_ptr() for x in (q, qd, tau)]
        return update(fast._memory, *at, None, quantity, qdd.data_ptr(), None)

    assert status(0) == status(3) == status(2) == 7
    qdd[2] = float("nan")
    assert status() == 1
    qdd[2], q[0] = 0.0, float("inf")
    assert status() == 1
    q[0], qd[0] = 0.0, 1e200
    assert status() == 9, "a state that overflows would spoil all that was learned"
    assert torch.equal(before, fast._learned)  # type: ignore[arg-type]


MAIN = """
#include <stdio.h>
#include "controller.h"
static controller_learned learned;
int main(void) {
  const double q[7] = {0.1, 0.5, 0.2, -1.2, 0.3, 1.4, 0.4}, tau[7] = {1.0}, qdd[7] = {0.2};
  double qd[7] = {0.1, 0.2, -0.3}, mean[9], covariance[81];
  int error = 0;
  controller_begin(&learned);
  for (int i = 0; i < 5; ++i) {
    qd[1] += 0.1;
    error |= controller_forget(&learned, 0.9, 11);
    error |= controller_drift(&learned, 0, 0.9);
    error |= controller_update(&learned, q, qd, tau, NULL, CONTROLLER_QDD, qdd, NULL);
  }
  error |= controller_predict_learned(&learned, 1, q, qd, tau, NULL,
                                      CONTROLLER_QDD | CONTROLLER_MULTIPLIER, 1, mean, covariance, NULL);
  return error;
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", slow_except(["sparse", "one_contact"], "one_contact"))
def test_sanitizers_find_nothing_in_what_learns(name: str, compiler: str, tmp_path: Path) -> None:
    folder = fitted(name).export(tmp_path / "c").folder
    (folder / "main.c").write_text(MAIN)
    sanitized = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    command = [compiler, *STRICT, "-O0", *sanitized, "main.c", "controller.c", "-o", "run", "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:3000]
    ran = subprocess.run([str(folder / "run")], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_the_equations_of_motion_are_handed_out() -> None:
    fit, fast = fitted("one_contact"), compiled("one_contact")
    q, qd = (x[0].contiguous() for x in states(fit)[0][:2])
    M, A = torch.empty(7, 7, dtype=torch.float64), torch.empty(1, 7, dtype=torch.float64)
    pointers = [ctypes.c_void_p(x.data_ptr()) for x in (q, qd, M, A)]
    assert fast.library.forcegp_equations(*pointers) == 0
    eom = fit.system.equations(q, qd)
    torch.testing.assert_close(M, eom.M, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(A, eom.A, rtol=1e-12, atol=1e-14)
