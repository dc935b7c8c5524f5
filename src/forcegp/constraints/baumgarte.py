"""Baumgarte stabilization of the constraint error (section 4 of the paper)."""

from __future__ import annotations

from dataclasses import dataclass

from forcegp.errors import ParameterError
from forcegp.types import ConstraintVector


@dataclass(frozen=True)
class Baumgarte:
    """Makes the constraint error a damped oscillator, c̈ + 2ωξ ċ + ω² c = 0 (eq. 29).

    Since c̈ = A q̈ − b, the stabilized right-hand side is b̃ = b − 2ωξ A q̇ − ω² c: the signs that the
    paper prints in eq. (30) are the opposite ones, with which the error grows.

    Args:
        natural_frequency: ω > 0 [rad/s].
        damping_ratio: ξ > 0; 1 is critical damping.

    Raises:
        ParameterError: a parameter is not positive.
    """

    natural_frequency: float = 10.0
    damping_ratio: float = 1.0

    def __post_init__(self) -> None:
        for name in ("natural_frequency", "damping_ratio"):
            value = getattr(self, name)
            if not 0.0 < value < float("inf"):
                raise ParameterError(
                    f"Baumgarte's {name} must be positive",
                    expected="a positive finite number",
                    got=value,
                    hint="pass baumgarte=None for no stabilization",
                )

    def stabilized(self, b: ConstraintVector, c: ConstraintVector, cd: ConstraintVector) -> ConstraintVector:
        """b̃ = b − 2ωξ ċ − ω² c, `(*batch, m)`."""
        omega = self.natural_frequency
        return b - 2.0 * omega * self.damping_ratio * cd - omega**2 * c
