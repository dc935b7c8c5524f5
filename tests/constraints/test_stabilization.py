"""Decay of the constraint error under stabilization, and its growth with the signs that the paper prints."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

import forcegp
from constraints.cases import random_state, system_of
from forcegp.constraints import Baumgarte, ConstrainedSystem
from forcegp.errors import ForceGPError

INTEGRATION = 1e-6
"""RK4 at 2 ms over 0.1 s on an error of order one."""


@dataclasses.dataclass(frozen=True)
class Printed(Baumgarte):
    """Eq. (30) as it is printed."""

    def stabilized(self, b: Tensor, c: Tensor, cd: Tensor) -> Tensor:
        return 2.0 * b - super().stabilized(b, c, cd)


def integrate(system: ConstrainedSystem, q: Tensor, qd: Tensor, seconds: float, step: float = 2e-3) -> Tensor:
    """The constraint error after a motion with no impressed force but the bias force."""

    def rate(q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        eom = system.equations(q, qd)
        return qd, eom.acceleration(eom.Q_C)

    for _ in range(round(seconds / step)):
        k1 = rate(q, qd)
        k2 = rate(q + 0.5 * step * k1[0], qd + 0.5 * step * k1[1])
        k3 = rate(q + 0.5 * step * k2[0], qd + 0.5 * step * k2[1])
        k4 = rate(q + step * k3[0], qd + step * k3[1])
        q = q + step / 6.0 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0])
        qd = qd + step / 6.0 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1])
    return system.equations(q, qd).c


def oscillator(c: float, cd: float, omega: float, xi: float, t: float) -> float:
    """Solution of c̈ + 2ωξ ċ + ω² c = 0."""
    if xi == 1.0:
        return (c + (cd + omega * c) * t) * math.exp(-omega * t)
    root = omega * math.sqrt(abs(1.0 - xi**2))
    even, odd = (math.cos, math.sin) if xi < 1.0 else (math.cosh, math.sinh)
    return math.exp(-xi * omega * t) * (c * even(root * t) + (cd + xi * omega * c) / root * odd(root * t))


def start(system: ConstrainedSystem) -> tuple[Tensor, Tensor]:
    q, qd, _ = random_state(system, seed=4)
    return q, 0.3 * qd


@pytest.mark.parametrize(("omega", "xi"), [(10.0, 1.0), (10.0, 0.4), (6.0, 2.0)])
def test_the_error_is_the_oscillator_that_omega_and_xi_describe(omega: float, xi: float) -> None:
    system = system_of("plane", 1, Baumgarte(omega, xi))
    q, qd = start(system)
    eom = system.equations(q, qd)
    found = float(integrate(system, q, qd, 0.1))
    c, cd = float(eom.c), float(eom.cd)
    assert abs(c) > 0.01
    assert found == pytest.approx(oscillator(c, cd, omega, xi, 0.1), abs=INTEGRATION)


def test_the_printed_signs_make_the_error_grow() -> None:
    errors = {}
    for name, baumgarte in (("ours", Baumgarte(10.0, 1.0)), ("printed", Printed(10.0, 1.0))):
        system = system_of("plane", 1, baumgarte)
        q, qd = start(system)
        first = abs(float(system.equations(q, qd).c))
        errors[name] = abs(float(integrate(system, q, qd, 0.1))) / first
    assert errors["ours"] < 1.0 < errors["printed"]
    assert errors["printed"] > math.exp(0.1 * 5.0)


def test_stabilization_changes_b_alone() -> None:
    plain, stabilized = (system_of("two", 0, b) for b in (None, Baumgarte(7.0, 0.5)))
    q, qd, _ = random_state(plain, 3)
    one, two = plain.equations(q, qd), stabilized.equations(q, qd)
    assert torch.equal(one.A, two.A)
    assert torch.allclose(two.b, one.b - 2 * 7.0 * 0.5 * one.cd - 49.0 * one.c, rtol=1e-14)


@pytest.mark.parametrize("name", ["natural_frequency", "damping_ratio"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("inf"), float("nan")])
def test_parameters_that_do_not_stabilize_are_refused(name: str, value: float) -> None:
    with pytest.raises(ForceGPError, match=rf"Baumgarte's {name} must be positive[\s\S]*baumgarte=None"):
        forcegp.constraints.Baumgarte(**{name: value})
