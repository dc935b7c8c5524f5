"""Figure 2: the constraint error in simulation, and the multiplier predicted from accelerations."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from forcegp.data import Dataset
from forcegp.models.structured_gp import StructuredGP
from forcegp.report.data import MultiplierBand, MultiplierData, series

BAND = 2.0
"""Standard deviations on either side."""


@torch.no_grad()
def predicted_multiplier(
    models: Mapping[str, StructuredGP], data: Dataset, c: Tensor, held_out: Tensor
) -> MultiplierData:
    """The first contact's multiplier by several models, conditioned on accelerations alone (eq. 25).

    Args:
        models: fitted models by name.
        data: the states, in order of time, with the simulator's multiplier.
        c: `(n,)` constraint error of that contact [m].
        held_out: `(n,)` bool, samples in stretches without training points.
    """
    first = next(iter(models.values()))
    contact = first.system.contact_names[0]
    simulated = data.contact_extras["multiplier"][contact]
    return MultiplierData(
        t=series(data.t),
        c=series(c),
        simulated=series(simulated),
        held_out=spans(data.t, held_out),
        bands=[_band(name, model, data, simulated, held_out) for name, model in models.items()],
    )


def _band(
    name: str, model: StructuredGP, data: Dataset, simulated: Tensor, held_out: Tensor
) -> MultiplierBand:
    active = data.active(model.system.contact_names)
    predicted = model.predict(data.q, data.qd, data.tau, "multiplier", active=active)
    assert predicted.std is not None and model.training is not None
    mean, std = predicted.mean[:, 0], predicted.std[:, 0]
    error = (mean - simulated).abs()
    inside = error <= BAND * std
    return MultiplierBand(
        model=name,
        training_points=sum(len(m.values) for m in model.training.measurements),
        mean=series(mean),
        std=series(std),
        inside=float(inside.double().mean()),
        inside_held_out=float(inside[held_out].double().mean()) if bool(held_out.any()) else None,
        mean_error=float(error.mean()),
        smallest=float(mean.min()),
    )


def spans(t: Tensor, marked: Tensor) -> list[tuple[float, float]]:
    """The times at which runs of marked samples begin and end."""
    edges = torch.diff(marked.int(), prepend=marked.new_zeros(1).int(), append=marked.new_zeros(1).int())
    begins, ends = (edges == 1).nonzero()[:, 0], (edges == -1).nonzero()[:, 0] - 1
    return [(float(t[i]), float(t[j])) for i, j in zip(begins, ends, strict=True)]
