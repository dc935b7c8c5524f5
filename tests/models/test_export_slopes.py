"""Jacobians of the mean in C: those of autograd, and finite differences of the mean."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.destination import MANIFEST
from forcegp.errors import ModelError, NumericalError, ShapeError, UnknownNameError
from forcegp.forces.priors.inertial import PayloadPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.models.export.library import CompiledFit
from forcegp.models.export.mean import DIFFERENTIATED
from forces.cases import two_contacts
from models.test_export import CASES, compiled, fitted, free_log, states
from slow import slow_except

SAME = 1e-8
"""Of the largest entry of a Jacobian; the sums are the same in another order, and derivatives amplify."""
STEP, ROUGH = 1e-5, 1e-6
"""Of finite differences of the fourth order, and their error, in units of the largest entry."""


def difference(ours: Tensor, theirs: Tensor) -> float:
    """Largest difference in units of the largest entry of a state."""
    return float(((ours - theirs).abs().amax((-2, -1)) / theirs.abs().amax((-2, -1)).clamp(min=1e-12)).max())


def finite_differences(fast: CompiledFit, state: tuple[Tensor, ...], active: Tensor) -> list[Tensor]:
    """Derivatives of the mean of all quantities by q, q̇ and τ, of the fourth order."""
    found = []
    for i in range(3):
        columns = []
        for step in torch.eye(7, dtype=torch.float64) * STEP:

            def at(times: float, step: Tensor = step, i: int = i) -> Tensor:
                moved = [x + times * step if k == i else x for k, x in enumerate(state)]
                return fast.predict(*moved, DIFFERENTIATED, active=active, covariance=False).mean

            columns.append((8.0 * (at(1.0) - at(-1.0)) - (at(2.0) - at(-2.0))) / (12.0 * STEP))
        found.append(torch.stack(columns, dim=-1))
    return found


@pytest.mark.parametrize("name", slow_except(CASES, "free_friction", "one_contact", "every_friction"))
def test_jacobians_are_those_of_autograd_and_of_finite_differences(name: str) -> None:
    fit, fast = fitted(name), compiled(name)
    state, active = states(fit)
    ours, theirs = (x.linearize(*state, active=active) for x in (fast, fit))
    for field in ("dq", "dqd", "dtau", "multiplier_dq", "multiplier_dqd", "multiplier_dtau"):
        a, b = getattr(ours, field), getattr(theirs, field)
        assert a.shape == b.shape
        assert not b.numel() or difference(a, b) < SAME, field
    torch.testing.assert_close(ours.qdd, theirs.qdd, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(ours.multiplier, theirs.multiplier, rtol=1e-9, atol=1e-9)
    whole = fast.jacobian(*state, DIFFERENTIATED, active=active)
    differences = finite_differences(fast, state, active)
    for part in whole.parts.values():
        for a, b in zip(whole[1:4], differences, strict=True):
            assert not b[:, part].numel() or difference(a[:, part], b[:, part]) < ROUGH


@pytest.mark.parametrize("name", ["free_inertial", "one_contact", "sparse"])
def test_a_casadi_function_has_the_mean_its_jacobians_and_its_hessian(name: str, tmp_path: Path) -> None:
    casadi = pytest.importorskip("casadi")
    fit, (state, active) = fitted(name), states(fitted(name), 4)
    folder = fit.export(tmp_path / "mpc", language="casadi", name="arm").folder
    assert {path.name for path in folder.iterdir()} == {"arm.casadi", "README.md", MANIFEST}
    f = casadi.Function.load(str(folder / "arm.casadi"))
    ours = f.map(4)(*(x.mT.numpy() for x in (*state, active.double())))
    mean = compiled(name).predict(*state, DIFFERENTIATED, active=active, covariance=False)
    for value, part in zip(ours, mean.parts.values(), strict=True):
        value = torch.tensor(value.full()).mT
        torch.testing.assert_close(value, mean.mean[:, part], rtol=1e-9, atol=1e-9)
    slopes = f.factory("J", f.name_in(), [f"jac:qdd:{x}" for x in ("q", "qd", "tau")])
    weights = torch.linspace(-1.0, 1.0, 7, dtype=torch.float64)
    pulled = f.factory("g", [*f.name_in(), "lam:qdd"], ["grad:gamma:q"], {"gamma": ["qdd"]})
    turned = pulled.factory("H", pulled.name_in(), ["jac:grad_gamma_q:q"])
    for i in range(4):
        at = [x[i].numpy() for x in (*state, active.double())]
        theirs = compiled(name).jacobian(*(x[i] for x in state), "qdd", active=active[i])
        for a, b in zip(slopes(*at), theirs[1:4], strict=True):
            assert difference(torch.tensor(a.full()), b) < SAME
        hessian = torch.tensor(turned(*at, weights.numpy()).full())
        columns = []
        for step in torch.eye(7, dtype=torch.float64) * STEP:
            pair = [state[0][i] + sign * step for sign in (1.0, -1.0)]
            rest = (state[1][i], state[2][i], "qdd")
            up, down = (weights @ compiled(name).jacobian(q, *rest, active=active[i]).dq for q in pair)
            columns.append((up - down) / (2.0 * STEP))
        assert difference(hessian, torch.stack(columns, dim=-1)) < ROUGH


def test_contacts_that_hold_the_same_direction_have_no_jacobian() -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    twins = [forcegp.SurfaceContact(x, "lbr_iiwa_link_7", (0, 0, 0.1), forcegp.Plane()) for x in ("a", "b")]
    data = free_log(robot, 12).replace(contact={x: torch.ones(12, dtype=torch.bool) for x in ("a", "b")})
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(robot, twins), "analytical", [JointFrictionPrior()], noise=0.1
    )
    fast = model.fit(data, learn=[]).compiled()
    state = (data.q[0], data.qd[0], data.tau[0])
    with pytest.raises(NumericalError, match="hold the robot in the same direction"):
        fast.jacobian(*state)
    one = fast.jacobian(*state, active=torch.tensor([True, False]))
    assert bool(one.dq.isfinite().all())


@pytest.mark.slow
def test_jacobians_with_a_payload() -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(robot),
        "analytical",
        [JointFrictionPrior(), PayloadPrior(mass=2.0)],
        noise=0.1,
    )
    fit = model.fit(free_log(robot, 40), learn=[])
    state, active = states(fit)
    fast = fit.compiled()
    for a, b in zip(fast.linearize(*state, active=active), fit.linearize(*state, active=active), strict=True):
        torch.testing.assert_close(a, b, rtol=SAME, atol=SAME * float(b.abs().max()) if b.numel() else 0.0)


def test_what_has_learned_in_c_has_no_jacobian() -> None:
    fit, fast = fitted("free_friction"), compiled("free_friction")
    q, qd, tau = (x[0] for x in states(fit)[0])
    with pytest.raises(ModelError, match="do not change the Jacobian"):
        fast.update(q, qd + 1.0, tau, tau).linearize(q, qd, tau)


def test_what_has_no_jacobian_is_refused() -> None:
    fast, (state, active) = compiled("one_contact"), states(fitted("one_contact"))
    with pytest.raises(UnknownNameError, match="unknown quantity with a Jacobian 'total_force'"):
        fast.jacobian(*state, "total_force")
    with pytest.raises(ShapeError, match="qd contains values that are not finite"):
        fast.jacobian(state[0], state[1] * float("nan"), state[2], active=active)
    swapped = fast.jacobian(*state, ["multiplier", "qdd"], active=active)
    plain = fast.jacobian(*state, ["qdd", "multiplier"], active=active)
    assert torch.equal(swapped.dq, plain.dq.roll(1, dims=-2)) and list(swapped.parts) == ["multiplier", "qdd"]
    with pytest.raises(ModelError, match="its own system"):
        fast.linearize(*state, system=two_contacts())
