"""A real contact with a measured force: a hopping leg on a slider, and the same leg pushed by hand.

    python benchmarks/real_contact.py --json result.json --all      # a quarter of an hour
    python benchmarks/real_contact.py --logs path/to/real --figure docs/figures/real_contact.svg
    python benchmarks/real_contact.py --default                     # as a user would

In `hopper/hopping` the leg stands and squats (first half), jumps, lands, squats deeper and stands (second);
each half is learned from and the other tested. In `hopper/pushed` somebody moves the base by hand while the
foot is held. All rows in contact count but those with a saturated torque. All signals of all methods pass the
same Savitzky-Golay filter, whose window is cross-validated on the training half. Contact labels come from the
height of the foot.

- `static`: f = −J⁻ᵀ(τ + Q_G) of the two joints of the leg.
- `equations of motion`: of these two joints, with the masses of the file and no friction.
- `least squares`: the same, with offset, gain and friction of these joints (`TERMS`), learned from the force
  sensor in training.
- `weighted`: of all three, the slider's missing force known to ± 1 N in motion and ± 4 N at rest.
- `oracle`: `least squares` with that subset of the terms of each joint (and an inertia of each drive) that is
  best on both test halves; from `slider`, they are learned from the motion of the slider, without a sensor.
- `forcegp`: the external wrench at the foot, learned with a foot that sticks and no force sensor; `sensor`:
  learned from the joint forces that sensor and accelerations show together; `vertical axis`: from the
  sensor's vertical axis alone; `own half`: in the half that it is learned from.

With `--default`, the raw columns of `hopping` are a CSV file, imported with the window of `--guess`, a slider
without a torque sensor, and a contact with the declared plane that is always closed (flight lasts 0.13 s, and
neither height nor multiplier shows it without a threshold). The force is that of `contact_force`, and all
methods read the imported signals.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from classical_wrench import TERMS, identified_losses
from numpy.typing import NDArray
from real_cases import evenly, existing, iiwa14, moving
from results_page import table
from scipy.ndimage import binary_dilation
from scipy.signal import savgol_coeffs, savgol_filter
from sensed_forces import with_sensed_forces
from torch import Tensor

import forcegp
from forcegp import kinematics
from forcegp.checks import clipped_torques
from forcegp.data.derivative import cross_validated_window
from forcegp.errors import DataError
from forcegp.logs import import_log, parse_mapping
from forcegp.logs.guess import guess_mapping
from forcegp.models.sensed import SENSOR
from forcegp.models.structured_fit import StructuredFit
from forcegp.robust import MAD_TO_STD
from forcegp.scene.document import tomllib

LOGS = Path(__file__).resolve().parents[2] / "shared" / "real"
DT, ORDER = 1e-3, 3
"""Sampling period [s], and degree of the filter."""
FIRST, SECOND = (0.03, 1.40), (1.40, 2.96)
"""The halves of `hopping` [s], without half a window at the ends."""
LIFTED = 0.009
"""The foot is in the air from this height above its median of the first half [m]: between the 8 mm that the
height sensor is off in contact, and the 11 to 15 mm of the flight."""
NEVER_SLIDES = 1.0
"""Speed below which the rubber foot sticks [m/s], above that of any row in contact."""
HAND = 30.0
"""Size of the unknown force on the base while somebody pushes it [N]."""
UNKNOWN = 1e4
"""Standard deviation of axes of the sensor that are not used [N]."""
BOUNDS = torch.tensor([0.85, 0.55], dtype=torch.float64)
"""Of the errors with a sensor, fore-aft and vertical, over those of the equations of motion."""
UNSENSED = 0.9
"""Of the geometric mean of both ratios without a sensor."""
SLIDER = (TERMS["offset"], TERMS["viscous"], TERMS["Coulomb"])
"""Terms of the slider."""
BLOCK, DRAWS = 100, 4000
"""Length of a block of rows that the bootstrap draws [samples], longer than the 76 ms over which errors are
correlated, and number of draws."""
FLIGHT = 0.5
"""Vertical force below which the sensor shows flight [N], to judge the contact labels."""
BEFORE, AFTER = 0.15, 0.3
"""The hop in open loop starts this long before lift-off, and ends this long after landing [s]."""
BAND, SAMPLES = (0.05, 0.95), 50
AXES = ("fx", "fz")
SIGNALS = ("joint_positions", "joint_torques", "ati_force")
HEIGHT = "height_sensors"
DEFAULT = """
time = {{ column = "t_s" }}
position = {{ column = "pos_{{joint}}", unit = "rad" }}
torque = {{ column = "torque_{{joint}}", unit = "Nm", unmeasured = ["joint_z"] }}
contact.ground = {{ source = "always" }}
derivatives = {{ window = {window} }}
"""
FORCE = "ati_force"


def columns(folder: Path, names: tuple[str, ...]) -> dict[str, NDArray[np.float64]]:
    """The signals of a log in their common samples."""
    read = {name: np.loadtxt(existing(folder / f"dg_hopper_teststand-{name}.dat")) for name in names}
    first, last = max(x[0, 0] for x in read.values()), min(x[-1, 0] for x in read.values())
    return {name: x[(x[:, 0] >= first) & (x[:, 0] <= last), 1:] for name, x in read.items()}


def filtered(x: NDArray[np.float64], window: int, degree: int = 0) -> Tensor:
    smooth = savgol_filter(x, window, ORDER, deriv=degree, delta=DT, axis=0)
    return torch.from_numpy(np.ascontiguousarray(smooth))


def torques(raw: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """The logged torques; that of the slider is zero."""
    return np.concatenate([np.zeros((len(raw[FORCE]), 1)), raw["joint_torques"]], axis=1)


def dataset(
    robot: forcegp.RobotModel, q: NDArray[np.float64], raw: dict[str, NDArray[np.float64]], window: int
) -> forcegp.Dataset:
    """A log of the leg, filtered; the slider has neither a motor nor a sensor of its force."""
    header = forcegp.data.DataHeader(unmeasured_torques=(robot.joint_names[0],))
    return forcegp.Dataset(
        t=DT * torch.arange(len(q), dtype=torch.float64),
        q=filtered(q, window),
        qd=filtered(q, window, 1),
        qdd=filtered(q, window, 2),
        tau=filtered(torques(raw), window),
        joint_names=robot.joint_names,
        contact={"ground": torch.ones(len(q), dtype=torch.bool)},
        contact_extras={SENSOR: {"ground": filtered(raw[FORCE], window)}},
        header=header,
    )


def hopping(logs: Path, window: int) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    """The leg on its slider with a foot that sticks to the ground, and the log."""
    robot = forcegp.load_robot(existing(logs / "hopper" / "teststand.urdf"))
    raw = columns(logs / "hopper" / "hopping", (HEIGHT, *SIGNALS))
    data = dataset(robot, np.concatenate([raw[HEIGHT], raw["joint_positions"]], axis=1), raw, window)
    foot = kinematics.frame_pose(robot, data.q, "contact")[1][:, 2]
    ground = float(foot[(data.t >= FIRST[0]) & (data.t < FIRST[1])].median())
    contact = forcegp.SurfaceContact(
        name="ground",
        frame="contact",
        point=(0.0, 0.0, 0.0),
        surface=forcegp.Plane(normal=(0.0, 0.0, 1.0), offset=ground),
        stick_speed=NEVER_SLIDES,
    )
    data = data.replace(contact={"ground": foot < ground + LIFTED})
    return forcegp.ConstrainedSystem(robot, [contact]), data


def pushed(robot: forcegp.RobotModel, logs: Path, window: int) -> tuple[forcegp.Dataset, Tensor]:
    """The log of the leg whose foot is held, and the rows that are judged `(n,)`.

    Its height is not logged: the foot that stays where it is tells it.
    """
    raw = columns(logs / "hopper" / "pushed", SIGNALS)
    q = np.concatenate([np.zeros((len(raw[FORCE]), 1)), raw["joint_positions"]], axis=1)
    q[:, 0] -= kinematics.frame_pose(robot, torch.from_numpy(q), "contact")[1][:, 2].numpy()
    data = dataset(robot, q, raw, window)
    recorded = data.replace(tau=torch.from_numpy(torques(raw)))
    saturated = binary_dilation(clipped_torques(recorded).any(-1), iterations=window // 2)
    rows = torch.from_numpy(np.asarray(saturated)).logical_not()
    rows[: window // 2], rows[-(window // 2) :] = False, False
    return data, rows


def between(data: forcegp.Dataset, half: tuple[float, float]) -> forcegp.Dataset:
    """The samples from the first time to before the second."""
    return data[(data.t >= half[0]) & (data.t < half[1])]


def window_of(logs: Path, half: tuple[float, float]) -> int:
    """The window that the training half asks for."""
    raw = columns(logs / "hopper" / "hopping", (HEIGHT, *SIGNALS))
    rows = slice(round(half[0] / DT), round(half[1] / DT))
    signals = [raw[name][rows] for name in (HEIGHT, "joint_positions", "joint_torques")]
    return cross_validated_window(signals, ORDER)


def sensor_std(logs: Path, log: str, half: tuple[float, float], window: int) -> float:
    """Standard deviation of the noise that the filter leaves of the noisiest axis of the sensor [N].

    White noise is told by the departure of each training sample from the cubic through its neighbours.
    """
    x = columns(logs / "hopper" / log, (FORCE,))[FORCE][round(half[0] / DT) : round(half[1] / DT)]
    departure = x[2:-2] - (4.0 * (x[1:-3] + x[3:-1]) - x[:-4] - x[4:]) / 6.0
    white = MAD_TO_STD * np.median(np.abs(departure), axis=0) / (35.0 / 18.0) ** 0.5
    return float(white.max() * np.linalg.norm(savgol_coeffs(window, ORDER)))


def unexplained(robot: forcegp.RobotModel, data: forcegp.Dataset) -> tuple[Tensor, Tensor]:
    """M q̈ − Q − τ `(n, 3)` and the Jacobian `(n, 2, 3)` of the foot's fore-aft and vertical position."""
    eom = forcegp.ConstrainedSystem(robot).equations(data.q, data.qd)
    J = kinematics.frame_jacobian(robot, data.q, "contact", (0.0, 0.0, 0.0))[:, [3, 5]]
    return (eom.M @ data.qdd[..., None])[..., 0] - eom.Q_K - data.tau, J


