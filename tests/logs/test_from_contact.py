"""Joints that follow from a closed contact, speeds at which a tip sticks, and clipped torques, at import."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

import forcegp
from forcegp.constraints import project_state
from forcegp.errors import DataError, MappingError
from forcegp.logs import import_log, parse_mapping
from forcegp.logs.from_contact import dividing_speed, resting_speed
from forcegp.simulate import simulate
from log_files import REAL, motion, real_logs, write_csv

CLOSED = 1e-6
"""Accuracy of joints that follow from a contact [rad, rad/s, rad/s²]; Gauss-Newton ends at 1e-9 m."""


@pytest.fixture(scope="module")
def slid() -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    """An arm whose tip slides over a table, simulated, and moved onto the table exactly."""
    scene = forcegp.load_scene("kuka_plane")
    config = dataclasses.replace(scene.simulation, duration=0.5, noise_std=0.0, engine="mujoco")
    system = dataclasses.replace(scene.system(), baumgarte=None)
    data = simulate(scene.system(), config).data
    q, qd = project_state(system, data.q, data.qd)
    eom = system.equations(q, qd)
    return system, data.replace(q=q, qd=qd, qdd=eom.acceleration(eom.Q_K + data.tau))


def written(folder: Path, data: forcegp.Dataset, lacking: str = "", **flags: np.ndarray) -> tuple[Path, str]:
    """The log as CSV without the motion of a joint, and its mapping, whose last table is the contact's."""
    columns = {"t": data.t.numpy()} | flags
    for name in ("q", "qd", "qdd", "tau"):
        values = getattr(data, name).numpy()
        kept = {f"{name}.{j}": values[:, i] for i, j in enumerate(data.joint_names)}
        columns |= {k: v for k, v in kept.items() if name == "tau" or not k.endswith(lacking or "-")}
    path = folder / "run.csv"
    np.savetxt(
        path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments=""
    )
    toml = '[time]\ncolumn = "t"\n'
    tables = {"position": ("q", "rad"), "velocity": ("qd", "rad/s"), "acceleration": ("qdd", "rad/s2")}
    for table, (name, unit) in {**tables, "torque": ("tau", "Nm")}.items():
        toml += f'[{table}]\ncolumn = "{name}.{{joint}}"\nunit = "{unit}"\n'
        toml += f'from_contact = {{ {lacking} = "table" }}\n' if table == "position" and lacking else ""
    return path, toml + '[contact.table]\nsource = "always"\n'


def test_a_joint_follows_from_a_closed_contact(
    slid: tuple[forcegp.ConstrainedSystem, forcegp.Dataset], tmp_path: Path
) -> None:
    """Position, velocity and acceleration are those of the simulator, which the import does not see."""
    system, data = slid
    path, toml = written(tmp_path, data, lacking := data.joint_names[3])
    # Two elbows reach the table; Gauss-Newton finds that in the half of the limits that it starts in.
    robot, half = system.robot, float(data.q[:, 3].mean()) > 0.0
    lower, upper = robot.lower.clone(), robot.upper.clone()
    (lower if half else upper)[3] = 0.0
    found = import_log(
        path,
        system.with_robot(dataclasses.replace(robot, lower=lower, upper=upper)),
        parse_mapping(toml.encode(), "mapping"),
    )
    for name in ("q", "qd", "qdd"):
        np.testing.assert_allclose(getattr(found.data, name), getattr(data, name), rtol=0.0, atol=CLOSED)
    assert f"{lacking} follows from contact 'table'" in found.report.steps


