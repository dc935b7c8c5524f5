"""Comparison of predicted and logged trajectories: tip error over time, drift, and coverage of the bands.

The half-widths of the bands can be scaled by split-conformal prediction to reach their nominal coverage.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.data import Dataset
from forcegp.errors import DataError
from forcegp.rollout.forward import RolloutOptions, rollout_model, share_of
from forcegp.rollout.inputs import ForwardModel
from forcegp.rollout.integrate import Progress
from forcegp.rollout.trajectory import Bands, Rollout


def widening(values: Tensor, band: Bands, level: float) -> float:
    """Return the factor by which the half-widths of bands must be scaled to reach a coverage `level`.

    Each trajectory has a score, which is the factor at which a fraction `level` of its values lies inside the
    band. The score follows from the ratios |value − median| / (half-width on that side). The result is the
    ⌈(n + 1) level⌉-th smallest of n scores. For a further trajectory that is exchangeable with these, at
    least a fraction `level` of the values lies inside the scaled band with probability `level` or more,
    whether or not the model is correct (Lei, G'Sell, Rinaldo, Tibshirani, Wasserman, *Distribution-free
    predictive inference for regression*, JASA 113, 2018, section 2.2).

    Args:
        values: observed values of n trajectories, `(n, …)`. Missing values are NaN.
        band: the band for each value.
        level: nominal coverage, between 0 and 1.

    Returns:
        The factor, which is infinite if there are too few trajectories (a level of 0.9 requires at least 9)
        or too few samples of the model.

    Example:
        >>> bands = Bands(torch.tensor([-1.0]), torch.tensor([1.0]), torch.tensor([0.0]))
        >>> widening(torch.tensor([[0.5], [-3.0], [2.0]]), bands, 0.5)
        2.0
    """
    error = values - band.median
    half = torch.where(error < 0.0, band.median - band.lower, band.upper - band.median)
    ratios = (error.abs() / half).nan_to_num(torch.inf).flatten(1).sort(dim=1).values
    scores = ratios[:, math.ceil(ratios.shape[1] * level) - 1].sort().values
    rank = math.ceil((len(scores) + 1) * level)
    return float(scores[rank - 1]) if rank <= len(scores) else math.inf


HORIZONS = (0.5, 1.0, 2.0, 5.0, 10.0)
"""Times after the start at which tip errors are reported [s]."""
LEVEL = 0.9
"""Default fraction of the samples that lie inside a band."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Open-loop predictions of several models from the same logged states under the logged torques.

    Attributes:
        system: the robot and the contacts of the log.
        frame, point: the frame of the tip, and the coordinates of the tip in that frame.
        t: time since the start, `(T,)` [s].
        q: logged joint positions, `(k, T, nq)`.
        multiplier: logged multipliers, `(k, T, n_contacts)` [N], or `None`.
        predicted: rollouts with batch shape `(k,)`, keyed by model.
    """

    system: ConstrainedSystem
    frame: str
    point: Sequence[float]
    t: Tensor
    q: Tensor
    multiplier: Tensor | None
    predicted: Mapping[str, Rollout]

    @property
    def tip(self) -> Tensor:
        """Logged position of the tip in the world, `(k, T, 3)` [m]."""
        return kinematics.point_position(self.system.robot, self.q, self.frame, tuple(self.point))

    def predicted_tip(self, model: str) -> Tensor:
        """Return the predicted position of the tip, `(k, T, 3)` [m], which is NaN after a divergence."""
        return self._whole(self.predicted[model].tip(self.frame, self.point))

    def sampled_tip(self, model: str) -> Tensor:
        """Return the position of the tip in each function sample, `(S, k, T, 3)` [m]."""
        return self._whole(self.predicted[model].need_samples().tip(self.frame, self.point))

    def tip_error(self, model: str) -> Tensor:
        """Return the distance between the predicted and logged tip, `(k, T)` [m], ∞ after a divergence."""
        return (self.predicted_tip(model) - self.tip).norm(dim=-1).nan_to_num(torch.inf)

    def error_at(self, model: str, horizon: float) -> float:
        """Return the tip error after `horizon` seconds, as the median over all starts [m].

        Raises:
            DataError: the comparison ends earlier.
        """
        if horizon > float(self.t[-1]) * (1.0 + 1e-9):
            raise DataError(
                "the comparison ends before this time", expected=f"{horizon} s", got=float(self.t[-1])
            )
        step = int((self.t - horizon).abs().argmin())
        return float(self.tip_error(model)[:, step].median())

    def coverage(self, model: str, level: float = LEVEL, inflation: float = 1.0) -> float:
        """Return the fraction of tip coordinates inside the band, excluding the initial coordinates.

        The band contains a fraction `level` of the samples. Its half-widths are multiplied by `inflation`. On
        a surface, only tangential coordinates are counted, since the constraint fixes the normal coordinate.
        """
        logged, band = self._tip_along(model, level)
        band = band.widened(inflation)
        inside = (logged >= band.lower) & (logged <= band.upper)
        return float(inside.to(self.q.dtype).mean())

    def inflation(self, model: str, level: float = LEVEL) -> float:
        """Return the factor for bands that cover a fraction `level` of tip coordinates (see `widening`)."""
        return widening(*self._tip_along(model, level), level)

    def _tip_along(self, model: str, level: float) -> tuple[Tensor, Bands]:
        """Return the logged tip coordinates `(k, T − 1, d)`, along any surface, and their predicted bands."""
        along = self._tangents()
        sampled = (self.sampled_tip(model)[..., None, :] @ along)[..., 0, :]
        logged = (self.tip[..., None, :] @ along)[..., 0, :]
        return logged[:, 1:], self.predicted[model].bands(sampled[:, :, 1:], level)

    def _tangents(self) -> Tensor:
        """Return two orthonormal surface tangents at the logged tip, `(k, T, 3, 2)`, or all three axes."""
        contact = _tip_contact(self.system)
        if contact is None or contact.frame != self.frame:
            return torch.eye(3, dtype=self.q.dtype).expand(*self.q.shape[:-1], 3, 3)
        normal = contact.surface.gradient(self.tip)
        return torch.linalg.svd(normal[..., None, :]).Vh.mT[..., 1:]

    def _whole(self, values: Tensor) -> Tensor:
        """Extend values to the full duration, with NaN after all trajectories have diverged."""
        missing = len(self.t) - values.shape[-2]
        return torch.nn.functional.pad(values, (0, 0, 0, missing), value=torch.nan)


def _tip_contact(system: ConstrainedSystem) -> SurfaceContact | None:
    return next((c for c in system.contacts if isinstance(c, SurfaceContact)), None)


def tip_of(system: ConstrainedSystem) -> tuple[str, Sequence[float]]:
    """Return the frame and point of the first surface contact, or the origin of the last frame."""
    contact = _tip_contact(system)
    return (contact.frame, contact.point) if contact else (system.robot.frame_names[-1], (0.0, 0.0, 0.0))


def compare(
    models: Mapping[str, ForwardModel],
    data: Dataset,
    duration: float,
    starts: int | Tensor = 1,
    samples: int = 0,
    *,
    system: ConstrainedSystem | None = None,
    options: RolloutOptions | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Simulate models in open loop from logged states under the logged torques.

    Args:
        models: fitted models, keyed by name.
        data: a log in time order.
        duration: duration of each trajectory [s].
        starts: number of evenly spaced starts, or the row numbers of the starts.
        samples: number of function samples for models that support them.
        system: the robot and the contacts of the log. The default is the system of the first model.
        options: options for the rollouts. By default, diverged rollouts are kept up to their divergence.
        progress: a function called during the rollouts.

    Raises:
        DataError: the log is too short or not in time order.
    """
    system = system or next(iter(models.values())).system
    dt = _period(data)
    steps = round(duration / dt)
    first = _starts(data, steps, starts)
    rows = first[:, None] + torch.arange(steps + 1)
    options = options or RolloutOptions(on_divergence="keep")
    options = dataclasses.replace(options, dt=options.dt or dt)
    start, predicted = (data.q[first], data.qd[first], data.tau[rows]), {}
    active = data.active(system.contact_names)[first]
    for i, (name, model) in enumerate(models.items()):
        drawn, report = samples if model.has_function_samples else 0, share_of(progress, i, len(models))
        predicted[name] = rollout_model(
            model, *start, duration, drawn, active=active, options=options, progress=report
        )
    return _beside(system, data, rows, dt, predicted)