def classical(
    robot: forcegp.RobotModel, data: forcegp.Dataset, train: forcegp.Dataset | None = None
) -> dict[str, Tensor]:
    """Fore-aft and vertical force by each method without learning `(n, 2)`, and by least squares from a
    training log with its force sensor."""
    moving, J = unexplained(robot, data)
    Q_G = forcegp.dynamics.gravity_force(robot, data.q)
    # 1/σ² of the three rows; those of the leg count most
    weight = torch.where(data.qd[:, :1].abs() > 0.02, 1.0, 1.0 / 16.0).expand_as(moving).clone()
    weight[:, 1:] = 1.0 / 0.03**2
    JW = J * weight[:, None, :]
    forces = {
        "static": torch.linalg.solve(J[..., 1:].mT, -(Q_G + data.tau)[:, 1:]),
        "equations of motion": torch.linalg.solve(J[..., 1:].mT, moving[:, 1:]),
        "weighted": torch.linalg.solve(JW @ J.mT, JW @ moving[..., None])[..., 0],
    }
    if train is not None:
        left, foot = unexplained(robot, train)
        force = train.contact_extras[SENSOR]["ground"][:, [0, 2]]
        left = left - (force[:, None, :] @ foot)[:, 0]
        for terms in (("offset", "gain"), ("offset", "viscous", "Coulomb"), tuple(TERMS)):
            losses = identified_losses(left, train.qd, train.tau, terms)(data.qd, data.tau)
            name = f"least squares, {', '.join(terms)}"
            forces[name] = torch.linalg.solve(J[..., 1:].mT, (moving - losses)[:, 1:])
    return forces


