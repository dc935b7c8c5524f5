"""Motion of a floating base (`[base]` in a mapping) as that of the six joints of a free base.

With R = R_z(ψ) R_y(θ) R_x(φ) and α = (ψ, θ, φ), the angular velocity in axes of the base is ω = E α̇ with

    E = [[−sin θ, 0, 1], [cos θ sin φ, cos φ, 0], [cos θ cos φ, −sin φ, 0]],

which is singular at θ = ±90°. A gyro with axes R_s in the base reads R_sᵀ ω. An accelerometer at r in the
base reads f = (R R_s)ᵀ (p̈_s − g), or without g if gravity is removed, with p̈_s = p̈ + R (ω̇ × r + ω × ω × r).
Feet at rest determine a base without logged position: ṗ = −d/dt (R r_f) for a foot at r_f in the base.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from forcegp import kinematics
from forcegp.errors import DataError
from forcegp.logs import units
from forcegp.logs.compensated import CHUNK
from forcegp.logs.mapping import BaseSection, Mapping
from forcegp.logs.smoothing import above_zero, filtered
from forcegp.logs.table import Array, ImportReport, Signals
from forcegp.robot import RobotModel
from forcegp.robot.free_base import BASE_JOINTS
from forcegp.rows import describe, numbered

POSITION, ORIENTATION, LINEAR, ANGULAR, IMU, FOOT = (
    f"base {name}" for name in ("position", "orientation", "velocity", "rates", "acceleration", "foot ")
)
"""Names of vectors in `Signals`: (n, 3), quaternions (n, 4) in the order x, y, z, w, and flags (n, 1)."""
UNIT = 0.01
"""Largest deviation of the norm of a quaternion from 1, which rounding to two decimals may cause."""
SINGULAR = 0.1
"""Cosine of the pitch below which rows are dropped: E⁻¹ multiplies errors of ω by up to 1/cos θ."""
QUARTER = 0.5 * np.pi
"""Step of yaw or roll between two rows [rad] that only a passage of the singular pitch explains."""
OFF = 0.5
"""Mean difference between two measurements of p̈, over |g|, of a wrong sensor. A wrong `gravity` yields 1."""


def check_base(robot: RobotModel, mapping: Mapping) -> None:
    """Raise a `MappingError` if the robot has no free base, or if a frame in `[base]` is not usable."""
    section = mapping.sections.base
    if section is None:
        return
    if lacking := [joint for joint in BASE_JOINTS if joint not in robot.joint_names]:
        hint = 'load_robot(…, base="free"), or base = "free" under [robot] in a scene'
        text = f"the robot has no joint {lacking[0]!r} of a free base"
        raise mapping.error(("base",), text, ", ".join(BASE_JOINTS), hint=hint)
    for key, frame in [
        (("base", "imu_frame"), section.imu_frame),
        *((("base", "feet", f), f) for f in section.feet),
    ]:
        if frame is not None and frame not in robot.frame_names:
            raise mapping.error(key, f"{frame!r} is not a frame of the robot", ", ".join(robot.frame_names))
    if section.imu_frame is not None:
        moved = robot.joint_names[robot.frame_parents[robot.frame_index(section.imu_frame)]]
        if moved != BASE_JOINTS[-1]:
            text = f"{section.imu_frame!r} is not fixed to the base"
            raise mapping.error(
                ("base", "imu_frame"), text, "a frame of the base", f"a link moved by {moved!r}"
            )


def columns_of_base(section: BaseSection) -> list[tuple[str, tuple[str, ...], float, str | None]]:
    """Return the name of each logged vector with its columns, its factor to SI units, and its stream."""
    angle = units.QUANTITY["position"][section.angle_unit]
    acceleration = {"m/s2": 1.0, "g": units.FORCE["kgf"]}[section.acceleration_unit]
    vectors = (
        (POSITION, section.position, 1.0, section.stream),
        (ORIENTATION, section.quaternion, 1.0, section.stream),
        (ORIENTATION, section.rpy, angle, section.stream),
        (LINEAR, section.linear_velocity, 1.0, section.stream),
        (ANGULAR, section.angular_velocity, angle, section.stream),
        (ANGULAR, section.gyro, angle, section.imu_stream),
        (IMU, section.accelerometer, acceleration, section.imu_stream),
    )
    return [(name, columns, factor, where) for name, columns, factor, where in vectors if columns is not None]


def orientations(x: Array, section: BaseSection, report: ImportReport) -> Array:
    """Return logged quaternions, or angles [rad], as quaternions (n, 4) in the order x, y, z, w, with norm 1
    and continuous signs.

    Raises:
        DataError: the norm of a quaternion is not 1. The message names the file and the rows.
    """
    known = np.flatnonzero(np.isfinite(x).all(axis=1))
    if section.rpy is not None:
        angles, x = x, np.full((len(x), 4), np.nan)
        x[known] = Rotation.from_euler("xyz", angles[known]).as_quat()
    elif section.quaternion_order == "wxyz":
        x = np.roll(x, -1, axis=1)
    norm = np.linalg.norm(x[known], axis=1)
    if len(wrong := known[np.abs(norm - 1.0) > UNIT]):
        text = f"{report.source}: the quaternion of the base is not a rotation in {describe(numbered(wrong))}"
        got = f"{np.linalg.norm(x[wrong[0]]):.6g}"
        raise DataError(text, expected=f"a norm of 1 within {UNIT:g}", got=got, hint="check the columns")
    x[known] /= norm[:, None]
    turned = np.append(1.0, np.where((x[known[1:]] * x[known[:-1]]).sum(axis=1) < 0.0, -1.0, 1.0))
    x[known] *= np.cumprod(turned)[: len(known), None]
    return x


def place_base(signals: Signals, robot: RobotModel, mapping: Mapping, report: ImportReport) -> None:
    """Convert the vectors of the base to columns of q and q̇, and those of an accelerometer to p̈_s.

    Rows near a pitch of ±90° are dropped, and split their trajectories.

    Raises:
        DataError: the pitch is near ±90°, or no foot is at rest, in all rows.
    """
    section, vectors = mapping.sections.base, signals.vectors
    if section is None:
        return
    slides, turns = _indices(signals)
    B = robot.base_rotation.numpy()
    R = B.T @ Rotation.from_quat(vectors.pop(ORIENTATION)).as_matrix()
    if section.orientation_of == "imu":
        R = R @ _sensor(robot, section)[0].T
    vectors["q"][:, turns] = _angles(R)
    _drop_singular(signals, turns, report)
    for rows in signals.runs():
        vectors["q"][rows, turns] = np.unwrap(vectors["q"][rows, turns], axis=0)
    if section.feet:
        _stand(signals, robot, section, report)
    R = _turn(vectors["q"][:, turns])
    vectors["q"][:, slides] = (vectors.pop(POSITION) - robot.base_position.numpy()) @ B
    if section.linear_velocity or section.angular_velocity or section.gyro:
        vectors.setdefault("qd", np.full_like(vectors["q"], np.nan))
    for name in ("qd", "qdd"):
        if name in vectors:
            vectors[name][:, slides + turns] = np.nan
    if section.linear_velocity is not None:
        v = vectors.pop(LINEAR)
        vectors["qd"][:, slides] = _times(R, v) if section.linear_axes == "body" else v @ B
    if (w := vectors.pop(ANGULAR, None)) is not None:
        if section.gyro is not None:
            w = w @ _sensor(robot, section)[0].T
        elif section.angular_axes == "world":
            w = _times(R.swapaxes(1, 2), w @ B)
        vectors["qd"][:, turns] = _rates(vectors["q"][:, turns], w)
    if section.accelerometer is not None:
        f = _times(R, vectors[IMU] @ _sensor(robot, section)[0].T)
        vectors[IMU] = f + robot.gravity.numpy() @ B if section.gravity else f
    report.steps.append("converted the motion of the base to six joints, whose torques are zero")


def add_imu(
    signals: Signals, std: Array | None, robot: RobotModel, mapping: Mapping, report: ImportReport
) -> Array | None:
    """Replace q̈ of the slides by that of the accelerometer after the filter; return σ of q̈ `(n, nq)`."""
    section, vectors = mapping.sections.base, signals.vectors
    if section is None or IMU not in vectors:
        return std
    assert std is not None, "q̈ of the rotations is computed"
    slides, turns = _indices(signals)
    lengths = [rows.stop - rows.start for rows in signals.runs(*signals.contact.values())]
    piece = np.repeat(np.arange(len(lengths)), lengths)
    measured, noise = filtered(signals.t, vectors.pop(IMU), piece, mapping.sections.derivatives)
    lever = _sensor(robot, section)[1]
    q, qd, qdd = (vectors[name][:, turns] for name in ("q", "qd", "qdd"))
    (w, dw), R = _spin(q, qd, qdd), _turn(q)
    p = measured - _times(R, np.cross(dw, lever) + np.cross(w, np.cross(w, lever)))
    # p̈ = p̈_s − R (E α̈ × r) − …, so the noise of α̈ adds to that of the sensor
    of_turns = R @ np.cross(_rate_matrix(q), lever, axisa=1, axisb=0, axisc=1)
    noise = np.sqrt(noise**2 + _times(of_turns**2, std[:, turns] ** 2))
    off = np.linalg.norm((p - vectors["qdd"][:, slides]).mean(axis=0))
    if off > OFF * float(robot.gravity.norm()) > 0.0:
        text = f"the accelerometer is off the motion of the base by {off:.3g} m/s² on average"
        report.find("accelerometer", f"{text}: check gravity, imu_frame and the orientation under [base]")
    vectors["qdd"][:, slides], std[:, slides] = p, noise
    report.steps.append("took accelerations of the base from the accelerometer, after the same filter")
    return above_zero(std, report)


def _stand(signals: Signals, robot: RobotModel, section: BaseSection, report: ImportReport) -> None:
    """Compute positions of the base (n, 3) from feet at rest, and drop rows without any.

    Between two rows, the base moves by the mean over the feet at rest in both. A trajectory begins at
    x = y = 0, with its feet at a mean height of 0.
    """
    vectors = signals.vectors
    rest = np.column_stack([vectors.pop(f"{FOOT}{frame}") for frame in section.feet]) >= 0.5
    standing = np.asarray(rest.any(axis=1))
    if not standing.any():
        raise DataError("no foot is at rest in any row", expected="a flag of 1 in a column under [base.feet]")
    if not standing.all():
        text = f"{(~standing).sum()} rows without a foot at rest were dropped: the base has no position there"
        report.find("flight", text, signals.row[~standing])
        signals.keep(standing, split=True)
        rest = rest[standing]
    r = _feet(signals, robot, section)
    both = (rest[1:] & rest[:-1]).astype(float)
    alone = (both.sum(axis=1) == 0.0) & (np.diff(signals.segment) == 0)
    signals.segment = signals.segment + np.append(0, np.cumsum(alone))
    step = -(both[..., None] * np.diff(r, axis=0)).sum(axis=1) / np.maximum(both.sum(axis=1), 1.0)[:, None]
    p = np.zeros((len(signals), 3))
    for rows in signals.runs():
        first, last = rows.start, rows.stop
        p[first, 2] = -r[first, rest[first], 2].mean()
        p[first + 1 : last] = p[first] + np.cumsum(step[first : last - 1], axis=0)
    vectors[POSITION] = p
    report.steps.append(f"computed positions of the base from feet at rest: {', '.join(section.feet)}")


def _feet(signals: Signals, robot: RobotModel, section: BaseSection) -> Array:
    """Return positions of the feet relative to the base, in axes of the world (n, feet, 3) [m]."""
    q, frames = signals.vectors["q"].copy(), [robot.frame_index(frame) for frame in section.feet]
    q[:, _indices(signals)[0]] = 0.0
    chunks = []
    for first in range(0, len(q), CHUNK):
        poses = kinematics.link_poses(robot, torch.from_numpy(q[first : first + CHUNK]))
        places = [kinematics.pose_of_frame(robot, poses, frame)[1].numpy() for frame in frames]
        chunks.append(np.stack(places, axis=1))
    return np.concatenate(chunks)


def _drop_singular(signals: Signals, turns: list[int], report: ImportReport) -> None:
    """Drop rows in which the pitch is near ±90°, or is passed between two rows."""
    angles = signals.vectors["q"][:, turns]
    moved = np.abs((np.diff(angles[:, [0, 2]], axis=0) + np.pi) % (2.0 * np.pi) - np.pi)
    passed = (moved > QUARTER).any(axis=1) & (np.diff(signals.segment) == 0)
    near = np.asarray(np.cos(angles[:, 1]) < SINGULAR) | np.append(False, passed)
    if not near.any():
        return
    text = f"the pitch of the base comes near ±90° in {describe(numbered(signals.row[near]))}"
    if near.all():
        got = f"at least {np.degrees(np.abs(angles[:, 1]).min()):.4g}°"
        raise DataError(text, expected=f"|cos(pitch)| of {SINGULAR:g} and more in some rows", got=got)
    report.find("singular", f"{text}, where yaw and roll are singular: these were dropped", signals.row[near])
    signals.keep(~near, split=True)


def _indices(signals: Signals) -> tuple[list[int], list[int]]:
    """Return the columns of the three slides and of the three rotations."""
    columns = [signals.joint_names.index(joint) for joint in BASE_JOINTS]
    return columns[:3], columns[3:]


def _sensor(robot: RobotModel, section: BaseSection) -> tuple[Array, Array]:
    """Return the orientation R_s (3, 3) and the position r (3,) of the IMU in the base [m]."""
    frame = robot.frame_index(section.imu_frame or "")
    R, p = robot.frame_rotation[frame].numpy(), robot.frame_position[frame].numpy()
    turn = Rotation.from_euler("xyz", section.imu_rpy).as_matrix()
    return R @ turn, p + R @ np.array(section.imu_position)


def _times(R: Array, x: Array) -> Array:
    """Return the products R x of matrices (n, 3, 3) and vectors (n, 3)."""
    return (R @ x[..., None])[..., 0]


def _angles(R: Array) -> Array:
    """Return yaw, pitch and roll (n, 3) of rotations (n, 3, 3), with a pitch within ±90° [rad]."""
    pitch = np.arctan2(-R[:, 2, 0], np.hypot(R[:, 0, 0], R[:, 1, 0]))
    return np.stack([np.arctan2(R[:, 1, 0], R[:, 0, 0]), pitch, np.arctan2(R[:, 2, 1], R[:, 2, 2])], axis=1)


def _turn(angles: Array) -> Array:
    """Return R (n, 3, 3)."""
    return Rotation.from_euler("ZYX", angles).as_matrix()


def _rates(angles: Array, w: Array) -> Array:
    """Return E⁻¹ ω, the rates of yaw, pitch and roll (n, 3) [rad/s], from ω (n, 3) in axes of the base."""
    _, pitch, roll = angles.T
    about = w[:, 1] * np.sin(roll) + w[:, 2] * np.cos(roll)
    across = w[:, 1] * np.cos(roll) - w[:, 2] * np.sin(roll)
    return np.stack([about / np.cos(pitch), across, w[:, 0] + np.tan(pitch) * about], axis=1)


def _spin(angles: Array, rates: Array, second: Array) -> tuple[Array, Array]:
    """Return ω = E α̇ and ω̇ = E α̈ + Ė α̇, (n, 3) each and in axes of the base."""
    _, pitch, roll = angles.T
    _, dpitch, droll = rates.T
    (s, c), (sr, cr), zero, E = _sine(pitch), _sine(roll), np.zeros_like(pitch), _rate_matrix(angles)
    dE = np.array(
        [
            [-c * dpitch, zero, zero],
            [c * cr * droll - s * sr * dpitch, -sr * droll, zero],
            [-c * sr * droll - s * cr * dpitch, -cr * droll, zero],
        ]
    ).transpose(2, 0, 1)
    return _times(E, rates), _times(E, second) + _times(dE, rates)


def _rate_matrix(angles: Array) -> Array:
    """Return E (n, 3, 3)."""
    (s, c), (sr, cr) = _sine(angles[:, 1]), _sine(angles[:, 2])
    zero, one = np.zeros_like(s), np.ones_like(s)
    return np.array([[-s, zero, one], [c * sr, cr, zero], [c * cr, -sr, zero]]).transpose(2, 0, 1)


def _sine(x: Array) -> tuple[Array, Array]:
    return np.sin(x), np.cos(x)
