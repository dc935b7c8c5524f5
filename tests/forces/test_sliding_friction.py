"""Friction proportional to the multiplier solves the coupled equations; all friction takes energy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import forcegp
from forcegp.constraints.gauss import tangent_frame
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.priors.contact import TERMS, ContactForcePrior, SlidingFrictionPrior
from forcegp.forces.quantities import States, states
from random_data import random_data, table_system

N, EPS = 8, 0.01
ROTATION = forcegp.kinematics.frame_pose(
    forcegp.load_robot("kuka_iiwa", base_rpy=(0.3, -0.4, 0.5)),
    torch.zeros(7, dtype=torch.float64),
    "lbr_iiwa_link_0",
)[0]
"""How a whole scene is turned."""


def pressed(system: forcegp.ConstrainedSystem) -> States:
    """States in which the tip slides, and is pressed on its surface by about 20 N."""
    data = random_data(table_system(), N, free=False)
    closed = torch.ones(N, 1, dtype=torch.bool)
    at = states(system, data.q, data.qd, data.tau, closed)
    lacking = 20.0 - at.eom.multiplier(at.eom.Q_K + data.tau)
    return states(system, data.q, data.qd, data.tau - (at.eom.A.mT @ lacking[..., None])[..., 0], closed)


def coupled(system: forcegp.ConstrainedSystem, at: States, mu: float) -> tuple[np.ndarray, np.ndarray]:
    """λ and Q_z = −μ λ Jᵀ s(v) by a dense solve of M q̈ − (Aᵀ + μ u) λ = Q_K + τ, A q̈ = b."""
    Q, along = (at.eom.Q_K + at.tau).numpy(), np.diag([1.0, 1.0, 0.0])
    multipliers, forces = [], []
    for i in range(N):
        J = at.eom.contact_points["table"].jacobian[i].numpy()
        v = along @ J @ at.qd[i].numpy()
        u = -J.T @ v / np.sqrt(v @ v + EPS**2)
        A = at.eom.A[i].numpy()
        K = np.block([[at.eom.M[i].numpy(), -(A[0] + mu * u)[:, None]], [A, np.zeros((1, 1))]])
        multipliers.append(np.linalg.solve(K, np.concatenate([Q[i], at.eom.b[i].numpy()]))[-1])
        forces.append(mu * multipliers[-1] * u)
    return np.array(multipliers), np.array(forces)


def test_coulomb_friction_solves_the_coupled_equations() -> None:
    system = table_system()
    at = pressed(system)
    multiplier, expected = coupled(system, at, 0.3)
    assert multiplier.min() > 1.0 and np.abs(multiplier - 20.0).max() > 1.0
    prior = SlidingFrictionPrior("table", terms=("coulomb",), friction_coefficient=0.3, smoothing=EPS)
    Q_z = 0.3 * prior.operator(system, at)[..., 0]
    np.testing.assert_allclose(Q_z, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        at.eom.multiplier(at.eom.Q_K + at.tau + Q_z)[:, 0], multiplier, rtol=1e-9, atol=1e-9
    )


def test_what_is_missed_is_of_second_order() -> None:
    """Half the friction coefficient, or half its distance from the one assumed, is a quarter of the error."""
    system = table_system()
    at = pressed(system)

    def missed(mu: float, assumed: float) -> float:
        prior = SlidingFrictionPrior("table", terms=("coulomb",), friction_coefficient=assumed, smoothing=EPS)
        Q_z = mu * prior.operator(system, at)[..., 0].numpy()
        return float(np.abs(Q_z - coupled(system, at, mu)[1]).max())

    assert missed(0.02, 0.0) / missed(0.01, 0.0) == pytest.approx(4.0, rel=0.05)
    assert missed(0.01, 0.0) / missed(0.01, 0.005) == pytest.approx(2.0, rel=0.05)


def test_every_kind_of_friction_takes_energy() -> None:
    system = table_system()
    at = pressed(system)
    prior = SlidingFrictionPrior("table", terms=TERMS, friction_coefficient=0.3)
    E = prior.operator(system, at)
    power = (E.mT @ at.qd[..., None])[..., 0]
    assert E.shape == (N, 7, len(TERMS)) and bool((power < 0.0).all())
    # The Stribeck term is that of Coulomb at rest and gone at speed.
    v = at.eom.contact_points["table"].velocity[:, :2].square().sum(-1, keepdim=True)
    torch.testing.assert_close(E[..., 3], E[..., 2] * torch.exp(-v / 0.05**2))


def test_torsion_is_a_moment_about_the_normal_alone() -> None:
    system = table_system()
    at = pressed(system)
    torsion = SlidingFrictionPrior("table", terms=("torsion",)).operator(system, at)[..., 0]
    J = forcegp.kinematics.frame_jacobian(system.robot, at.q, "lbr_iiwa_link_7", (0, 0, 0.1))
    wrench = torch.linalg.lstsq(J.mT, torsion[..., None], driver="gelsd").solution[..., 0]
    rate = (J[:, 2] * at.qd).sum(-1)
    size = -20.0 * rate / (rate.square() + 0.1**2).sqrt()
    expected = torch.zeros_like(wrench)
    expected[:, 2] = size
    torch.testing.assert_close(wrench, expected, rtol=1e-7, atol=1e-7)


def test_friction_is_the_same_in_a_scene_that_is_turned() -> None:
    robot = table_system().robot
    normal, gravity = ROTATION[:, 2].tolist(), (ROTATION @ robot.gravity).tolist()
    turned_robot = forcegp.load_robot("kuka_iiwa", base_rpy=(0.3, -0.4, 0.5), gravity=gravity)
    tip = forcegp.SurfaceContact("table", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), forcegp.Plane(normal))
    level, turned = table_system(), forcegp.ConstrainedSystem(turned_robot, [tip])
    there = pressed(level)
    here = states(turned, there.q, there.qd, there.tau, there.active)
    prior = SlidingFrictionPrior("table", terms=TERMS)
    torch.testing.assert_close(prior.operator(turned, here), prior.operator(level, there))
    torch.testing.assert_close(prior.features(turned, here), prior.features(level, there))
    any_force = ContactForcePrior("table", inputs=("velocity",))
    lengths = [any_force.features(s, x)["velocity"].norm(dim=-1) for s, x in ((level, there), (turned, here))]
    torch.testing.assert_close(*lengths)


def test_a_tangent_frame_is_orthonormal_and_turns_smoothly() -> None:
    n = torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    n = torch.cat(
        [torch.nn.functional.normalize(n, dim=-1), torch.tensor([[0, 0, 1.0], [0, 0, -1.0]]).double()]
    )
    frame = torch.cat([tangent_frame(n), n[..., None]], dim=-1)
    torch.testing.assert_close(frame.mT @ frame, torch.eye(3, dtype=torch.float64).expand(202, 3, 3))
    torch.testing.assert_close(torch.linalg.det(frame), torch.ones(202, dtype=torch.float64))
    # The smallest rotation: its trace is 1 + 2 cos of the angle between the normals.
    torch.testing.assert_close(frame.diagonal(dim1=-2, dim2=-1).sum(-1)[:-1], 1.0 + 2.0 * n[:-1, 2])


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"terms": ("sticky",)}, UnknownNameError, "sticky"),
        ({"terms": ("dry", "dry")}, ModelError, "has a duplicate friction term"),
        ({"terms": ()}, ModelError, "has no inputs"),
        ({"friction_coefficient": -0.1}, ModelError, "an invalid friction coefficient"),
        ({"stribeck_speed": 0.0}, ModelError, "invalid Stribeck speed"),
    ],
)
def test_friction_that_makes_no_sense_is_refused(
    settings: dict, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        SlidingFrictionPrior("table", **settings)


def test_a_contact_that_jams_is_refused() -> None:
    system = table_system()
    prior = SlidingFrictionPrior("table", terms=("coulomb",), friction_coefficient=1e3)
    with pytest.raises(ModelError, match="contact 'table' jams with a friction coefficient of 1000"):
        prior.operator(system, pressed(system))