def scores(
    force: Tensor, data: forcegp.Dataset, rows: Tensor, std: Tensor | None = None
) -> dict[str, object]:
    """Errors of the fore-aft and vertical force, and the coverage of their bars."""
    error = (force - data.contact_extras[SENSOR]["ground"][:, [0, 2]])[rows]
    score: dict[str, object] = {
        "samples": len(error),
        "rmse_N": error.square().mean(0).sqrt().tolist(),
        "bias_N": error.mean(0).tolist(),
    }
    score["block_mse"] = torch.stack([x.square().mean(0) for x in error.split(BLOCK)]).tolist()
    if std is not None:
        score["median_std_N"] = std[rows].median(0).values.tolist()
        score["coverage"] = (error.abs() <= 2.0 * std[rows]).double().mean(0).tolist()
    return score


def wrench_scores(
    fit: StructuredFit, data: forcegp.Dataset, rows: Tensor, external: dict[str, float] | None = None
) -> dict[str, object]:
    """Scores of the external wrench at the foot, the contact not declared."""
    open_ = data.replace(contact={"ground": torch.zeros_like(rows)})
    found = fit.external_wrench(open_, "contact", axes=AXES, external=external)
    return scores(found.mean, data, rows, found.std)


def learned(
    system: forcegp.ConstrainedSystem, data: forcegp.Dataset, sensor: str = "", std: float = 0.0
) -> StructuredFit:
    """A fit with the defaults, without the force sensor, with it and its noise, or with its vertical axis."""
    if sensor == "sensor":
        free = forcegp.ConstrainedSystem(system.robot)
        return forcegp.StructuredGP(free, "analytical").fit(with_sensed_forces(data, system, std))
    model = forcegp.StructuredGP(system, "analytical")
    if sensor == "vertical axis":
        closed = data[data.contact["ground"]]
        force = {"F_I": {"ground": closed.contact_extras[SENSOR]["ground"]}}
        noise = torch.tensor([UNKNOWN, UNKNOWN, std], dtype=torch.float64)
        sensed = forcegp.priors.Observation(
            closed.replace(contact_extras=force), "contact_force", noise_std=noise
        )
        return model.fit([forcegp.priors.Observation(data), sensed])
    return model.fit(data)


