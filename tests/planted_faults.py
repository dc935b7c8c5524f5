"""Logs in order, and faults planted in them with the rows at which a check must find them."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import forcegp
from forcegp import dynamics
from forcegp.checks import Finding, Log, Report
from forcegp.checks.log import derive
from forcegp.constraints import ConstrainedSystem, Plane, SurfaceContact
from forcegp.data import DataHeader
from forcegp.errors import RobotFileWarning
from forcegp.rows import intervals

REAL = Path(__file__).parents[1] / "../shared/real"
Case = tuple[ConstrainedSystem, Log]
Rows = tuple[int, int] | None


def free_log(robot: forcegp.RobotModel, seconds: float = 20.0, seed: int = 0, noise: float = 0.1) -> Log:
    """Free motion along sums of sines with the torque that it needs, and white noise on the acceleration."""
    random, dt = np.random.default_rng(seed), 1.0 / 240.0
    t = np.arange(round(seconds / dt)) * dt
    low, high = (np.nan_to_num(x.numpy(), posinf=2.0, neginf=-2.0) for x in (robot.lower, robot.upper))
    q = np.tile((low + high) / 2.0, (len(t), 1))
    qd, qdd = np.zeros_like(q), np.zeros_like(q)
    for k in range(1, 6):
        w, size = 0.2 * np.pi * k, random.normal(size=robot.nq) * 0.25 / k**0.5
        angle = w * t[:, None] + random.uniform(0.0, 2.0 * np.pi, robot.nq)
        q, qd, qdd = (
            q + size * np.sin(angle),
            qd + size * w * np.cos(angle),
            qdd - size * w * w * np.sin(angle),
        )
    state = [torch.from_numpy(x) for x in (q, qd, qdd)]
    tau = dynamics.inverse_dynamics(robot, *state) - dynamics.damping_force(robot, state[1])
    return Log(
        t=t,
        q=q,
        qd=qd,
        qdd=qdd + noise * random.normal(size=q.shape),
        tau=tau.numpy(),
        segment=np.zeros(len(t), np.int64),
        contact={},
        joint_names=robot.joint_names,
        header=DataHeader(dt=dt, noise_std=noise),
    )


def real_iiwa(motion: str = "b") -> Case:
    """The published log of a real iiwa, with the sign of its torque changed to ours."""
    folder = REAL / "kuka_iiwa14" / f"motion_{motion}"
    t = np.loadtxt(folder / "cur_traj_time_s.txt")
    names = ("position", "velocity", "acceleration", "torque")
    q, qd, qdd, tau = (np.loadtxt(folder / f"joint_{name}_measured.txt") for name in names)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RobotFileWarning)
        robot = forcegp.load_robot(REAL / "kuka_iiwa14/iiwa14.urdf")
    segment = np.cumsum(np.concatenate([[0], np.diff(t) <= 0.0])).astype(np.int64)
    log = Log(t, q, qd, qdd, -tau, segment, {}, robot.joint_names, DataHeader())
    return ConstrainedSystem(robot, []), log


MOVED = (
    ("0.031887199591513114", str(0.031887199591513114 - 0.5234602302310271 * 0.2**2)),
    ("0.05086984812807257", str(0.05086984812807257 - 0.6255677234174437 * 0.25569305436052964**2)),
)
"""The published file gives each inertia about the joint where URDF asks for the centre of mass: I − m r²."""


def real_pendulum(folder: Path, run: int = 0, mended: bool = True) -> Case:
    """A published log of a real double pendulum; `folder` takes its robot file, mended if wanted."""
    source = REAL / "double_pendulum/design_C.1"
    text = (source / "model_1.1.urdf").read_text()
    start = text.index('<joint name="base_weld"')
    text = text[:start] + text[text.index("</joint>", start) + 8 :]
    for about_joint, about_centre in MOVED if mended else ():
        text = text.replace(about_joint, about_centre)
    (folder / "pendulum.urdf").write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RobotFileWarning)
        robot = forcegp.load_robot(folder / "pendulum.urdf")
    table = np.genfromtxt(sorted(source.glob("*.csv"))[run], delimiter=",", names=True)
    q, qd, tau = (
        np.stack([table[f"{name}{k}"] for k in (1, 2)], axis=1)
        for name in ("pos_meas", "vel_meas", "tau_meas")
    )
    segment = np.zeros(len(q), np.int64)
    log = Log(
        table["time"], q, qd, np.full_like(q, np.nan), tau, segment, {}, robot.joint_names, DataHeader()
    )
    return ConstrainedSystem(robot, []), derive(log, ["qdd"])


@dataclass(frozen=True)
class Fault:
    """A fault, the kind that names it, and how it is planted.

    Attributes:
        name: what is wrong.
        kind: the finding that must come.
        plant: changes system and log; gives the rows of the fault, or `None` for the whole log.
        contact: whether it needs a contact, cannot be planted in one, or neither.
        joint: joint that the finding must list, by index.
        white: whether it needs a log whose header states its white noise.
        amount: its size as the evidence of `faults-hidden` counts it: rad, degrees, s, or a share.
    """

    name: str
    kind: str
    plant: Callable[[ConstrainedSystem, Log], tuple[ConstrainedSystem, Log, Rows]]
    contact: bool | None = None
    joint: int | None = None
    white: bool = False
    amount: float = 0.0


def _change(
    **changes: Callable[[Log], object],
) -> Callable[[ConstrainedSystem, Log], tuple[ConstrainedSystem, Log, Rows]]:
    """A fault of the whole log."""
    return lambda system, log: (system, log.replace(**{name: f(log) for name, f in changes.items()}), None)


def _moving_rows(log: Log, length: int, j: int | None = None) -> slice:
    """Rows in the middle half of the log where the arm, or joint j, is fastest on average."""
    speed = np.abs(log.qd[:, j]) if j is not None else np.abs(log.qd).max(axis=1)
    # All of a stretch, so that a mean over a window does not reach across a gap.
    inner = np.convolve(speed, np.ones(length), mode="valid")
    inner[: len(log) // 4] = inner[3 * len(log) // 4 :] = 0.0
    same = log.segment[: len(inner)] == log.segment[length - 1 : length - 1 + len(inner)]
    start = int(np.argmax(np.where(same, inner, 0.0)))
    return slice(start, start + length)


def joint(log: Log, j: int) -> int:
    """Index of the joint that stands for joint j of a longer arm."""
    return min(j, log.nq - 1)


def _in_rows(column: str, j: int | None, length: int, change: Callable[[np.ndarray], object]) -> Callable:
    """A fault of one column, or of all joints, in some rows."""

    def plant(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
        at = j if j is None else joint(log, j)
        rows = _moving_rows(log, length, at)
        value = getattr(log, column).copy()
        where = rows if at is None else (rows, at)
        value[where] = change(value[where])
        return system, log.replace(**{column: value}), (rows.start, rows.stop)

    return plant


def _sign(log: Log, *joints: int) -> np.ndarray:
    sign = np.ones(log.nq)
    sign[[joint(log, j) for j in joints]] = -1.0
    return sign


def _joint(log: Log, j: int, value: float, other: float = 0.0) -> np.ndarray:
    vector = np.full(log.nq, other)
    vector[joint(log, j)] = value
    return vector


def _swap(log: Log, i: int, j: int) -> list[int]:
    order = list(range(log.nq))
    i, j = (i, j) if j < log.nq else (0, 1)
    order[i], order[j] = j, i
    return order


def _backward(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    k, t = len(log) // 2, log.t.copy()
    t[k] = t[k - 1] - 2.0 * log.dt
    return system, log.replace(t=t), (k, k + 1)


def _repeated(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    k, t = len(log) // 2, log.t.copy()
    t[k] = t[k - 1]
    return system, log.replace(t=t), (k, k + 1)


def _keep(log: Log, keep: np.ndarray) -> Log:
    columns = {name: getattr(log, name)[keep] for name in ("t", "q", "qd", "qdd", "tau", "segment")}
    return log.replace(**columns, contact={name: value[keep] for name, value in log.contact.items()})


def _gap(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    k, keep = len(log) // 2, np.ones(len(log), bool)
    keep[k : k + 12] = False
    return system, _keep(log, keep), (k, k + 1)


def _late_velocity(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    qd, j, width = log.qd.copy(), joint(log, 2), round(0.2 / log.dt)
    qd[:, j] = np.convolve(np.pad(qd[:, j], (width - 1, 0), "edge"), np.ones(width) / width, "valid")
    return system, log.replace(qd=qd), None


def _missing_rows(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    """Rows are lost and the clock does not know: the position jumps."""
    rows = _moving_rows(log, 40)
    keep = np.ones(len(log), bool)
    keep[rows] = False
    lost = _keep(log, keep)
    return (
        system,
        lost.replace(t=log.t[: len(lost)], segment=log.segment[: len(lost)]),
        (rows.start, rows.start + 1),
    )


def _jitter(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    random = np.random.default_rng(0)
    return system, log.replace(t=log.t + 0.15 * log.dt * random.uniform(-1.0, 1.0, len(log))), None


def _held(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    rows = _moving_rows(log, 8)
    columns = {}
    for name in ("q", "qd", "qdd", "tau"):
        value = getattr(log, name).copy()
        value[rows] = value[rows.start]
        columns[name] = value
    return system, log.replace(**columns), (rows.start + 1, rows.stop)


def _saturated(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    tau = log.tau.copy()
    limit = np.percentile(np.abs(tau[:, 1]), 97)
    tau[:, 1] = np.clip(tau[:, 1], -limit, limit)
    return system, log.replace(tau=tau), None


def _robot(change: Callable[[forcegp.RobotModel], forcegp.RobotModel]) -> Callable:
    """A fault of the robot file: the log is that of the right robot."""
    return lambda system, log: (system.with_robot(change(system.robot)), log, None)


def _gravity(*vector: float) -> Callable:
    return _robot(lambda robot: dataclasses.replace(robot, gravity=torch.tensor(vector, dtype=torch.float64)))


def _tilted(robot: forcegp.RobotModel) -> forcegp.RobotModel:
    a = np.radians(6.0)
    turn = torch.tensor([[np.cos(a), 0.0, np.sin(a)], [0.0, 1.0, 0.0], [-np.sin(a), 0.0, np.cos(a)]])
    return dataclasses.replace(robot, gravity=turn.double() @ robot.gravity)


def _lighter(kilograms: float) -> Callable:
    def change(robot: forcegp.RobotModel) -> forcegp.RobotModel:
        mass = robot.mass.clone()
        mass[-1] -= kilograms
        return dataclasses.replace(robot, mass=mass)

    return _robot(change)


def _wrong_masses(robot: forcegp.RobotModel) -> forcegp.RobotModel:
    factor = torch.tensor([(0.6, 1.5)[k % 2] for k in range(robot.nq)], dtype=torch.float64)
    return dataclasses.replace(robot, mass=robot.mass * factor, inertia=robot.inertia * factor[:, None, None])


def _without_gravity(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    gravity = dynamics.gravity_force(system.robot, torch.from_numpy(log.q)).numpy()
    return system, log.replace(tau=log.tau + gravity), None


def _without_model(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    """What free motion then needs is the friction of the joints."""
    friction = -dynamics.damping_force(system.robot, torch.from_numpy(log.qd)).numpy()
    return system, log.replace(tau=friction), None


def _still(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    """A joint that is held, with the torque that the rest of the motion then needs."""
    columns = {name: getattr(log, name).copy() for name in ("q", "qd", "qdd")}
    columns["q"][:, 1] = log.q[0, 1]
    columns["qd"][:, 1] = 0.0
    columns["qdd"][:, 1] = 0.1 * np.random.default_rng(0).normal(size=len(log))
    state = [torch.from_numpy(columns[name]) for name in ("q", "qd", "qdd")]
    tau = dynamics.inverse_dynamics(system.robot, *state) - dynamics.damping_force(system.robot, state[1])
    return system, log.replace(**columns, tau=tau.numpy()), None


def _filtered(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    from scipy.signal import butter, sosfiltfilt

    return system, log.replace(qdd=sosfiltfilt(butter(4, 0.12, output="sos"), log.qdd, axis=0)), None


def _surface(change: Callable[[Plane], Plane]) -> Callable:
    def plant(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
        contacts = [
            dataclasses.replace(c, surface=change(c.surface)) if isinstance(c, SurfaceContact) else c
            for c in system.contacts
        ]
        return dataclasses.replace(system, contacts=contacts), log, None

    return plant


def _tilt_surface(plane: Plane) -> Plane:
    """The plane turned by 1° about the world's y axis through its point below x = 0.5 m."""
    a, n = np.radians(1.0), np.array(plane.normal)
    center = np.array([0.5, 0.0, (plane.offset - 0.5 * n[0]) / n[2]])
    normal = np.array([np.cos(a) * n[0] + np.sin(a) * n[2], n[1], np.cos(a) * n[2] - np.sin(a) * n[0]])
    return Plane(tuple(normal), float(normal @ center))


