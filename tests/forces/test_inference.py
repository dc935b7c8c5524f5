"""Likelihood, gradient and posterior against the dense textbook formula, for every pair of quantities."""

from __future__ import annotations

import pytest
import torch

import forcegp
from forcegp.forces.measurements import COLUMNS, Observation
from forcegp.forces.priors.sets import default_priors
from forcegp.forces.quantities import QUANTITIES, affine_map, states
from forcegp.gp.likelihood import negative_log_likelihood
from forcegp.models.structured_fit import StructuredFit
from forces.cases import conditioned, draw, logged, mixed_contacts, two_contacts
from forces.textbook import Textbook

LIKELIHOOD, GRADIENT, POSTERIOR = 1e-9, 1e-6, 1e-8
"""Relative agreement with the textbook, the issue's figures."""

NOISE = {
    "qdd": [0.1, 0.2, 0.3, 0.1, 0.1, 0.1, 0.5],
    "multiplier": [1.0, 2.0],
    "contact_force": 1.5,
    "constraint_force": 0.7,
    "joint_force": 0.5,
    "contact_friction": 0.3,
    "total_force": [0.5, 0.4, 0.3, 0.2, 0.5, 0.4, 0.3],
}


def observed(*quantities: str, n: int = 8) -> list[Observation]:
    return [
        Observation(logged(two_contacts(), n, seed=i), name, NOISE[name]) for i, name in enumerate(quantities)
    ]


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).abs().max() / b.abs().max().clamp(min=1e-300))


MIXTURES = {
    "in contact and free": ("qdd",),
    "force sensors": ("qdd", "multiplier"),
    "everything": tuple(COLUMNS),
}
mixtures = pytest.mark.parametrize("quantities", MIXTURES.values(), ids=MIXTURES.keys())


@mixtures
def test_likelihood(quantities: tuple[str, ...]) -> None:
    model = conditioned(observed(*quantities))
    expected = -float(Textbook(model).negative_log_likelihood())
    assert model.result.log_marginal_likelihood == pytest.approx(expected, rel=LIKELIHOOD)


@pytest.mark.parametrize("closed", [True, False])
def test_likelihood_all_closed_or_all_free(closed: bool) -> None:
    data = logged(two_contacts(), 7, active=torch.full((7, 2), closed))
    model = conditioned(data)
    expected = -float(Textbook(model).negative_log_likelihood())
    assert model.result.log_marginal_likelihood == pytest.approx(expected, rel=LIKELIHOOD)


def gradients(model: StructuredFit, start: dict) -> tuple[dict, dict]:
    """Of the negative log likelihood, ours and by autograd through the dense formula."""
    results = []
    for dense in (False, True):
        leaves = {key: value.detach().clone().requires_grad_() for key, value in start.items()}
        if dense:
            value = Textbook(model, leaves, model.problem.system_at(leaves)).negative_log_likelihood()
        else:
            rows = model.problem.rows(leaves)
            others = ("noise.", "analytical_parameters.")
            kernel = {k: v for k, v in leaves.items() if not k.startswith(others)}
            value = negative_log_likelihood(model.force_priors, kernel, rows.blocks) + rows.constant
        found = torch.autograd.grad(value, list(leaves.values()), allow_unused=True)
        results.append(dict(zip(leaves, found, strict=True)))
    return results[0], results[1]


@mixtures
def test_gradient_of_kernels_and_noise(quantities: tuple[str, ...]) -> None:
    model = conditioned(observed(*quantities, n=6), noise=forcegp.Noise(learn=True))
    ours, dense = gradients(model, model.hyperparameters)
    assert any(key.startswith("noise.") for key in ours)
    for key in ours:
        assert relative(ours[key], dense[key]) < GRADIENT, key


def test_gradient_of_analytical_parameters() -> None:
    """Masses move M, and offsets also A, b and the inputs of the contact's prior."""
    robot = two_contacts().robot
    joints = robot.joint_names
    theta = forcegp.robot.AnalyticalParameters(
        robot, {"mass": joints[4:], "com": joints[5:], "damping": "all", "offset": joints[-1:]}
    )
    noise = forcegp.Noise(learn=True)
    model = conditioned(observed("qdd", "multiplier", n=6), noise=noise, analytical_parameters=theta)
    start = {f"analytical_parameters.{key}": value.detach() for key, value in theta.named_parameters()}
    ours, dense = gradients(model, {**model.hyperparameters, **start})
    for key in start:
        assert float(dense[key].abs().max()) > 0.0
        assert relative(ours[key], dense[key]) < GRADIENT, key


@pytest.mark.parametrize("measured", list(COLUMNS))
def test_posterior_of_every_quantity_from_every_quantity(measured: str) -> None:
    model = conditioned(observed(measured), seed=3)
    book, (q, qd, tau), active = Textbook(model), draw(4, seed=9), mixed_contacts(4)
    for quantity in QUANTITIES:
        ours = model.predict(q, qd, tau, quantity, active=active)
        mean, covariance = book.predict(q, qd, tau, active, quantity)
        assert relative(ours.mean, mean) < POSTERIOR, quantity
        assert relative(ours.covariance, covariance) < POSTERIOR, quantity