def hopping_scores(logs: Path, train: tuple[float, float], test: tuple[float, float]) -> dict[str, object]:
    """All methods on one half, learned from the other."""
    window = window_of(logs, train)
    system, data = hopping(logs, window)
    first, second = between(data, train), between(data, test)
    rows = second.contact["ground"]
    result: dict[str, object] = {"window": window}
    for name, force in classical(system.robot, second, first).items():
        result[name] = scores(force, second, rows)
    std = sensor_std(logs, "hopping", train, window)
    for name in ("", "sensor", "vertical axis"):
        fit = learned(system, first, name, std)
        result[f"forcegp {name}".strip()] = wrench_scores(fit, second, rows)
        own = wrench_scores(fit, first, first.contact["ground"])
        result[f"forcegp {name}".strip() + ", own half"] = own
    return result


def ratios(ways: list[dict[str, Any]]) -> dict[str, dict[str, list[float]]]:
    """Errors of each method over those of the equations of motion, geometric means over both ways, and their
    standard errors from a bootstrap over blocks of rows."""
    random, found = np.random.default_rng(0), {}
    for name in (k for k, x in ways[0].items() if isinstance(x, dict) and not k.endswith("own half")):
        logs, drawn = [], []
        for way in ways:
            own, plain = (np.array(way[k]["rmse_N"]) for k in (name, "equations of motion"))
            logs.append(np.log(own / plain))
            own, plain = (np.array(way[k]["block_mse"]) for k in (name, "equations of motion"))
            rows = random.integers(0, len(own), (DRAWS, len(own)))
            drawn.append(0.5 * np.log(own[rows].mean(1) / plain[rows].mean(1)))
        deviation = np.exp(np.mean(drawn, axis=0)).std(0)
        found[name] = {"ratio": np.exp(np.mean(logs, axis=0)).tolist(), "error": deviation.tolist()}
    return found


