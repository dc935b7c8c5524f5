"""How a rollout is computed: step, method, stabilization, contacts that open, and divergence."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from forcegp.constraints import Baumgarte, ConstrainedSystem
from forcegp.errors import ForceGPError, UnknownNameError
from forcegp.rollout.integrate import METHODS

STABILIZATIONS = ("none", "baumgarte", "projection")
ON_DIVERGENCE = ("raise", "keep")


@dataclass(frozen=True)
class RolloutOptions:
    """How a rollout is computed.

    Args:
        dt: step, period of the output, and sampling period of torques passed as an array [s]. By default
            the sampling period of the torques where they have one (a log, a controller), and 1/240 s for
            a feedback law; an array has none, so it needs `dt`.
        method: `semi_implicit_euler` (the simulators' step), `rk4`, or, adaptive within each step,
            `rk45` and `dop853` of SciPy.
        stabilization: `none`, `baumgarte` (the system's own terms, or the default ones), other
            `Baumgarte` terms, or `projection` of q and q̇ onto the manifold after each step.
        unilateral: whether contacts with a surface open where they would pull, and close again.
        interpolation: of a torque array between its samples, `hold` or `linear`.
        speed_limit: a joint faster than this counts as diverged [rad/s, m/s].
        torque_noise: whether function samples are driven by torques with noise drawn anew for each of them,
            where the model has learned the noise of logged torques and its correlation in time.
        on_divergence: `raise` a `DivergedError` that holds the trajectories, or `keep` them.

    Example:
        >>> RolloutOptions(method="rk4", stabilization="projection", dt=0.002).method
        'rk4'

    Raises:
        ForceGPError: a value is out of range.
        UnknownNameError: unknown method, stabilization or `on_divergence`.
    """

    dt: float | None = None
    method: str = "semi_implicit_euler"
    stabilization: str | Baumgarte = "baumgarte"
    unilateral: bool = False
    interpolation: str = "hold"
    speed_limit: float = 100.0
    torque_noise: bool = True
    on_divergence: str = "raise"

    def __post_init__(self) -> None:
        for name in ("dt", "speed_limit"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < float("inf"):
                raise ForceGPError(
                    f"the rollout's {name} is out of range", expected="a positive finite number", got=value
                )
        if self.method not in METHODS:
            raise UnknownNameError("method of integration", self.method, METHODS)
        if self.on_divergence not in ON_DIVERGENCE:
            raise UnknownNameError("on_divergence", self.on_divergence, ON_DIVERGENCE)
        if not isinstance(self.stabilization, Baumgarte) and self.stabilization not in STABILIZATIONS:
            raise UnknownNameError("stabilization", self.stabilization, STABILIZATIONS)

    def stabilized(self, system: ConstrainedSystem) -> ConstrainedSystem:
        """The system with the stabilization terms of the rollout in its right-hand side."""
        terms = self.stabilization if isinstance(self.stabilization, Baumgarte) else None
        if self.stabilization == "baumgarte":
            terms = system.baumgarte or Baumgarte()
        return system if terms == system.baumgarte else dataclasses.replace(system, baumgarte=terms)
