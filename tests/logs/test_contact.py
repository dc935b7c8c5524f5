"""Contact intervals: from the wrench, from λ, from the distance, against what is known of a motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import forcegp
from forcegp.errors import DataError, MappingError
from forcegp.logs import closed as states
from forcegp.logs import contact, import_log, parse_mapping
from forcegp.logs.mapping import ContactStateSection
from forcegp.logs.surface_fit import fit_surface
from forcegp.logs.table import ImportReport, Signals
from forcegp.simulate import simulate

FRAME, POINT = "lbr_iiwa_link_7", (0.0, 0.0, 0.1)
DT, ROWS = 1.0 / 200.0, 1600


@pytest.fixture(scope="module")
def pressed() -> tuple[forcegp.ConstrainedSystem, Signals, np.ndarray]:
    """An arm that moves freely, and is pushed by 15 to 25 N along the normal in known intervals.

    The torque is what the rigid body needs, with noise; the wrench is in world axes.
    """
    robot = forcegp.load_robot("kuka_iiwa")
    t = np.arange(ROWS) * DT
    rate = np.array([0.5, 0.7, 0.6, 0.9, 1.1, 0.8, 1.3])
    phase = np.linspace(0.0, 2.0, 7)
    x = t[:, None] * rate + phase
    start = np.array([0.0, 0.6, 0.0, -1.4, 0.0, 0.9, 0.0])
    q, qd, qdd = (
        torch.from_numpy(v)
        for v in (start + 0.2 * np.sin(x), 0.2 * rate * np.cos(x), -0.2 * rate**2 * np.sin(x))
    )
    closed = ((t > 1.0) & (t < 3.0)) | ((t > 4.5) & (t < 6.0))
    force = np.where(closed, 20.0 + 5.0 * np.sin(2.0 * t), 0.0)[:, None] * np.array([0.0, 0.0, 1.0])
    J = forcegp.kinematics.point_jacobian(robot, q, FRAME, POINT)
    pushed = (J.mT @ torch.from_numpy(force)[..., None])[..., 0]
    tau = (
        forcegp.dynamics.inverse_dynamics(robot, q, qd, qdd)
        - forcegp.dynamics.damping_force(robot, qd)
        - pushed
    )
    random = np.random.default_rng(0)
    vectors = {
        "q": q.numpy(),
        "qd": qd.numpy(),
        "qdd": qdd.numpy(),
        "tau": tau.numpy() + 0.05 * random.standard_normal(q.shape),
    }
    vectors["wrench"] = np.hstack([force + 0.5 * random.standard_normal(force.shape), np.zeros((ROWS, 3))])
    table = forcegp.SurfaceContact("table", FRAME, POINT, forcegp.Plane())
    signals = Signals(robot.joint_names, t, np.arange(ROWS), np.zeros(ROWS, np.int64), vectors)
    return forcegp.ConstrainedSystem(robot, [table]), signals, closed


def mapping(source: str, more: str = "", name: str = "table") -> object:
    toml = (
        '[time]\ncolumn = "t"\n[position]\ncolumn = "q{joint}"\nunit = "rad"\n'
        '[torque]\ncolumn = "i{joint}"\nunit = "Nm"\n'
        f'[wrench]\nforce = ["x", "y", "z"]\nframe = "{FRAME}"\naxes = "world"\n'
        f'[contact.{name}]\nsource = "{source}"\n{more}\n'
    )
    return parse_mapping(toml.encode(), "m.toml")


@pytest.mark.parametrize("source", ["wrench", "multiplier"])
def test_forces_show_the_intervals(
    pressed: tuple[forcegp.ConstrainedSystem, Signals, np.ndarray], source: str
) -> None:
    system, signals, closed = pressed
    report = ImportReport("log")
    (found,) = contact.detect(signals, system, mapping(source), report)  # type: ignore[arg-type]
    assert (signals.contact["table"] == closed).mean() >= 0.99
    assert len(found.intervals) == 2 and found.intervals[0][0] == pytest.approx(1.0, abs=2.5 * DT)
    assert 15.0 < found.closed_level < 25.0 and abs(found.open_level) < 2.0
    assert report.findings[0].kind == "contact" and "2 closed intervals" in report.findings[0].message


def test_the_multiplier_is_the_force_along_the_normal(
    pressed: tuple[forcegp.ConstrainedSystem, Signals, np.ndarray],
) -> None:
    system, signals, closed = pressed
    estimate = contact.multipliers(signals, system)["table"][:, 0]
    truth = np.where(closed, 20.0 + 5.0 * np.sin(2.0 * signals.t), 0.0)
    # The noise of the torque, 0.05 N m on levers of about half a metre, is below 1 N.
    assert np.abs(estimate - truth).std() < 1.0 and abs((estimate - truth).mean()) < 0.1


def test_the_distance_shows_the_intervals(
    pressed: tuple[forcegp.ConstrainedSystem, Signals, np.ndarray],
) -> None:
    system, signals, _ = pressed
    position = forcegp.kinematics.point_position(
        system.robot, torch.from_numpy(signals.vectors["q"]), FRAME, POINT
    )
    height = position[:, 2].numpy()
    offset = float(np.quantile(height, 0.3))
    table = forcegp.SurfaceContact("table", FRAME, POINT, forcegp.Plane(offset=offset))
    system = forcegp.ConstrainedSystem(system.robot, [table])
    more = "shortest = 0.0\nthreshold = 0.02"
    contact.detect(signals, system, mapping("distance", more), ImportReport("log"))  # type: ignore[arg-type]
    np.testing.assert_array_equal(signals.contact["table"], np.abs(height - offset) <= 0.02)
    assert signals.contact["table"].any() and not signals.contact["table"].all()


def test_one_state_only_is_not_split_in_two() -> None:
    noise = np.random.default_rng(0).standard_normal(2000)
    with pytest.raises(DataError, match=r"does not determine when contact 'table'(?s:.*)always, never"):
        states.force_levels(noise, "table", ContactStateSection(source="wrench"))


def gait(friction: float, seed: int = 0) -> tuple[Signals, np.ndarray, np.ndarray, np.ndarray]:
    """λ, c and ċ of a foot that stands for 0.3 of 0.5 s on a floor that is 5 mm off and drifts.

    λ rises to 12 N and falls to 1 N at lift-off. Joint friction changes it with the direction of motion.
    """
    random, t = np.random.default_rng(seed), 0.002 * np.arange(10000)
    phase = t % 0.5
    closed, swing = phase < 0.3, np.clip((phase - 0.3) / 0.2, 0.0, 1.0)
    height = 0.02 * np.sin(np.pi * swing) ** 2
    speed = np.gradient(height, 0.002) + 0.01 * random.standard_normal(len(t))
    load = np.where(closed, 1.0 + 11.0 * np.sin(np.pi * np.minimum(phase / 0.3, 1.0)) ** 0.5, 0.0)
    load += friction * np.where(closed, 1.0, np.cos(np.pi * swing) * -1.0) + 0.1 * random.standard_normal(
        len(t)
    )
    c = height + 5e-3 + 2e-3 * np.sin(t) + 1e-4 * random.standard_normal(len(t))
    return (
        Signals(("a",), t, np.arange(len(t)), np.zeros(len(t), np.int64), {}),
        load,
        np.stack([c, speed], 1),
        closed,
    )


def test_the_motion_finds_the_ends_of_contacts_that_friction_blurs() -> None:
    signals, load, moves, closed = gait(friction=3.0)
    section = ContactStateSection(source="multiplier")
    with pytest.raises(DataError, match="does not determine"):
        states.force_levels(load, "foot", section)
    found, high, low, source = states.closed_by_force(signals, load, "foot", section, moves)
    assert source == "multiplier and motion" and low < 0.0 < high
    ends, own = (np.flatnonzero(np.diff(x)) for x in (closed, found))
    assert len(ends) == len(own) and np.abs(ends - own).max() <= 5, "10 ms"


def test_motion_is_not_used_where_it_does_not_depend_on_the_force() -> None:
    signals, load, moves, _ = gait(friction=3.0)
    moves[:, 1] = np.random.default_rng(1).standard_normal(len(load))
    with pytest.raises(DataError, match="does not determine when contact 'foot' is closed"):
        states.closed_by_force(signals, load, "foot", ContactStateSection(source="multiplier"), moves)


def test_short_intervals_take_the_state_around_them() -> None:
    t = np.arange(100) * 0.01
    closed = (t > 0.3) & (t < 0.7)
    closed[[10, 50]] ^= True
    signals = Signals(("a",), t, np.arange(100), np.zeros(100, np.int64), {})
    assert states.merge_short(closed, signals, 0.05) == 2
    np.testing.assert_array_equal(closed, (t > 0.3) & (t < 0.7))


def test_a_contact_that_flickers_is_not_inverted() -> None:
    """Neighbouring intervals are all too short: closed and open rows changed places."""
    t = 0.01 * np.arange(60)
    signals = Signals(("a",), t, np.arange(60), np.zeros(60, np.int64), {})
    closed = np.zeros(60, dtype=np.bool_)
    closed[10:50] = True
    closed[[20, 22, 23, 25, 27]] = False
    states.merge_short(closed, signals, 0.05)
    assert closed[10:50].all() and not closed[:10].any() and not closed[50:].any()


def test_what_is_not_said_of_a_contact_is_an_error(
    pressed: tuple[forcegp.ConstrainedSystem, Signals, np.ndarray],
) -> None:
    system, signals, _ = pressed
    with pytest.raises(MappingError, match=r"m.toml:\d+: contact.wall: the scene has no contact 'wall'"):
        contact.detect(signals, system, mapping("always", name="wall"), ImportReport("log"))  # type: ignore[arg-type]
    text = (
        b'[time]\ncolumn = "t"\n[position]\ncolumn = "q"\nunit = "rad"\n[torque]\ncolumn = "i"\nunit = "Nm"\n'
    )
    with pytest.raises(MappingError, match="no source determines whether contact 'table' is closed"):
        contact.detect(signals, system, parse_mapping(text, "m.toml"), ImportReport("log"))
    contact.detect(signals, system, mapping("always"), ImportReport("log"))  # type: ignore[arg-type]
    assert signals.contact["table"].all()


def test_the_tip_coming_near_is_not_taken_for_contact() -> None:
    random = np.random.default_rng(0)
    closed, near = -8e-5 + 1e-5 * random.standard_normal(500), np.linspace(1e-4, 5e-2, 400)
    threshold = states.touching(np.concatenate([closed, near]))
    assert closed.max() < threshold < near.min()
    # A surface that is known to a millimetre only: nothing nearer than that tells the two apart.
    assert states.touching(random.uniform(-3e-3, 3e-3, 500)) == states.TOUCHING
    assert states.touching(near + 1.0) == states.TOUCHING


SLIDING = (
    '[time]\ncolumn = "t"\n[position]\ncolumn = "{joint}"\nunit = "rad"\n'
    '[torque]\ncolumn = "tau_{joint}"\nunit = "Nm"\n[contact.table]\nsource = "distance"\n'
)


@pytest.fixture(scope="module")
def slides(tmp_path_factory: pytest.TempPathFactory) -> tuple[forcegp.Dataset, Path]:
    """The bundled scene's motion, all of it in contact, and a place for logs."""
    scene = forcegp.load_scene("kuka_plane")
    data = simulate(scene.system(), replace(scene.simulation, duration=5.0)).data
    return data, tmp_path_factory.mktemp("logs")