def test_posterior_from_a_mixture() -> None:
    model = conditioned(observed("qdd", "multiplier", "contact_friction"), seed=4)
    book, (q, qd, tau), active = Textbook(model), draw(4, seed=9), mixed_contacts(4)
    for quantity in QUANTITIES:
        ours = model.predict(q, qd, tau, quantity, active=active)
        mean, covariance = book.predict(q, qd, tau, active, quantity)
        assert relative(ours.mean, mean) < POSTERIOR, quantity
        assert relative(ours.covariance, covariance) < POSTERIOR, quantity


def test_joint_distribution_of_several_quantities() -> None:
    """Diagonal blocks are the single predictions; the rest obeys Newton's equation and the constraint."""
    model = conditioned(observed("qdd"))
    (q, qd, tau), active = draw(5, seed=9), mixed_contacts(5)
    joint = model.predict(q, qd, tau, ("qdd", "total_force", "multiplier"), active=active)
    for name, part in joint.parts.items():
        single = model.predict(q, qd, tau, name, active=active)
        assert torch.allclose(joint.mean[:, part], single.mean, rtol=1e-12, atol=1e-12)
        block = joint.covariance[:, part, part]
        assert relative(block, single.covariance) < POSTERIOR
    eom = model.system.equations(q, qd, active)
    # M q̈ − Q̄ − Aᵀ λ has mean and covariance zero.
    newton = torch.cat([eom.M, -torch.eye(7, dtype=torch.float64).expand_as(eom.M), -eom.A.mT], dim=-1)
    assert float((newton @ joint.mean[..., None]).abs().max()) < 1e-9 * float(joint.mean.abs().max())
    assert float((newton @ joint.covariance @ newton.mT).abs().max()) < 1e-9 * float(
        joint.covariance.abs().max()
    )
    qdd, block = (
        joint.mean[:, joint.parts["qdd"]],
        joint.covariance[:, joint.parts["qdd"], joint.parts["qdd"]],
    )
    assert float(((eom.A @ qdd[..., None])[..., 0] - eom.b).abs().max()) < 1e-9 * float(eom.b.abs().max())
    assert float((eom.A @ block @ eom.A.mT).abs().max()) < 1e-9 * float(block.abs().max())


def test_affine_maps_are_the_equations_of_motion() -> None:
    system, (q, qd, tau), active = two_contacts(), draw(6), mixed_contacts(6)
    at, (Q, Q_z, _) = states(system, q, qd, tau, active), draw(6, seed=5)
    total, eom = Q + Q_z, system.equations(q, qd, active)
    F = torch.cat(
        [
            eom.contact_points[n].normal * eom.multiplier(total)[:, i, None]
            for i, n in enumerate(system.contact_names)
        ],
        -1,
    )
    expected = {
        "qdd": eom.acceleration(total),
        "qdd_free": torch.linalg.solve(eom.M, Q),
        "multiplier": eom.multiplier(total),
        "constraint_force": eom.constraint_force(total),
        "contact_force": F,
        "total_force": total,
        "joint_force": Q,
        "contact_friction": Q_z,
    }
    assert expected.keys() == QUANTITIES.keys()
    for name, value in expected.items():
        z = affine_map(system, at, name)
        found = z.o + (z.B_Q @ Q[..., None] + z.B_z @ Q_z[..., None])[..., 0]
        assert relative(found, value) < 1e-10, name


def test_noise_of_the_dense_formula_matters() -> None:
    """The check above can fail: another noise gives another likelihood."""
    data = logged(two_contacts(), 6)
    one, two = (conditioned(data, noise=std) for std in (0.1, 0.101))
    assert abs(one.result.log_marginal_likelihood - two.result.log_marginal_likelihood) > 1e-3


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-2])
def test_redundant_and_nearly_redundant_contacts(angle: float) -> None:
    """Two contacts at one point whose normals differ by an angle: one row or two, never in between."""
    first, _ = two_contacts().contacts
    assert isinstance(first, forcegp.SurfaceContact)
    again = forcegp.SurfaceContact("ball", first.frame, first.point, forcegp.Plane((angle, 0.2, 1), 0.055))
    system = forcegp.ConstrainedSystem(two_contacts().robot, [first, again], forcegp.constraints.Baumgarte())
    data = logged(system, 6)
    priors = default_priors(system, "analytical")
    model = forcegp.StructuredGP(system, "analytical", priors, noise=0.1).fit(data, learn=[])
    expected = -float(Textbook(model).negative_log_likelihood())
    # Dropping a row leaves an error of the order of the angle.
    assert model.result.log_marginal_likelihood == pytest.approx(expected, rel=1e-5)