def _label(which: str, seconds: float) -> Callable:
    """Labels that start too early, end too late, or are missing over a whole interval."""

    def plant(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
        name = next(iter(log.contact))
        label, k = log.contact[name].copy(), round(seconds / log.dt)
        # A tip that bounces touches for a few rows at a time; the fault is planted at a lasting contact.
        start, stop = next(span for span in intervals(label) if span[0] > 2 * k and span[1] - span[0] > 3 * k)
        rows = {
            "early": slice(start - k, start),
            "late": slice(stop, stop + k),
            "far": slice(start - 2 * k, start - k),
            "missed": slice(start + k, start + 3 * k),
        }[which]
        label[rows] = which != "missed"
        return system, log.replace(contact={**log.contact, name: label}), (rows.start, rows.stop)

    return plant


def _one_line(system: ConstrainedSystem, log: Log) -> tuple[ConstrainedSystem, Log, Rows]:
    """Only the longest straight stretch of sliding is left of the log."""
    name, contact = next(iter(log.contact)), system.contacts[0]
    assert isinstance(contact, forcegp.SurfaceContact)
    velocity = forcegp.kinematics.point_velocity(
        system.robot,
        torch.from_numpy(log.q),
        torch.from_numpy(log.qd),
        contact.frame,
        contact.point,
    ).numpy()
    still = ~log.contact[name] | (np.linalg.norm(velocity, axis=1) < 0.02)
    edges = np.flatnonzero(np.concatenate([[True], still, [True]]))
    k = int(np.argmax(np.diff(edges)))
    label = np.zeros(len(log), bool)
    label[edges[k] : edges[k + 1] - 1] = True
    keep = label | ~log.contact[name]
    return system, _keep(log, keep), None


def serious(report: Report) -> set[str]:
    """Kinds of the warnings and errors of a report, alternatives among them."""
    return {kind for finding in report.findings if finding.severity != "note" for kind in finding.kinds}


def found(fault: Fault, report: Report, log: Log, rows: Rows) -> bool:
    """Whether a report holds the fault: its kind, its joint, and half of its rows with few others.

    A finding that names the fault as one of its alternatives holds it.
    """
    return is_named(fault, report, log, rows) or any(
        _is(fault, other, log, rows) for finding in report.findings for other in finding.alternatives
    )


def is_named(fault: Fault, report: Report, log: Log, rows: Rows) -> bool:
    """Whether a finding is the fault, not one of its alternatives."""
    return any(_is(fault, finding, log, rows) for finding in report.findings)


def _is(fault: Fault, finding: Finding, log: Log, rows: Rows) -> bool:
    if finding.kind != fault.kind:
        return False
    if (
        fault.joint is not None
        and finding.joints
        and log.joint_names[joint(log, fault.joint)] not in finding.joints
    ):
        return False
    if rows is None:
        return True
    common = sum(max(0, min(rows[1], b) - max(rows[0], a)) for a, b in finding.intervals)
    return common >= 0.5 * (rows[1] - rows[0]) and common >= 0.3 * finding.rows


DEG = 180.0 / np.pi
FAULTS = (
    Fault("a step back in time", "time-backward", _backward),
    Fault("a repeated time stamp", "time-repeated", _repeated),
    Fault("12 samples missing", "time-gap", _gap),
    Fault("a clock that jitters by 15 % of its period", "time-jitter", _jitter),
    Fault("milliseconds", "time-unit", _change(t=lambda log: 1e3 * log.t)),
    Fault("a clock 20 % too fast", "time-scale", _change(t=lambda log: 1.2 * log.t)),
    Fault("NaN in a velocity for 5 rows", "not-finite", _in_rows("qd", 2, 5, lambda x: np.nan * x)),
    Fault("8 rows held", "rows-held", _held),
    Fault(
        "an encoder that stands still for 60 rows",
        "channel-stuck",
        _in_rows("q", 3, 60, lambda x: x[0]),
        joint=3,
    ),
    Fault("a torque that clips at its 97th percentile", "torque-saturated", _saturated, joint=1),
    Fault("a spike of the encoder by 0.3 rad", "spike", _in_rows("q", 3, 1, lambda x: x + 0.3)),
    Fault("a spike of the torque by 60 N m", "spike", _in_rows("tau", 1, 1, lambda x: x + 60.0)),
    Fault("40 rows lost that the clock hides", "position-jump", _missing_rows),
    Fault(
        "degrees",
        "degrees",
        _change(q=lambda g: DEG * g.q, qd=lambda g: DEG * g.qd, qdd=lambda g: DEG * g.qdd),
    ),
    Fault("positions alone in degrees", "degrees", _change(q=lambda log: DEG * log.q)),
    Fault("velocities alone in degrees", "degrees", _change(qd=lambda log: DEG * log.qd)),
    Fault("a velocity of the wrong sign", "velocity-sign", _change(qd=lambda g: g.qd * _sign(g, 3)), joint=3),
    Fault("velocities exchanged", "velocity-order", _change(qd=lambda g: g.qd[:, _swap(g, 1, 3)]), joint=1),
    Fault("a velocity filtered over 0.2 s", "velocity-delay", _late_velocity, joint=2),
    Fault("velocities of another run", "velocity-mismatch", _change(qd=lambda g: g.qd[::-1].copy())),
    Fault("accelerations 30 % too large", "acceleration-mismatch", _change(qdd=lambda g: 1.3 * g.qdd)),
    Fault("torque of the wrong sign", "torque-sign", _change(tau=lambda g: -g.tau)),
    Fault("one torque of the wrong sign", "torque-sign", _change(tau=lambda g: g.tau * _sign(g, 3)), joint=3),
    Fault(
        "a torque 60 % too large",
        "torque-gain",
        _change(tau=lambda g: g.tau * _joint(g, 3, 1.6, 1.0)),
        joint=3,
        amount=0.6,
    ),
    Fault(
        "current, at 14 to 6 N m/A",
        "torque-current",
        _change(tau=lambda g: g.tau / np.linspace(14.0, 6.0, g.nq)),
    ),
    Fault(
        "a torque offset of 3 N m", "torque-offset", _change(tau=lambda g: g.tau + _joint(g, 3, 3.0)), joint=3
    ),
    Fault(
        "a torque 40 ms late",
        "torque-delay",
        _change(tau=lambda g: np.roll(g.tau, round(0.04 / g.dt), axis=0)),
        amount=0.04,
    ),
    Fault(
        "a torque of one joint 60 ms late",
        "torque-delay",
        _change(tau=lambda g: np.where(_joint(g, 1, 1.0), np.roll(g.tau, round(0.06 / g.dt), axis=0), g.tau)),
        joint=1,
        amount=0.06,
    ),
    Fault("torque less gravity", "torque-without-gravity", _without_gravity),
    Fault("torque less the model", "torque-without-model", _without_model, contact=False),
    Fault("torques exchanged", "torque-order", _change(tau=lambda g: g.tau[:, _swap(g, 1, 3)]), joint=1),
    Fault("no torque", "torque-zero", _change(tau=lambda g: 0.0 * g.tau)),
    Fault(
        "joints exchanged",
        "joint-order",
        _change(**{n: lambda g, n=n: getattr(g, n)[:, _swap(g, 1, 3)] for n in ("q", "qd", "qdd", "tau")}),
        joint=1,
    ),
    Fault(
        "a joint that turns the other way",
        "joint-sign",
        _change(**{n: lambda g, n=n: getattr(g, n) * _sign(g, 3) for n in ("q", "qd", "qdd", "tau")}),
        joint=3,
    ),
    Fault(
        "an encoder off by 0.1 rad",
        "encoder-offset",
        _change(q=lambda g: g.q + _joint(g, 3, 0.1)),
        joint=3,
        amount=0.1,
    ),
    Fault("gravity the wrong way round", "gravity-direction", _gravity(0.0, 0.0, 9.81)),
    Fault("gravity along x", "gravity-direction", _gravity(9.81, 0.0, 0.0)),
    Fault("a base tilted by 6°", "base-tilted", _robot(_tilted), amount=6.0),
    Fault(
        "undeclared friction of 3 N m",
        "friction-undeclared",
        _change(tau=lambda g: g.tau + _joint(g, 3, 3.0) * np.tanh(g.qd / 0.01)),
        joint=3,
    ),
    Fault("masses × 0.6 and × 1.5", "masses-mismatch", _robot(_wrong_masses), amount=0.45),
    Fault("a tool of 1.5 kg missing", "payload-missing", _lighter(1.5)),
    Fault(
        "a push of 120 rows, 20 to 0.3 N m",
        "disturbance",
        _in_rows("tau", None, 120, lambda x: x + np.linspace(20.0, 0.3, x.shape[1])),
    ),
    Fault("a joint held", "joint-still", _still, contact=False, joint=1),
    Fault(
        "noise stated 5 times too small",
        "noise-understated",
        _change(header=lambda g: g.header.model_copy(update={"noise_std": 0.02})),
        white=True,
    ),
    Fault(
        "noise stated 5 times too large",
        "noise-overstated",
        _change(header=lambda g: g.header.model_copy(update={"noise_std": 0.5})),
        white=True,
    ),
    Fault("data filtered at 0.12 of Nyquist, stated as white", "noise-filtered", _filtered, white=True),
    Fault(
        "a header that states 10 ms",
        "period-header",
        _change(header=lambda g: g.header.model_copy(update={"dt": 0.01})),
    ),
    Fault("no contact column", "contact-unlabelled", _change(contact=lambda g: {}), contact=True),
    Fault(
        "a surface 3 mm too high",
        "surface-offset",
        _surface(lambda p: Plane(p.normal, p.offset + 3e-3)),
        contact=True,
    ),
    Fault("a surface tilted by 1°", "surface-tilted", _surface(_tilt_surface), contact=True),
    Fault(
        "a surface 5 cm too high",
        "contact-far",
        _surface(lambda p: Plane(p.normal, p.offset + 0.05)),
        contact=True,
    ),
    Fault(
        "a normal into the solid",
        "contact-pulls",
        _surface(lambda p: Plane(tuple(-x for x in p.normal), -p.offset)),
        contact=True,
    ),
    Fault("contact labelled 0.1 s too early", "contact-early", _label("early", 0.1), contact=True),
    Fault("contact labelled 0.1 s too long", "contact-late", _label("late", 0.1), contact=True),
    Fault("contact labelled in the air for 0.2 s", "contact-far", _label("far", 0.2), contact=True),
    Fault("contact not labelled for 0.4 s", "contact-missed", _label("missed", 0.2), contact=True),
    Fault("sliding along one line", "force-directions", _one_line, contact=True),
)
"""Every planted fault."""