def beside_log(name: str, predicted: Rollout, log: Dataset, dt: float) -> Comparison:
    """Compare a log with a rollout from its first row. Both have the period dt [s]."""
    rows = torch.arange(len(log))[None]
    return _beside(predicted.system, log, rows, dt, {name: predicted[None]})


def _beside(
    system: ConstrainedSystem, data: Dataset, rows: Tensor, dt: float, predicted: Mapping[str, Rollout]
) -> Comparison:
    frame, point = tip_of(system)
    logged = data.contact_extras.get("multiplier", {})
    complete = bool(system.contacts) and all(name in logged for name in system.contact_names)
    multiplier = torch.stack([logged[c][rows] for c in system.contact_names], -1) if complete else None
    t = torch.arange(rows.shape[1], dtype=data.dtype) * dt
    return Comparison(system, frame, point, t, data.q[rows], multiplier, predicted)


def _period(data: Dataset) -> float:
    return data.header.dt or float((data.t[1:] - data.t[:-1]).median())


def _starts(data: Dataset, steps: int, starts: int | Tensor) -> Tensor:
    """Return the given or evenly spaced start rows `(count,)`. Each is followed by at least `steps` rows."""
    count = starts if isinstance(starts, int) else len(starts)
    fits = torch.arange(max(len(data) - steps, 0))
    fits = fits[data.segment[fits] == data.segment[fits + steps]]
    sound = len(fits) >= count if isinstance(starts, int) else bool(torch.isin(starts, fits).all())
    if not sound or not data.header.ordered:
        raise DataError(
            "the log is too short for the rollouts, or not in time order",
            expected=f"{count} starts with {steps} further samples in the same trajectory",
            got=f"{len(data)} samples, {len(fits)} such starts",
            hint="use a shorter duration, or the log before selection",
        )
    if not isinstance(starts, int):
        return starts
    return fits[torch.linspace(0, len(fits) - 1, count).round().long()]