@dataclasses.dataclass(frozen=True)
class Losses:
    """Rows of a half in contact: what terms of the leg's joints change, up to factors, and what is missing.

    Attributes:
        force: fore-aft and vertical force per unit of each term `(n, 2, k)`.
        error: that force by equations of motion, less that of the sensor `(n, 2)`.
        slider: force on the slider per unit of each term, and its own friction and offset `(n, k + 3)`.
        missing: force on the slider by equations of motion, less that of its motion `(n,)`.
    """

    force: Tensor
    error: Tensor
    slider: Tensor
    missing: Tensor

    @classmethod
    def of(cls, robot: forcegp.RobotModel, data: forcegp.Dataset, closed: Tensor) -> Losses:
        moving, J = unexplained(robot, data)
        columns = torch.stack([*(term(data.qd, data.tau) for term in TERMS.values()), data.qdd], dim=-1)
        to_force = torch.linalg.inv(J[..., 1:].mT)
        lost = (to_force[..., None] * columns[:, None, 1:]).flatten(2)
        force = (to_force @ moving[:, 1:, None])[..., 0]
        slider = (J[..., :1].mT @ lost)[:, 0]
        friction = torch.stack([term(data.qd, data.tau)[:, 0] for term in SLIDER], dim=-1)
        missing = (J[..., 0] * force).sum(-1) - moving[:, 0]
        error = force - data.contact_extras[SENSOR]["ground"][:, [0, 2]]
        parts = (lost, error, torch.cat([slider, friction], dim=-1), missing)
        return cls(*(part[closed] for part in parts))

    def weights(self, chosen: list[int], learned_from: str) -> Tensor:
        """Weights of some terms by least squares: from the sensor's axes, or from the slider's motion."""
        if learned_from == "slider":
            own = [*chosen, *range(self.force.shape[-1], self.slider.shape[-1])]
            return torch.linalg.lstsq(self.slider[:, own], self.missing[:, None]).solution[: len(chosen)]
        axes = [0, 1] if learned_from == "sensor" else [1]
        A = self.force[:, axes][..., chosen].flatten(0, 1)
        return torch.linalg.lstsq(A, self.error[:, axes].flatten()[:, None]).solution

    def left(self, chosen: list[int], weights: Tensor) -> Tensor:
        """Root mean square error of the force by axis, over that of the equations of motion."""
        left = self.error - (self.force[..., chosen] @ weights)[..., 0]
        return (left.square().mean(0) / self.error.square().mean(0)).sqrt()


def oracle(halves: list[tuple[Losses, Losses]], learned_from: str) -> dict[str, object]:
    """The subset of terms of each joint, learned in one half, that is best in the other.

    Ratios of errors are geometric means over both ways. The best subset minimises the largest ratio to
    `BOUNDS`, or, learned from the slider, the geometric mean of both axes. The test halves choose it.
    """
    names = [f"{joint} {name}" for joint in ("hip", "knee") for name in (*TERMS, "inertia")]
    subsets = [[i for i in range(len(names)) if m >> i & 1] for m in range(1, 2 ** len(names))]

    def ratio(chosen: list[int]) -> Tensor:
        ways = [test.left(chosen, train.weights(chosen, learned_from)) for train, test in halves]
        return torch.stack(ways).log().mean(0).exp()

    found = torch.stack([ratio(subset) for subset in subsets])
    excess = found.log().mean(-1).exp() / UNSENSED if learned_from == "slider" else (found / BOUNDS).amax(-1)
    best = int(excess.argmin())
    return {
        "ratio": found[best].tolist(),
        "terms": [names[i] for i in subsets[best]],
        "met": int((excess <= 1.0).sum()),
        "next": sorted(excess.tolist())[1],
    }


def oracles(logs: Path) -> dict[str, dict[str, object]]:
    """`oracle`, learned from both axes of the sensor, from the vertical one, and without it."""
    halves = []
    for train, test in ((FIRST, SECOND), (SECOND, FIRST)):
        system, data = hopping(logs, window_of(logs, train))
        parts = (between(data, half) for half in (train, test))
        first, second = (Losses.of(system.robot, part, part.contact["ground"]) for part in parts)
        halves.append((first, second))
    return {name: oracle(halves, name) for name in ("sensor", "vertical axis", "slider")}


