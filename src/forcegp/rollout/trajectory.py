"""The result of a rollout: trajectories, drift, multipliers, contacts, and bands over the samples."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError, NumericalError, ParameterError, check_name
from forcegp.rollout.events import ContactEvent

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from forcegp.plots import Target

FIELDS = ("q", "qd", "qdd", "tau", "multiplier", "c", "cd", "active")
"""Attributes of a rollout with batch dimensions."""
JOINT_QUANTITIES = ("q", "qd", "qdd", "tau")
QUANTITIES = (*JOINT_QUANTITIES, "multiplier", "c", "cd")


class Divergence(NamedTuple):
    """A trajectory that was dropped because it diverged.

    Attributes:
        t: time of the last valid state [s].
        row: index of the trajectory in the flattened batch.
        q, qd: the state at that time.
        reason: the reason why the next state was rejected.
    """

    t: float
    row: int
    q: list[float]
    qd: list[float]
    reason: str


class DivergedError(NumericalError):
    """Raised if a trajectory of a rollout diverged. The attribute `rollout` contains the result."""

    def __init__(self, diverged: Sequence[Divergence], rows: int, rollout: Rollout) -> None:
        self.rollout = rollout
        first = diverged[0]
        super().__init__(
            f"{len(diverged)} of {rows} trajectories diverge, the first at t = {first.t:.4f} s",
            expected="finite states and joint speeds below the speed limit",
            got=f"{first.reason}, after q = {first.q}, qd = {first.qd}",
            hint="a smaller step, another stabilization, or on_divergence='keep'; the error's `rollout` "
            "holds what was computed",
        )


class Bands(NamedTuple):
    """Pointwise quantiles over samples.

    Attributes:
        lower, upper: the bounds of the central band.
        median: the median of the samples.
    """

    lower: Tensor
    upper: Tensor
    median: Tensor

    def widened(self, inflation: float) -> Bands:
        """Return the band with its half-widths scaled by a factor."""
        lower = self.median + inflation * (self.lower - self.median)
        return Bands(lower, self.median + inflation * (self.upper - self.median), self.median)


@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """Trajectories from a batch of initial states at T times, with NaN after a divergence.

    Attributes:
        system: the robot and its contacts, with the stabilization of the rollout.
        t: time, `(T,)` [s].
        q, qd, qdd, tau: positions, velocities, accelerations and motor torques, `(*batch, T, nq)`.
        multiplier: λ, `(*batch, T, m)` [N], which is NaN if the model does not predict forces.
        c, cd: constraint errors and their rates for open and closed contacts, `(*batch, T, m)` [m], [m/s].
        active: mask of closed contacts, `(*batch, T, n_contacts)`.
        events: the events at which contacts opened or closed.
        diverged: trajectories that were dropped.
        samples: the trajectories of function samples, with batch shape `(S, *batch)`.
    """

    system: ConstrainedSystem
    t: Tensor
    q: Tensor
    qd: Tensor
    qdd: Tensor
    tau: Tensor
    multiplier: Tensor
    c: Tensor
    cd: Tensor
    active: Tensor
    events: Sequence[ContactEvent] = ()
    diverged: Sequence[Divergence] = ()
    samples: Rollout | None = None

    def __repr__(self) -> str:
        """Return a one-line summary of duration, batch, samples and events, without values."""
        n = self.rows
        what = "one trajectory" if n == 1 else f"{n} trajectories"
        span = float(self.t[-1] - self.t[0]) if len(self.t) else 0.0
        more = [f"{self.samples.q.shape[0]} function samples"] if self.samples is not None else []
        more += [f"{len(self.events)} contact events"] if self.events else []
        more += [f"{len(self.diverged)} diverged"] if self.diverged else []
        robot = self.system.robot.name
        return f"<Rollout of {robot!r}: {', '.join([f'{what} of {span:.4g} s', *more])}>"

    def plot(
        self,
        quantity: str = "q",
        *,
        log: Dataset | None = None,
        joints: Sequence[str] | None = None,
        ax: Target = None,
    ) -> list[Axes]:
        """Plot the predicted motion over time, with bands of ±2 standard deviations over function samples.

        Args:
            quantity: `q`, `qd`, `qdd`, `tau`, `multiplier`, `c` or `cd`.
            log: the logged motion from the same start, for comparison.
            joints: names of the joints or contacts. By default, all are plotted.
            ax: matplotlib axes to draw on, one per panel. By default, a new figure is created.

        Raises:
            UnknownNameError: the quantity or joint does not exist.
            ParameterError: there are several trajectories (select one, as in `rollout[0].plot()`), or the
                number of axes is wrong.
        """
        from forcegp.plots import MEASURED, PREDICTED, Curve, Panel, Timeline, axis_label, chosen, draw_panels

        check_name("quantity of a rollout", quantity, QUANTITIES)
        if self.rows != 1:
            raise ParameterError(
                "several trajectories cannot be plotted together",
                expected="one trajectory",
                got=self.rows,
                hint="choose one, such as rollout[0].plot()",
            )
        robot = self.system.robot
        of_joints = quantity in JOINT_QUANTITIES
        names = robot.joint_names if of_joints else self.system.row_names
        values = getattr(self, quantity).reshape(len(self.t), -1)
        std = _spread(self, quantity)
        logged = None if log is None else _logged(self, log, quantity)
        panels = []
        for i in chosen(joints, names, f"component of {quantity}"):
            curves = [] if logged is None else [Curve(logged[:, i], "logged", MEASURED)]
            curves.append(Curve(values[:, i], "predicted", PREDICTED, None if std is None else std[:, i]))
            kinds = robot.joint_types[i : i + 1] if of_joints else ()
            panels.append(Panel(names[i], axis_label(quantity, kinds), curves))
        active = self.active.reshape(len(self.t), -1)
        return draw_panels(panels, Timeline.of(self.t), list(active.unbind(-1)), ax)

    @property
    def batch(self) -> torch.Size:
        """Batch shape."""
        return self.q.shape[:-2]

    @property
    def rows(self) -> int:
        """Number of trajectories."""
        return self.batch.numel()

    @property
    def drift(self) -> Tensor:
        """Constraint error c(q), `(*batch, T, m)` [m], which is set to 0 for open contacts."""
        rows = self.system.active_rows(self.active, self.active.shape[:-1])
        return torch.where(rows, self.c, 0.0)

    def tip(self, frame: str, point: Sequence[float] = (0.0, 0.0, 0.0)) -> Tensor:
        """Return the world position of a point in a frame, `(*batch, T, 3)` [m], NaN after a divergence."""
        return kinematics.point_position(self.system.robot, self.q, frame, tuple(point))

    def bands(self, values: Tensor, level: float = 0.9) -> Bands:
        """Return the central band of a quantity over function samples.

        Args:
            values: values `(S, …)` such as `rollout.samples.multiplier`. NaN in diverged samples is ignored.
            level: fraction of the samples inside the band, between 0 and 1.
        """
        tail = 0.5 * (1.0 - level)
        quantiles = torch.tensor([tail, 1.0 - tail, 0.5], dtype=values.dtype, device=values.device)
        return Bands(*torch.nanquantile(values, quantiles, dim=0))

    def need_samples(self) -> Rollout:
        """Return the sampled trajectories.

        Raises:
            ModelError: the rollout has no samples.
        """
        if self.samples is None:
            raise ModelError("the rollout has no samples", hint="pass samples=100 to rollout")
        return self.samples

    def contact_lost(self) -> Tensor:
        """Return the fraction of samples in which each contact has opened by each time.

        The result has shape `(*batch, T, n_contacts)`.

        Raises:
            ModelError: the rollout has no samples.
        """
        lost = (~self.need_samples().active).cumsum(-2) > 0
        return lost.to(self.q.dtype).mean(0)

    def __getitem__(self, index: object) -> Rollout:
        """Return the trajectories of the selected batch members. Events keep their row in the full batch."""
        chosen = {name: getattr(self, name)[index] for name in FIELDS}
        places = index if isinstance(index, tuple) else (index,)
        samples = None if self.samples is None else self.samples[(slice(None), *places)]
        return dataclasses.replace(self, **chosen, samples=samples)


def _spread(path: Rollout, quantity: str) -> Tensor | None:
    """Return the standard deviation `(T, d)` over finite function samples, or `None` without samples."""
    if path.samples is None:
        return None
    values = getattr(path.samples, quantity).reshape(-1, len(path.t), getattr(path, quantity).shape[-1])
    finite = values.isfinite()
    count = finite.sum(0)
    mean = values.nan_to_num(0.0).sum(0) / count
    return ((values - mean).nan_to_num(0.0).square().sum(0) / (count - 1).clamp(min=1)).sqrt()


def _logged(path: Rollout, log: Dataset, quantity: str) -> Tensor | None:
    """Return the logged values `(T, d)` at the times of the rollout, or `None` if they are not logged."""
    if len(log) < len(path.t):
        raise ParameterError(
            "the log is shorter than the rollout", expected=f"{len(path.t)} rows or more", got=len(log)
        )
    if quantity in JOINT_QUANTITIES:
        return getattr(log.select(path.system.robot.joint_names), quantity)[: len(path.t)]
    columns = [log.contact_extras.get(quantity, {}).get(name) for name in path.system.contact_names]
    present = [column[: len(path.t), None] for column in columns if column is not None]
    return torch.cat(present, dim=-1) if len(present) == len(path.system.row_names) > 0 else None