def test_a_joint_that_no_closed_contact_determines_is_refused(
    slid: tuple[forcegp.ConstrainedSystem, forcegp.Dataset], tmp_path: Path
) -> None:
    system, data = slid
    path, toml = written(tmp_path, data, data.joint_names[3])
    by_distance = toml.replace('"always"', '"distance"')
    with pytest.raises(MappingError, match=r"needs the position(?s:.*)source = \"always\" or \"column\""):
        import_log(path, system, parse_mapping(by_distance.encode(), "mapping"))
    # The last joint turns about the axis of the tip.
    path, toml = written(tmp_path, data, data.joint_names[6])
    with pytest.raises(DataError, match=f"does not determine {data.joint_names[6]}"):
        import_log(path, system, parse_mapping(toml.encode(), "mapping"))


def test_the_speed_at_rest_lies_between_two_modes() -> None:
    random = np.random.default_rng(0)
    creeps, slides = (s * 10.0 ** random.normal(0.0, 0.2, 1000) for s in (2e-3, 0.1))
    both = resting_speed(np.concatenate([creeps, slides]))
    assert both is not None and creeps.max() < both < slides.min()
    assert resting_speed(creeps) == 0.01, "a tip that never moves faster"
    # Turning round is no rest: speeds of a sine.
    noise = np.hypot(*(4e-3 * np.random.default_rng(0).standard_normal((2, 5000))))
    limit = resting_speed(noise)
    assert limit is not None and 0.01 < limit < 0.02 and (noise < limit).mean() > 0.998, "noise at rest"
    assert resting_speed(np.abs(0.1 * np.sin(np.linspace(0.0, 50.0, 5000)))) is None
    assert dividing_speed(np.array([0.3, 0.1, 0.2, 0.4]), np.array([0, 1, 1, 0], bool)) == pytest.approx(0.25)
    assert dividing_speed(np.array([0.1, 0.2]), np.array([False, False])) is None


@pytest.mark.parametrize("source", ["column", "number", "never", "speed"])
def test_a_contact_sticks_below_the_speed_of_the_log(
    source: str, slid: tuple[forcegp.ConstrainedSystem, forcegp.Dataset], tmp_path: Path
) -> None:
    """A fit takes the speed over; that of a tip that always slides stays none."""
    system, data = slid
    point = system.equations(data.q, data.qd).contact_points["table"]
    speed = point.sliding[1].norm(dim=-1).numpy()
    path, toml = written(tmp_path, data, rests=(speed < 0.05).astype(float))
    toml += {
        "column": 'sticks = "rests"',
        "number": "stick_speed = 0.05",
        "never": 'stick_speed = "never"',
    }.get(source, "")
    read = import_log(path, system, parse_mapping(toml.encode(), "mapping")).data
    read.write(tmp_path / "log.parquet")
    stated = forcegp.Dataset.read(tmp_path / "log.parquet").header.stick_speeds
    model = forcegp.StructuredGP(system, "analytical", [forcegp.priors.JointForcePrior()])
    fit = model.fit(read[::10], learn=[])
    (contact,) = fit.system.contacts
    assert isinstance(contact, forcegp.SurfaceContact)
    if source in ("column", "number"):
        below, above = speed[speed < 0.05].max(), speed[speed >= 0.05].min()
        assert below < stated["table"] <= above
        assert contact.stick_speed == stated["table"]
        assert fit.predict(read.q[:3], read.qd[:3], read.tau[:3], "multiplier").mean.shape == (3, 3)
    else:
        assert stated == {} and contact.stick_speed is None


@pytest.mark.parametrize("how", ["noise", "drop", "keep"])
def test_clipped_torques_get_noise_or_go(how: str, tmp_path: Path) -> None:
    robot, m = forcegp.load_robot("double_pendulum"), motion(600)
    limit = 4.0
    raw = dataclasses.replace(m, tau=np.clip(m.tau, [-99.0, -limit], [99.0, limit]))
    hit = np.abs(m.tau[:, 1]) > limit
    path, toml = write_csv(tmp_path, raw)
    found = import_log(path, robot, parse_mapping(f'{toml}clipped = "{how}"\n'.encode(), "mapping"))
    assert ("the torque of elbow clips" in str(found.report.findings)) == (how != "keep")
    reached = np.convolve(hit, np.ones(11), mode="same") > 0.0  # the filter's window
    if how == "noise":
        std = found.data.extras["tau_std"].numpy()
        assert not std[:, 0].any() and (std[reached, 1] > 0.9 * limit).all() and not std[~reached, 1].any()
    elif how == "drop":
        assert len(found.data) == (~reached).sum()
    else:
        assert len(found.data) == 600 and "tau_std" not in found.data.extras