def pushed_scores(logs: Path) -> dict[str, object]:
    """The pushed leg: learned on `hopping` without a sensor, and on its own first half with one."""
    window = window_of(logs, (FIRST[0], SECOND[1]))
    system, data = hopping(logs, window)
    log, rows = pushed(system.robot, logs, window)
    later = rows & (log.t >= log.t[-1] / 2.0)
    hand = {system.robot.joint_names[0]: HAND}
    result: dict[str, object] = {"window": window}
    for name, force in classical(system.robot, log).items():
        if name != "weighted":
            result[name] = scores(force, log, rows)
    fit = learned(system, between(data, (FIRST[0], SECOND[1])))
    result["forcegp, learned on hopping"] = wrench_scores(fit, log, rows, hand)
    std = sensor_std(logs, "pushed", (0.0, float(log.t[-1]) / 2.0), window)
    fit = learned(system, log[rows & ~later], "sensor", std)
    for name, force in classical(system.robot, log, log[rows & ~later]).items():
        if name.startswith("least squares"):
            result[f"{name}, second half"] = scores(force, log, later)
    result["forcegp sensor, second half"] = wrench_scores(fit, log, later, hand)
    return result


def imported(logs: Path, folder: Path) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    """The raw columns of `hopping` as a user imports them, with the sensor's force in the same window.

    The plane is declared at the height of the foot in most rows.
    """
    robot = forcegp.load_robot(existing(logs / "hopper" / "teststand.urdf"))
    raw = columns(logs / "hopper" / "hopping", (HEIGHT, *SIGNALS))
    n, names, path = len(raw[FORCE]), robot.joint_names, folder / "hopping.csv"
    q = np.concatenate([raw[HEIGHT], raw["joint_positions"]], axis=1)[:n]
    foot = kinematics.frame_pose(robot, torch.from_numpy(q), "contact")[1][:, 2]
    plane = forcegp.Plane((0.0, 0.0, 1.0), float(foot.median()))
    contact = forcegp.SurfaceContact("ground", "contact", (0.0, 0.0, 0.0), plane)
    system = forcegp.ConstrainedSystem(robot, [contact])
    table = np.column_stack([DT * np.arange(n), q, raw["joint_torques"][:n]])
    header = ",".join(["t_s", *(f"pos_{name}" for name in names), *(f"torque_{name}" for name in names[1:])])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=header, comments="")
    window = tomllib.loads(guess_mapping(path, system).toml())["derivatives"]["window"]
    mapping = parse_mapping(DEFAULT.format(window=window).encode(), "mapping")
    data = import_log(path, system, mapping).data
    force = savgol_filter(raw[FORCE], window, ORDER, axis=0)[(data.t / DT).round().long().numpy()]
    sensed = {**data.contact_extras, SENSOR: {"ground": torch.from_numpy(np.ascontiguousarray(force))}}
    return system, data.replace(contact_extras=sensed)


def default_scores(
    system: forcegp.ConstrainedSystem, train: forcegp.Dataset, test: forcegp.Dataset
) -> dict[str, object]:
    """The force of `contact_force` and of the equations of motion on one half, learned from the other."""
    fit = forcegp.StructuredGP(system, "analytical").fit(train)
    rows, force = test.contact["ground"], fit.contact_force(test)
    assert force.std is not None
    forces = classical(system.robot, test)
    result: dict[str, object] = {k: scores(f, test, rows) for k, f in forces.items() if k != "weighted"}
    result["forcegp"] = scores(force.mean[:, [0, 2]], test, rows, force.std[:, [0, 2]])
    return result


def as_a_user(logs: Path) -> dict[str, Any]:
    """`default_scores` both ways, and the geometric mean of the ratios over axes and ways."""
    with tempfile.TemporaryDirectory() as folder:
        system, data = imported(logs, Path(folder))
    first, second = between(data, FIRST), between(data, SECOND)
    result: dict[str, Any] = {
        "hopping, second half": default_scores(system, first, second),
        "hopping, first half": default_scores(system, second, first),
    }
    result["ratios"] = ratios(list(result.values()))
    result["geometric_mean"] = float(np.exp(np.log(result["ratios"]["forcegp"]["ratio"]).mean()))
    return result


def oracle_as_a_user(logs: Path) -> dict[str, object]:
    """`oracle` learned from the slider, with the imported signals."""
    with tempfile.TemporaryDirectory() as folder:
        system, data = imported(logs, Path(folder))
    parts = [between(data, half) for half in (FIRST, SECOND)]
    closed = [part.contact_extras[SENSOR]["ground"][:, 2] > FLIGHT for part in parts]
    a, b = (Losses.of(system.robot, part, rows) for part, rows in zip(parts, closed, strict=True))
    return oracle([(a, b), (b, a)], "slider")


