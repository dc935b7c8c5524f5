"""What a structured Gaussian process keeps of its training data."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset, farthest_points, standardized
from forcegp.errors import ModelError
from forcegp.forces.measurements import NoiseStd, Observation, measurement_of
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.projection import Measurement
from forcegp.forces.states import states
from forcegp.gp.standardization import Standardization


@dataclass(frozen=True)
class Training:
    """What a fitted model keeps of its training data.

    Attributes:
        measurements: the values conditioned on.
        noise_std: of each measurement, as given `(d,)`.
        scales: standardization of each prior's inputs.
    """

    measurements: tuple[Measurement, ...]
    noise_std: tuple[Tensor, ...]
    scales: tuple[Standardization, ...]

    @property
    def samples(self) -> int:
        """Number of samples in all measurements."""
        return sum(len(m.q) for m in self.measurements)

    def thinned(self, samples: int) -> Training:
        """About so many samples: the farthest points among the distinct states of each measurement."""
        share = samples / self.samples
        thin = tuple(m[_spread(m, math.ceil(share * len(m.q)))] for m in self.measurements)
        return dataclasses.replace(self, measurements=thin)


def _spread(m: Measurement, count: int) -> Tensor:
    """Rows of distinct states that are far from each other, at most `count`."""
    x = standardized(torch.cat([m.q, m.qd, m.tau], dim=-1))
    return farthest_points(x, min(count, len(x.unique(dim=0))))


def training_of(
    data: Dataset | Sequence[Observation],
    system: ConstrainedSystem,
    priors: Sequence[ForcePrior],
    noise_std: NoiseStd,
    before: Training | None,
    learn: Sequence[str],
) -> Training:
    """Measurements with their noise and input scales; priors that are not learned keep earlier scales.

    Raises:
        ModelError, DataError: there are no data, or they do not fit the system.
    """
    observations = [Observation(data)] if isinstance(data, Dataset) else list(data)
    if not observations:
        raise ModelError("there is nothing to learn from", expected="at least one observation", got="none")
    pairs = [measurement_of(o, system, noise_std) for o in observations]
    at = [states(system, m.q, m.qd, m.tau, m.active) for m, _ in pairs]
    scales = []
    for p, prior in enumerate(priors):
        if prior.name not in learn and before is not None:
            scales.append(before.scales[p])
            continue
        features = [prior.features(system, a) for a in at]
        scales.append(Standardization.of({k: torch.cat([f[k] for f in features]) for k in features[0]}))
    return Training(tuple(m for m, _ in pairs), tuple(std for _, std in pairs), tuple(scales))
