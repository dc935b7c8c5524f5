"""Constraint drift: none, Baumgarte, projection; and the sign that the seed prints in eq. (30)."""

from dataclasses import dataclass

import torch

from forcegp.constraints import Baumgarte
from forcegp.rollout import Rollout, RolloutOptions, rollout
from rollout_cases import ANALYTICAL, arm, simulated

BAUMGARTE_DRIFT = 1e-4
PROJECTED_DRIFT = 1e-10
"""Bounds of the constraint error [m], required of this library."""


@dataclass(frozen=True)
class PrintedSign(Baumgarte):
    """b̃ = b + 2ωξ ċ + ω² c, as eq. (30) is printed."""

    def stabilized(self, b: torch.Tensor, c: torch.Tensor, cd: torch.Tensor) -> torch.Tensor:
        omega = self.natural_frequency
        return b + 2.0 * omega * self.damping_ratio * cd + omega**2 * c


def roll(stabilization: str | Baumgarte, seconds: float = 0.7, **options) -> Rollout:
    data = simulated().data
    settings = RolloutOptions(stabilization=stabilization, **options)
    return rollout(ANALYTICAL, arm(), data.q[0], data.qd[0], data, seconds, options=settings)


def worst(found: Rollout) -> float:
    return float(found.drift.nan_to_num(torch.inf).abs().max())


def test_baumgarte_and_projection_hold_the_surface_and_nothing_does_not() -> None:
    none, baumgarte, projected = (worst(roll(s)) for s in ("none", "baumgarte", "projection"))
    assert baumgarte <= BAUMGARTE_DRIFT
    assert projected <= PROJECTED_DRIFT
    assert none > 3.0 * baumgarte
    assert float(roll("projection", 0.2).cd[1:].abs().max()) < 1e-12, "velocities are projected too"


def test_the_printed_sign_of_equation_30_diverges() -> None:
    found = roll(PrintedSign(), on_divergence="keep")
    growth = found.drift[:, 0].abs()
    assert worst(found) > 100.0 * BAUMGARTE_DRIFT
    assert worst(found) > 100.0 * worst(roll("none"))
    assert float(growth[60]) < float(growth[120]), "the error grows"


def test_an_error_decays_at_baumgartes_rate() -> None:
    """c(t) = c₀ (1 + ω t) e^{−ω t} at critical damping, from a start off the surface."""
    omega, data, system = 20.0, simulated().data, arm()
    eom = system.equations(data.q[0], data.qd[0])
    q0 = data.q[0] + 1e-4 * eom.L[:, 0]
    qd0 = data.qd[0]
    c0 = float(system.equations(q0, qd0).c[0])
    options = RolloutOptions(dt=0.005, method="rk4", stabilization=Baumgarte(omega, 1.0))
    found = rollout(ANALYTICAL, system, q0, qd0, data.tau[:1], 0.15, options=options)
    expected = c0 * (1.0 + omega * found.t) * torch.exp(-omega * found.t)
    assert abs(c0) > 5e-5
    assert float((found.c[:, 0] - expected).abs().max()) < 0.01 * abs(c0)