def test_a_fit_does_not_learn_from_torques_of_unknown_size() -> None:
    """As the stated noise of some torques grows, the fit is that without these rows."""
    robot = forcegp.load_robot("double_pendulum")
    torch.manual_seed(0)
    q, qd, tau = torch.randn(3, 60, 2, dtype=torch.float64)
    qdd = forcegp.dynamics.forward_dynamics(robot, q, qd, tau - 0.5 * qd)
    t = torch.arange(60, dtype=torch.float64)
    wrong = tau.clone()
    wrong[:20] += 3.0
    data = forcegp.Dataset(t, q, qd, wrong, qdd, robot.joint_names)
    std = torch.zeros_like(tau)
    std[:20] = 1e6
    system = forcegp.ConstrainedSystem(robot)
    model = forcegp.StructuredGP(system, "analytical", [forcegp.priors.JointForcePrior()])
    without = model.fit(data[20:], learn=[])
    stated = model.fit(data.replace(extras={"tau_std": std}), learn=[], after=without)
    believed = model.fit(data, learn=[], after=without)
    one, two, far = (fit.predict(q, qd, tau).mean for fit in (without, stated, believed))
    assert float((two - one).abs().max()) < 1e-6 * float((far - one).abs().max())


@real_logs
def test_the_height_of_a_pushed_leg_follows_from_its_foot(tmp_path: Path) -> None:
    """As by the kinematics of the foot that is held; the torque that clips is found in the raw log."""
    folder = REAL / "hopper"
    read = [
        np.loadtxt(folder / "pushed" / f"dg_hopper_teststand-joint_{name}.dat")
        for name in ("positions", "torques")
    ]
    first, last = max(x[0, 0] for x in read), min(x[-1, 0] for x in read)
    q, tau = (x[(x[:, 0] >= first) & (x[:, 0] <= last), 1:] for x in read)
    columns = np.column_stack([np.arange(len(q)) * 1e-3, q, tau])
    header = "t,q.HFE,q.KFE,tau.HFE,tau.KFE"
    np.savetxt(tmp_path / "pushed.csv", columns, delimiter=",", header=header, comments="")
    robot = forcegp.load_robot(folder / "teststand.urdf")
    foot = forcegp.SurfaceContact("ground", "contact", (0.0, 0.0, 0.0), forcegp.Plane((0.0, 0.0, 1.0), 0.0))
    toml = """
    time = { column = "t" }
    position = { column = "q.{joint}", unit = "rad", from_contact = { joint_z = "ground" } }
    torque = { column = "tau.{joint}", unit = "Nm", unmeasured = ["joint_z"] }
    derivatives = { window = 61 }
    contact.ground = { source = "always", stick_speed = 1.0 }
    """
    system = forcegp.ConstrainedSystem(robot, [foot])
    found = import_log(tmp_path / "pushed.csv", system, parse_mapping(toml.encode(), "mapping")).data
    still = found.q.clone()
    still[:, 0] = 0.0
    height = forcegp.kinematics.frame_pose(robot, still, "contact")[1][:, 2]
    np.testing.assert_allclose(found.q[:, 0], -height, rtol=0.0, atol=1e-9)
    std = found.extras["tau_std"]
    assert not std[:, :2].any()
    # A third of the rows, and half a window on either side of each stretch.
    assert 0.33 < float((std[:, 2] > 0.0).double().mean()) < 0.6
    assert found.header.unmeasured_torques == ("joint_z",) and found.header.stick_speeds == {"ground": 1.0}
