"""Measured quantities at states, converted from the columns of a log and used to condition a posterior.

In contact, A q̈ = b. If a measurement violates this equation by far more than the usual noise, because of an
impact or an incorrect contact flag, the contact does not persist and the acceleration is unusable.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from forcegp import dynamics
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset, farthest_points, standardized
from forcegp.data.fields import UNKNOWN, check_robot, contact_table, in_time
from forcegp.data.selection import outliers
from forcegp.errors import DataError, ModelError, UnknownNameError
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.memory import DISTANCES, LONGEST_STEP, PAST, bristles
from forcegp.forces.quantities import QUANTITIES, States, states
from forcegp.gp.features import Standardization
from forcegp.robust import MAD_TO_STD

KEPT = 4000
"""Maximum number of samples whose equations of motion are kept."""


@dataclass(frozen=True)
class Measurement:
    """Values of one quantity at states.

    Attributes:
        quantity: name of the quantity, as in `QUANTITIES`.
        q, qd, tau: `(n, nq)` positions, velocities and motor torques.
        active: `(n, n_contacts)` bool, closed contacts.
        values: `(n, d)` measured values.
        segment: `(n,)` trajectory number of each sample; by default, there is one trajectory.
        t: `(n,)` time of each sample [s]; zero by default.
        recording: `(n,)` number of the recording of each sample; unknown by default.
        tau_std: `(n, nq)` additional standard deviation of each torque [N m, N]; `None` for zero.
        history: `(n, nq, k)` states of bristles, if a prior depends on the past and the log is in time order.
        qdd: accelerations `(n, nq)` in columns of the inertia; the measured ones by default.
    """

    quantity: str
    q: Tensor
    qd: Tensor
    tau: Tensor
    active: Tensor
    values: Tensor
    segment: Tensor = None  # pyright: ignore[reportAssignmentType]  # filled in below
    t: Tensor = None  # pyright: ignore[reportAssignmentType]  # filled in below
    recording: Tensor = None  # pyright: ignore[reportAssignmentType]  # filled in below
    tau_std: Tensor | None = None
    history: Tensor | None = None
    qdd: Tensor | None = None

    def __post_init__(self) -> None:
        if self.segment is None:
            zero = torch.zeros(self.q.shape[:1], dtype=torch.int64, device=self.q.device)
            object.__setattr__(self, "segment", zero)
        if self.t is None:
            object.__setattr__(self, "t", torch.zeros_like(self.q[:, 0]))
        if self.recording is None:
            object.__setattr__(self, "recording", torch.full_like(self.segment, UNKNOWN))

    def __getstate__(self) -> dict[str, object]:
        """Return the fields without the equations of motion that are kept, which other processes compute."""
        return {name: value for name, value in self.__dict__.items() if name != "_kept"}

    @property
    def states(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return q, q̇, τ and the flags of closed contacts."""
        return self.q, self.qd, self.tau, self.active

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """Return q, q̇, τ, the flags of closed contacts, and the measured values."""
        return (*self.states, self.values)

    def at(self, system: ConstrainedSystem) -> States:
        """Return the states with their equations of motion and, if available, the measured accelerations.

        Those of at most `KEPT` samples are kept for the next call, since learning needs them many times.
        """
        kept = self.__dict__.get("_kept")
        if kept is not None and kept[0] is system:
            return kept[1]
        qdd = self.values if self.quantity == "qdd" and self.qdd is None else self.qdd
        at = states(system, *self.states, qdd=qdd, recording=self.recording[:, None])
        at = at if self.history is None else dataclasses.replace(at, history=self.history)
        if len(self.q) <= KEPT:
            object.__setattr__(self, "_kept", (system, at))
        return at

    @property
    def digests(self) -> Tensor:
        """Return a hash of each sample `(n,)`."""
        x = torch.cat([part.double() for part in self.tensors], dim=-1).contiguous().view(torch.int64)
        odd = torch.randint(2**62, x.shape[-1:], generator=torch.Generator().manual_seed(0)).to(x) * 2 + 1
        return ((x ^ (x >> 32)) * odd).sum(-1)

    def __getitem__(self, rows: Tensor) -> Measurement:
        """Return the values at the given rows."""
        parts = (part[rows] for part in (*self.tensors, self.segment, self.t, self.recording))
        more = (None if part is None else part[rows] for part in (self.tau_std, self.history, self.qdd))
        return Measurement(self.quantity, *parts, *more)