def contact_labels(logs: Path) -> dict[str, float]:
    """How well the height of the foot tells flight from stance, beside the force sensor."""
    _, data = hopping(logs, window_of(logs, FIRST))
    data = between(data, (FIRST[0], SECOND[1]))
    flight = data.contact_extras[SENSOR]["ground"][:, 2] < FLIGHT
    said = ~data.contact["ground"]
    jump = said & (data.t < float(data.t[flight].max()) + 0.05)
    times, found = (data.t[x.nonzero()[:, 0]] for x in (flight, jump))
    return {
        "flight_found": float((said & flight).sum() / flight.sum()),
        "stance_called_open": float((said & ~flight).sum() / (~flight).sum()),
        "lift_off_ms": 1e3 * float(found[0] - times[0]),
        "landing_ms": 1e3 * float(found[-1] - times[-1]),
    }


def hop(logs: Path) -> dict[str, object]:
    """The jump in open loop under the logged torques, learned from the first half, also with the sensor."""
    window = window_of(logs, FIRST)
    system, data = hopping(logs, window)
    air = data.contact_extras[SENSOR]["ground"][:, 2] < FLIGHT
    air &= (data.t > SECOND[0]) & (data.t < SECOND[1])
    left, landed = (float(data.t[air][k]) for k in (0, -1))
    log = between(data, (left - BEFORE, landed + AFTER))
    lifted = round(BEFORE / DT)
    result: dict[str, object] = {"measured": jump(log.q[:, 0], lifted, landed - left)}
    for name in ("", "sensor"):
        fit = learned(system, between(data, FIRST), name, sensor_std(logs, "hopping", FIRST, window))
        options = forcegp.rollout.RolloutOptions(unilateral=True, on_divergence="keep")
        path = fit.rollout(
            log.q[0], log.qd[0], log, DT * (len(log) - 1), SAMPLES, system=system, options=options
        )
        assert path.samples is not None
        flights = [event.t for event in path.events if event.row == 0 and event.t > 0.0]
        flight = flights[1] - flights[0] if len(flights) > 1 else float("nan")
        found = jump(path.q[:, 0], round(flights[0] / DT) if flights else lifted, flight)
        low, high = path.samples.q[..., 0].nanquantile(path.q.new_tensor(BAND), dim=0)
        height = log.q[: len(path.t), 0]
        result[f"forcegp {name}".strip()] = found | {
            "in_band": float(((low <= height) & (height <= high)).double().mean()),
            "band_at_lift_off_m": float(high[lifted] - low[lifted]),
        }
    return result


def torque_shares(logs: Path) -> dict[str, object]:
    """Root mean square over the load of all joints of M q̈ − Q, for each joint of the iiwa 14 and for all: by
    how much torques of a robot file without friction are wrong, `UNSHOWN` of `forcegp.learning.search`."""
    (case,) = iiwa14(logs)
    data = evenly(moving(case.train), 4000)
    eom = case.system.equations(data.q, data.qd)
    wrong = ((eom.M @ data.qdd[..., None])[..., 0] - eom.Q_K - data.tau).square().mean(0)
    load = (data.tau**2 + eom.Q_G**2 + eom.Q_C**2).mean()
    return {"joints": (wrong / load).sqrt().tolist(), "all": float((wrong.mean() / load).sqrt())}


def jump(height: Tensor, lifted: int, flight: float) -> dict[str, float]:
    """Time in the air, and rise of the base from lift-off to its highest point."""
    return {"flight_s": flight, "rise_m": float(height.nan_to_num(-1.0).max() - height[lifted])}


