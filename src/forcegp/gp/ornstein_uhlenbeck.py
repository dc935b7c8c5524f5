"""A process in time, independent between trajectories."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.gp.features import FeatureMap, Features, fourier_features, points
from forcegp.gp.kernels import LARGEST_EXPONENT, Initial, Kernel, Parameters

TIME, SEGMENT = "time", "segment"
"""Names of its inputs: time [s], and the number of the trajectory, each `(n, 1)`."""


@dataclass(frozen=True)
class OrnsteinUhlenbeck(Kernel):
    """k = σ² exp(−|t − t′|/T) within a trajectory, and 0 between trajectories (Rasmussen and Williams, eq.
    B.28).

    Args:
        time: initial value of T [s].

    Example:
        >>> import torch
        >>> kernel = OrnsteinUhlenbeck(time=2.0)
        >>> x = {"time": torch.tensor([[0.0], [2.0], [2.0]]), "segment": torch.tensor([[0.0], [0.0], [1.0]])}
        >>> kernel.covariance(kernel.initial(1, {}), x, x)[0, 0].tolist()
        [1.0, 0.36787944117144233, 0.0]

    Raises:
        ModelError: the time is not positive.
    """

    time: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 < self.time < float("inf"):
            raise ModelError(
                "a correlation time must be positive", expected="a positive finite time [s]", got=self.time
            )

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        return {
            "log_time": torch.full((outputs,), math.log(self.time), dtype=torch.float64),
            "log_std": torch.zeros(outputs, dtype=torch.float64) + log_std,
        }

    def towards(self, params: Parameters, x2: Features) -> Callable[[Features], Tensor]:
        rate = torch.exp(-params["log_time"])[:, None, None]
        variance = torch.exp(2.0 * params["log_std"])[:, None, None]

        def covariance(x1: Features) -> Tensor:
            interval = (x1[TIME] - x2[TIME].mT).abs()
            same_segment = x1[SEGMENT] == x2[SEGMENT].mT
            decay = torch.exp(-(interval * rate).clamp(max=LARGEST_EXPONENT))
            return variance * torch.where(same_segment, decay, 0.0)

        return covariance

    def variance(self, params: Parameters) -> Callable[[Features], Tensor]:
        variance = torch.exp(2.0 * params["log_std"])[:, None]
        return lambda x: variance.expand(-1, points(x))

    def draw(self, params: Parameters, x: Features, features: int, generator: torch.Generator) -> FeatureMap:
        # The spectral density is a Cauchy density. Over uniform frequencies u, the mean of cos(u(s − s′)) is
        # zero for whole numbers s ≠ s′, so that trajectories are independent.
        rate = torch.exp(-params["log_time"])
        uniform = torch.rand(len(rate), features, 3, dtype=torch.float64, generator=generator).to(rate)
        in_time = torch.tan(math.pi * (uniform[..., 0] - 0.5)) * rate[:, None]
        omega = torch.stack([in_time, 2.0 * math.pi * uniform[..., 1]], dim=-1)
        phase = 2.0 * math.pi * uniform[..., 2]
        return fourier_features((TIME, SEGMENT), omega, phase, params["log_std"].exp())