def logged(slides: tuple[forcegp.Dataset, Path], order: tuple[int, ...] = ()) -> Path:
    """The motion as CSV, with the columns of joints in another order."""
    data, folder = slides
    index = list(order) or list(range(data.nq))
    names = data.joint_names
    columns = np.column_stack([data.t, data.q[:, index], data.tau[:, index]])
    heading = ",".join(["t", *names, *(f"tau_{name}" for name in names)])
    np.savetxt(folder / "run.csv", columns, delimiter=",", header=heading, comments="", fmt="%.12g")
    return folder / "run.csv"


def with_table(offset: float) -> forcegp.ConstrainedSystem:
    """The bundled scene with its table at another height."""
    system = forcegp.load_scene("kuka_plane").system()
    table = replace(system.contacts[0], surface=forcegp.Plane(offset=0.055 + offset))  # type: ignore[type-var]
    return forcegp.ConstrainedSystem(system.robot, [table])


@pytest.mark.parametrize(("offset", "seen"), [(5e-3, "-5.01 ± "), (-5e-3, "4.99 ± ")])
def test_a_table_that_lies_elsewhere_is_an_error_that_names_the_distance_and_the_remedy(
    slides: tuple[forcegp.Dataset, Path], offset: float, seen: str
) -> None:
    own = SLIDING.replace('"distance"', '"distance"\nthreshold = 0.0005')
    assert own != SLIDING
    with pytest.raises(DataError, match="the tip is " + seen):
        import_log(logged(slides), with_table(offset), parse_mapping(own.encode(), "m.toml"))
    log, mapping = logged(slides), parse_mapping(SLIDING.encode(), "m.toml")
    with pytest.raises(DataError, match="the tip is " + seen + r".* mm from .*'table'") as caught:
        import_log(log, with_table(offset), mapping)
    assert "--fit-surface" in str(caught.value) and 'source = "never"' in str(caught.value)
    imported = import_log(log, with_table(offset), mapping, displaced=True)
    assert float(imported.data.contact["table"].double().mean()) > 0.9
    assert "where the tip slides" in imported.report.findings[0].message
    fit = fit_surface(imported.data, with_table(offset), "table", "plane")
    assert fit.surface.offset == pytest.approx(0.055, abs=1e-4)  # type: ignore[union-attr]


def test_exchanged_joints_are_named_by_the_surface_that_they_leave(
    slides: tuple[forcegp.Dataset, Path],
) -> None:
    log = logged(slides, (0, 2, 1, 3, 4, 5, 6))
    with pytest.raises(DataError, match="the columns of lbr_iiwa_joint_2 and lbr_iiwa_joint_3 exchanged"):
        import_log(log, "kuka_plane", parse_mapping(SLIDING.encode(), "m.toml"))


def test_free_motion_that_never_touches_is_no_error(slides: tuple[forcegp.Dataset, Path]) -> None:
    data, _ = slides
    phase = torch.arange(len(data))[:, None] * torch.linspace(0.004, 0.007, 7, dtype=torch.float64)
    above = torch.tensor([0.0, 0.2, 0.0, -0.9, 0.0, 0.9, 0.0], dtype=torch.float64) + 0.2 * torch.sin(phase)
    log = logged((data.replace(q=above), slides[1]))
    imported = import_log(log, "kuka_plane", parse_mapping(SLIDING.encode(), "m.toml"))
    said = [finding.message for finding in imported.report.findings]
    assert not imported.data.contact["table"].any()
    assert any("closed in hardly any row" in text for text in said) and not any(
        "nan" in text for text in said
    )