def draw(logs: Path, file: Path) -> None:
    """The force in the second half of `hopping`, learned without the sensor in the first."""
    import matplotlib.pyplot as plt

    window = window_of(logs, FIRST)
    system, data = hopping(logs, window)
    fit, test = learned(system, between(data, FIRST)), between(data, SECOND)[::4]
    open_ = test.replace(contact={"ground": torch.zeros_like(test.contact["ground"])})
    found = fit.external_wrench(open_, "contact", axes=AXES)
    assert found.std is not None
    plain = classical(system.robot, test)["equations of motion"]
    true = test.contact_extras[SENSOR]["ground"][:, [0, 2]]
    figure, axes = plt.subplots(2, 1, figsize=(8.0, 5.0), sharex=True, layout="constrained")
    for k, (ax, name) in enumerate(zip(axes, ("fore-aft", "vertical"), strict=True)):
        mean, std = found.mean[:, k], found.std[:, k]
        ax.fill_between(test.t, mean - 2.0 * std, mean + 2.0 * std, color="C0", alpha=0.25, lw=0.0)
        ax.plot(test.t, plain[:, k], color="0.6", lw=0.9, label="equations of motion")
        ax.plot(test.t, mean, color="C0", lw=1.2, label="forcegp ± 2σ, no sensor")
        ax.plot(test.t, true[:, k], color="k", lw=0.9, label="force sensor")
        ax.set_ylabel(f"{name} force [N]")
    axes[0].set_ylim(-5.0, 4.0)
    axes[1].set_ylim(-8.0, 30.0)
    axes[0].legend(fontsize=8, ncols=3, loc="upper right")
    axes[1].set_xlabel("t [s]")
    figure.savefig(file, metadata={"Date": None})
    plt.close(figure)


def lines(name: str, result: dict[str, object]) -> list[list[str]]:
    """Rows of the table."""

    def pair(score: dict[str, list[float]], key: str, digits: int) -> str:
        return " ".join(f"{x:.{digits}f}" for x in score[key]) if key in score else "–"

    keys = ("rmse_N", "bias_N", "median_std_N", "coverage")
    return [
        [name, method, *(pair(score, key, 2) for key in keys)]
        for method, score in result.items()
        if isinstance(score, dict)
    ]


HEAD = [
    "tested on",
    "method",
    "RMSE fore-aft, vertical [N]",
    "bias [N]",
    "median σ [N]",
    "coverage of ±2σ",
]


def report_default(result: dict[str, Any], path: Path | None) -> None:
    """Print the result of `as_a_user`, and write it as JSON."""
    print(table(HEAD, [row for name, part in result.items() if "hop" in name for row in lines(name, part)]))
    print("over equations of motion:", result["ratios"], result["geometric_mean"])
    if "oracle, slider" in result:
        print("oracle, learned from the slider:", result["oracle, slider"])
    if path:
        path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--logs", type=Path, default=LOGS, help="folder of the logs (default: ../shared/real)"
    )
    parser.add_argument("--default", action="store_true", help="raw columns of `hopping`, all defaults")
    parser.add_argument("--all", action="store_true", help="also the best of all sets of terms, and the hop")
    parser.add_argument("--figure", type=Path, help="draw the second half of `hopping` to this file")
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    result: dict[str, Any]
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    try:
        existing(options.logs / "hopper" / "teststand.urdf")
        if options.default:
            result = as_a_user(options.logs)
            if options.all:
                result["oracle, slider"] = oracle_as_a_user(options.logs)
            report_default(result, options.json)
            return
        result = {
            "hopping, second half": hopping_scores(options.logs, FIRST, SECOND),
            "hopping, first half": hopping_scores(options.logs, SECOND, FIRST),
            "pushed": pushed_scores(options.logs),
            "contact labels": contact_labels(options.logs),
        }
    except DataError as error:
        sys.exit(str(error))
    print(table(HEAD, [row for name, part in result.items() for row in lines(name, part)]))
    print({name: part["window"] for name, part in result.items() if "window" in part})
    result["ratios"] = ratios([result["hopping, second half"], result["hopping, first half"]])
    for name, ratio in result["ratios"].items():
        print(f"{name}, over equations of motion:", ratio)
    if options.all:
        slow = {"oracle": oracles, "hop": hop, "torque shares": torque_shares}
        result |= {name: measured(options.logs) for name, measured in slow.items()}
    for name in ("contact labels", "oracle", "hop", "torque shares"):
        if name in result:
            print(f"{name}:", result[name])
    if options.figure:
        draw(options.logs, options.figure)
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