@dataclass(frozen=True)
class Training:
    """The data that a posterior is conditioned on.

    Attributes:
        measurements: the measured quantities.
        noise_std: standard deviation of each measurement, `(d,)` or `(n, d)`.
        scales: standardization of the inputs of each prior.
        part_of: total number of samples to condition on if these are only part of them; otherwise 0.
        period: sampling period of the log [s]; 0 if its rows are not in time order.
        filter_span: time span of the filter that computed the accelerations [s]; 0 if unknown.
        filter_variance: variance of the weights of this filter over time [s²], as in `DataHeader`.
        weights: weights `(n,)` for each measurement, which divide the noise variances; `None` for 1.
        slopes: slopes G = dz/d(q, q̇) `(n, d, 2 nq)` of each measurement under the learned forces (`None` for
            quantities that have none); if `None`, those of the robot file are used (`forces/noise.py`).
    """

    measurements: tuple[Measurement, ...]
    noise_std: tuple[Tensor, ...]
    scales: tuple[Standardization, ...]
    part_of: int = 0
    period: float = 0.0
    filter_span: float = 0.0
    filter_variance: float = 0.0
    weights: tuple[Tensor, ...] | None = None
    slopes: tuple[Tensor | None, ...] | None = None

    @property
    def samples(self) -> int:
        """Return the total number of samples in all measurements."""
        return sum(len(m.q) for m in self.measurements)

    @property
    def all_samples(self) -> int:
        """Return the total number of samples to condition on."""
        return self.part_of or self.samples

    def pieces(self, samples: int) -> Iterator[Training]:
        """Yield pieces of about `samples` samples, each with the same fraction of every measurement."""
        count = max(1, math.ceil(self.samples / samples))
        parts = [torch.arange(len(m.q), device=m.q.device).tensor_split(count) for m in self.measurements]
        yield from (self.of_rows(rows) for rows in zip(*parts, strict=True))

    @property
    def quantities(self) -> tuple[str, ...]:
        """Return the names of the measured quantities."""
        return tuple(m.quantity for m in self.measurements)

    @property
    def motions(self) -> list[int]:
        """Indices of measured accelerations, and of joint forces computed with a force sensor."""
        return [i for i, quantity in enumerate(self.quantities) if quantity in ("qdd", "joint_force")]

    @property
    def free_motions(self) -> int:
        """Return the largest number of accelerations in free motion in any one measurement."""
        free = [int((~m.active.any(-1)).sum()) for m in self.measurements if m.quantity == "qdd"]
        return max(free, default=0)

    @property
    def digests(self) -> Tensor:
        """Return the hashes of the samples of all measurements."""
        return torch.cat([m.digests for m in self.measurements])

    def never_closed(self, system: ConstrainedSystem) -> tuple[str, ...]:
        """Return the names of the contacts that are never closed."""
        closed = torch.stack([m.active.any(0) for m in self.measurements]).any(0).tolist()
        return tuple(name for name, seen in zip(system.contact_names, closed, strict=True) if not seen)

    def thinned(self, samples: int) -> Training:
        """Select about `samples` samples by farthest-point sampling of the states of each measurement."""
        share = samples / self.samples
        return self.of_rows([_spread(m, math.ceil(share * len(m.q))) for m in self.measurements])

    def evenly(self, samples: int) -> Training:
        """Select at most `samples` evenly spaced samples."""
        step = max(1, math.ceil(self.samples / samples))
        return self.of_rows([torch.arange(0, len(m.q), step, device=m.q.device) for m in self.measurements])

    def without(self, measurement: int, rows: Tensor) -> Training:
        """Remove the given rows of one measurement."""
        kept = [torch.ones(len(m.q), dtype=torch.bool, device=m.q.device) for m in self.measurements]
        kept[measurement][rows] = False
        return self.of_rows([mask.nonzero()[:, 0] for mask in kept])

    def of_rows(self, rows: Sequence[Tensor]) -> Training:
        """Return the given rows of each measurement."""
        return dataclasses.replace(
            self,
            part_of=0,
            measurements=tuple(m[index] for m, index in zip(self.measurements, rows, strict=True)),
            noise_std=tuple(
                std[i] if std.ndim == 2 else std for std, i in zip(self.noise_std, rows, strict=True)
            ),
            weights=self.weights and tuple(w[i] for w, i in zip(self.weights, rows, strict=True)),
            slopes=self.slopes
            and tuple(None if G is None else G[i] for G, i in zip(self.slopes, rows, strict=True)),
        )

    def joined(self, more: Training, noise_std: Sequence[Tensor]) -> Training:
        """Add other measurements, with their noise and slopes."""
        weights, slopes = tuple(torch.ones_like(m.t) for m in more.measurements), more.slopes or ()
        return dataclasses.replace(
            self,
            measurements=(*self.measurements, *more.measurements),
            noise_std=(*self.noise_std, *noise_std),
            weights=self.weights and (*self.weights, *weights),
            slopes=self.slopes and (*self.slopes, *slopes),
        )

    def moving(self, speed: float) -> Training:
        """Return the samples at which at least one joint moves faster than the given speed [rad/s, m/s]."""
        fast = [(m.qd.abs().amax(-1) > speed).nonzero()[:, 0] for m in self.measurements]
        return self.of_rows(fast)


def _spread(m: Measurement, count: int) -> Tensor:
    """Return at most `count` rows with distinct states that are far apart."""
    x = standardized(torch.cat([m.q, m.qd, m.tau], dim=-1))
    return farthest_points(x, min(count, len(x.unique(dim=0))))


def without_outliers(observations: Sequence[Observation]) -> tuple[list[Observation], int]:
    """Remove samples with an impossible value; return the others and the number of samples removed."""
    bad = [outliers(o.data.q, o.data.qd, o.data.tau, o.data.qdd) for o in observations]
    pairs = zip(observations, bad, strict=True)
    kept = [o.rows((~out).nonzero()[:, 0]) if bool(out.any()) else o for o, out in pairs]
    return kept, sum(int(out.sum()) for out in bad)


def excluded(dropped: int) -> tuple[str, ...]:
    """Return a warning about a number of outliers, if there are any."""
    text = f"excluded {dropped} outlier{'s' * (dropped > 1)}: samples with an impossible value"
    return (f"{text} (`forcegp check` names other spikes)",) if dropped else ()


IMPACT_STDS = 6.0
"""Number of robust standard deviations of A q̈ − b above which a sample is not in persistent contact."""


def without_impacts(training: Training, system: ConstrainedSystem) -> tuple[Training, int]:
    """Remove samples with impacts; return the others and the number of samples removed.

    Args:
        training: measurements; only accelerations are checked.
    """
    if not system.m:
        return training, 0
    kept = []
    for m, std in zip(training.measurements, training.noise_std, strict=True):
        every = torch.ones(len(m.q), dtype=torch.bool, device=m.q.device)
        good = _persists(system, m, std) if m.quantity == "qdd" else every
        kept.append(good.nonzero()[:, 0])
    dropped = sum(len(m.q) - len(rows) for m, rows in zip(training.measurements, kept, strict=True))
    return (training.of_rows(kept), dropped) if dropped else (training, 0)


def _persists(system: ConstrainedSystem, m: Measurement, std: Tensor) -> Tensor:
    """Return a mask `(n,)` of the samples for which |A q̈ − b| is in the usual range; true in free motion."""
    eom = system.equations(m.q, m.qd, m.active)
    violation = (eom.A @ m.values[..., None])[..., 0] - eom.b
    noise = (eom.A.square() @ std.expand_as(m.values)[..., None].square())[..., 0].sqrt()
    closed = noise > 0.0
    ratio = torch.where(closed, violation.abs() / torch.where(closed, noise, 1.0), 0.0)
    good = torch.ones(len(m.q), dtype=torch.bool, device=m.q.device)
    for row in range(ratio.shape[-1]):
        in_contact = closed[:, row]
        if bool(in_contact.any()):
            scale = max(1.0, MAD_TO_STD * float(ratio[in_contact, row].median()))
            good &= ratio[:, row] <= IMPACT_STDS * scale
    return good


MODELLED, FEWEST_IN_CONTACT = 0.02, 20
"""Share of the torque of each joint to which a modelled torque equals the inverse dynamics, as in `forcegp
check`; minimum number of samples in contact for this comparison. Measured torques balance friction too."""


def require_measured(training: Training, system: ConstrainedSystem) -> None:
    """Check that the torques in contact are not the inverse dynamics of the robot file.

    In contact, M q̈ − Q_C − Q_G − Q_D − τ = Aᵀλ + Q_z contains the contact force and friction.

    Raises:
        DataError: the torques are those of a model, with which every contact force would be zero.
    """
    for m in training.measurements:
        rows = m.active.any(-1).nonzero()[:, 0]
        if m.quantity != "qdd" or len(rows) < FEWEST_IN_CONTACT:
            continue
        rows = rows[:: max(1, len(rows) // 400)]
        q, qd, qdd, tau = (x[rows] for x in (m.q, m.qd, m.values, m.tau))
        needed = dynamics.inverse_dynamics(system.robot, q, qd, qdd) - dynamics.damping_force(
            system.robot, qd
        )
        rest, size = ((x.square().mean(0)).sqrt() for x in (needed - tau, tau))
        if bool((rest <= MODELLED * size).all()):
            raise DataError(
                f"the torques in contact are the inverse dynamics of {system.robot.name!r} to within "
                f"{100.0 * MODELLED:.0f} %: the output of a model, which does not contain the contact force",
                expected="measured torques, or motor currents",
                hint="map the column with the measurement, and see `forcegp check`",
            )


NoiseStd = float | Sequence[float] | Tensor
DEFAULT_NOISE_STD = 0.1
"""Acceleration noise used if neither the caller nor the log specifies it, as in the paper [rad/s², m/s²]."""


def plain(noise: NoiseStd | str | None) -> Any:
    """Return a noise specification as JSON-compatible values."""
    if noise is None or isinstance(noise, str):
        return noise
    values = torch.as_tensor(noise, dtype=torch.float64).tolist()
    return tuple(values) if isinstance(values, list) else values


@dataclass(frozen=True)
class Observation:
    """A data set that provides measurements of one quantity.

    Args:
        data: states, contacts and measured values.
        quantity: the measured quantity: `qdd` (in contact or free), `multiplier`, `contact_force`,
            `constraint_force`, `joint_force`, `contact_friction` or `total_force`.
        noise_std: standard deviation of the measurement, as one number, one per component, or `(n, d)`. For
            `qdd`, it defaults to the value in the model, then to `qdd_std` in the log, then to the header.

    Example:
        >>> import forcegp, torch
        >>> system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
        >>> q, qd, tau = torch.randn(3, 20, 2, dtype=torch.float64)
        >>> qdd = forcegp.dynamics.forward_dynamics(system.robot, q, qd, tau - 0.5 * qd)
        >>> t = torch.arange(20, dtype=torch.float64)
        >>> data = forcegp.Dataset(t, q, qd, tau, qdd, system.robot.joint_names)
        >>> Observation(data, "qdd", noise_std=0.1).quantity
        'qdd'
    """

    data: Dataset
    quantity: str = "qdd"
    noise_std: NoiseStd | None = None

    def rows(self, index: Tensor) -> Observation:
        """Return the samples with the given indices, with the noise of each if it is known."""
        noise = self.noise_std
        if isinstance(noise, Tensor) and noise.ndim == 2 and len(noise) == len(self.data):
            noise = noise[index]
        return dataclasses.replace(self, data=self.data[index], noise_std=noise)


def observations_of(data: Dataset | Sequence[Observation]) -> Sequence[Observation]:
    """Return the given measurements in time order, or those of the accelerations of a data set.

    Held-out blocks, instruments and friction with memory follow from neighbours in time. The order of rows
    therefore has no effect on a fit.

    Raises:
        ModelError: there are no measurements, or the argument has the wrong type.
    """
    observations = [Observation(data)] if isinstance(data, Dataset) else data
    if not isinstance(observations, Sequence) or not all(isinstance(o, Observation) for o in observations):
        raise ModelError(
            "cannot learn from this type of data",
            expected="a Dataset, or a list of Observation",
            got=type(data).__name__,
        )
    if not observations:
        raise ModelError(
            "there are no samples to learn from", expected="at least one observation", got="none"
        )
    return [o if o.data.header.ordered else _in_time_order(o) for o in observations]


def _in_time_order(observation: Observation) -> Observation:
    ordered = observation.rows(in_time(observation.data.t, observation.data.segment))
    return dataclasses.replace(ordered, data=ordered.data.in_time_order())


def states_noise(observations: Sequence[Observation]) -> bool:
    """Return whether the data specify the noise of their accelerations."""
    return all(
        o.noise_std is not None or o.data.header.noise_std is not None or "qdd_std" in o.data.extras
        for o in observations
    )


@torch.no_grad()
def unmeasured_forces(system: ConstrainedSystem, observations: Sequence[Observation]) -> dict[str, float]:
    """Return the size of the unknown force on each joint without a logged torque, keyed by name [N m, N].

    The size is the RMS of Q̄ − Q_C − Q_G, where Q̄ is the measured joint force. If only accelerations are
    measured, Q̄ = M q̈, which includes the contact force and is therefore an upper limit. A measured contact
    force F with noise Σ is subtracted: Q̄ = M q̈ − J_EᵀF, with the variance diag J_EᵀΣ J_E. The smallest of
    several limits is returned.
    """
    sizes: dict[str, float] = {}
    for observation in (o for o in observations if o.data.header.unmeasured_torques):
        data, active = observation.data, contact_table(observation.data, system.contact_names)
        eom = system.equations(data.q, data.qd, active)
        moved, added = (eom.M @ data.qdd[..., None])[..., 0], torch.zeros_like(data.q)
        if observation.quantity == "joint_force":
            moved = measurement_of(observation, system)[0].values
        if observation.quantity == "contact_force":
            m, std = measurement_of(observation, system)
            J = torch.cat([eom.contact_points[name].jacobian for name in system.contact_names], dim=-2)
            moved = moved - (J.mT @ m.values[..., None])[..., 0]
            added = (J.square().mT @ std.square().expand_as(m.values)[..., None])[..., 0]
        rms = ((moved - eom.Q_C - eom.Q_G).square() + added).mean(0).sqrt().tolist()
        for joint in data.header.unmeasured_torques:
            sizes[joint] = min(rms[data.joint_names.index(joint)], sizes.get(joint, math.inf))
    return sizes


def _by_contact(name: str) -> Callable[[Dataset, ConstrainedSystem], Tensor]:
    def values(data: Dataset, system: ConstrainedSystem) -> Tensor:
        logged = data.contact_extras.get(name, {})
        for contact in system.contact_names:
            if contact not in logged:
                raise UnknownNameError(f"contact with a logged {name}", contact, logged)
            sticks = system.contact(contact).rows > 1
            if name == "multiplier" and sticks and logged[contact].ndim == 1:
                raise ModelError(
                    f"contact {contact!r} may stick, and only its normal force is logged",
                    expected="three components",
                    got="one",
                    hint='observe "contact_force", with a large noise_std for the unmeasured components',
                )
        columns = [logged[contact] for contact in system.contact_names]
        return torch.cat([x[:, None] if x.ndim == 1 else x for x in columns], dim=-1)

    return values


COLUMNS: Mapping[str, Callable[[Dataset, ConstrainedSystem], Tensor]] = {
    "qdd": lambda data, _: data.qdd,
    "multiplier": _by_contact("multiplier"),
    "contact_force": _by_contact("F_I"),
    "constraint_force": lambda data, _: data.Q_I,
    "joint_force": lambda data, _: data.Q,
    "contact_friction": lambda data, _: data.Q_z,
    "total_force": lambda data, _: data.Q + data.Q_z,
}
"""Function that returns the columns of each measurable quantity."""


def measurement_of(
    observation: Observation, system: ConstrainedSystem, default_noise: NoiseStd | None = None
) -> tuple[Measurement, Tensor]:
    """Return the measurement of an observation, and its noise `(d,)` or `(n, d)`.

    Raises:
        UnknownNameError: the quantity cannot be measured, or a contact is not logged.
        ModelError: the noise is not positive, or it is missing for a quantity other than qdd.
        DataError: the joints in the data differ from those of the robot.
    """
    data, quantity = observation.data, observation.quantity
    if quantity not in QUANTITIES or quantity not in COLUMNS:
        raise UnknownNameError("measured quantity", quantity, COLUMNS)
    check_robot(data, system.robot)
    active = contact_table(data, system.contact_names)
    if not len(data.q):
        raise ModelError("there are no samples to learn from", expected="at least one sample", got="none")
    values = COLUMNS[quantity](data, system)
    std = _checked_noise(_noise_of(observation, default_noise), quantity, values)
    state = data.q, data.qd, data.tau, active
    stated = data.extras.get("tau_std")
    return Measurement(quantity, *state, values, data.segment, data.t, data.recording, stated), std


def _noise_of(observation: Observation, default: NoiseStd | None) -> NoiseStd:
    """Return the noise from the observation, the model, the log (`qdd_std`) or the header, in that order."""
    data = observation.data
    if observation.noise_std is not None:
        return observation.noise_std
    if observation.quantity != "qdd":
        raise ModelError(
            f"the noise of {observation.quantity!r} is unknown",
            hint=f"pass Observation(data, {observation.quantity!r}, noise_std=…) in the quantity's unit",
        )
    stated = (default, data.extras.get("qdd_std"), data.header.noise_std)
    return next((noise for noise in stated if noise is not None), DEFAULT_NOISE_STD)


def _checked_noise(noise: NoiseStd, quantity: str, values: Tensor) -> Tensor:
    """Return the noise as a tensor `(d,)` or `(n, d)`, after checking it."""
    if isinstance(noise, float) and 0.0 < noise < math.inf:
        return values.new_full(values.shape[-1:], noise)
    try:
        std = torch.as_tensor(noise, dtype=values.dtype, device=values.device)
    except (TypeError, ValueError, RuntimeError) as cause:
        raise ModelError("a noise standard deviation is a number, or one per component", got=noise) from cause
    if std.shape not in ((), (1,), values.shape[-1:], values.shape):
        raise ModelError(
            f"the noise of {quantity!r} does not match its components",
            expected=f"one number, {values.shape[-1]}, or {tuple(values.shape)}",
            got=f"shape {tuple(std.shape)}",
        )
    if not bool(((std > 0.0) & (std < math.inf)).all()):
        raise ModelError("a noise standard deviation must be positive and finite", got=noise)
    return std.clone() if std.ndim == 2 else std.expand(values.shape[-1]).clone()


def training_of(
    data: Dataset | Sequence[Observation],
    system: ConstrainedSystem,
    priors: Sequence[ForcePrior],
    noise_std: NoiseStd | None,
    kept: Mapping[str, Standardization],
) -> Training:
    """Return the measurements with their noise and input scales.

    Args:
        noise_std: standard deviation of accelerations that do not specify their noise.
        kept: existing scales to keep, keyed by prior name.

    Raises:
        ModelError, DataError: there are no data, or they do not match the system.
    """
    observations = observations_of(data)
    pairs = [measurement_of(o, system, noise_std) for o in observations]
    measurements = (m for m, _ in pairs)
    if any(prior.remembers for prior in priors):
        measurements = (
            with_history(m, o.data, system) for (m, _), o in zip(pairs, observations, strict=True)
        )
    training = Training(
        measurements=tuple(measurements),
        noise_std=tuple(std for _, std in pairs),
        scales=(),
        period=period_of(observations[0].data),
        filter_span=max(o.data.header.filter_span or 0.0 for o in observations),
        filter_variance=max(o.data.header.filter_variance for o in observations),
    )
    return scaled(training, system, priors, kept)


def with_history(m: Measurement, data: Dataset, system: ConstrainedSystem) -> Measurement:
    """Return the measurement with the states of bristles along its log, if they can be followed."""
    known = [data.extras[f"{PAST}{k}"] for k in range(2 * len(DISTANCES)) if f"{PAST}{k}" in data.extras]
    if known:
        return dataclasses.replace(m, history=torch.stack(known, dim=-1))
    period = period_of(data)
    if not 0.0 < period <= LONGEST_STEP:
        return m
    return dataclasses.replace(m, history=bristles(m.t, system.robot.drive_motion(m.qd), m.segment))


def scaled(
    training: Training,
    system: ConstrainedSystem,
    priors: Sequence[ForcePrior],
    kept: Mapping[str, Standardization],
) -> Training:
    """Return the training data with input scales for given priors; see `training_of` for the arguments."""
    new = [prior for prior in priors if prior.name not in kept]
    at = [m.at(system) for m in training.measurements] if new else []
    scales = dict(kept)
    for prior, features in [(prior, [prior.features(system, a) for a in at]) for prior in new]:
        together = {k: torch.cat([f[k] for f in features]) for k in features[0]}
        scale = Standardization.of(together, prior.vectors, prior.centred)
        scales[prior.name] = scale if prior.scaled else Standardization.none(together)
    return dataclasses.replace(training, scales=tuple(scales[prior.name] for prior in priors))


def period_of(data: Dataset) -> float:
    """Return the median time step within the trajectories of a log [s]; 0 if it is not in time order."""
    if not data.header.ordered or len(data.t) < 2:
        return 0.0
    steps = data.t.diff()[data.segment[1:] == data.segment[:-1]]
    return float(steps.median()) if len(steps) else 0.0
