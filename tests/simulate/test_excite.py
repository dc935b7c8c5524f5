"""Motions that excite a robot: gradient, limits at 1 kHz, collisions, and what their logs would tell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import approx_fprime
from typer.testing import CliRunner

import forcegp
from forcegp.cli.app import app
from forcegp.control.information import CRITERIA, LOOK, Unknowns, rigid_torque
from forcegp.dynamics import damping_force, inverse_dynamics
from forcegp.errors import DataError, NumericalError, ParameterError, UnknownNameError
from forcegp.robot.shapes import shapes_of
from forcegp.simulate.collisions import Collisions
from forcegp.simulate.excite import Excitation, Limits, Search, Spline, excite, random_states

ROBOT = forcegp.load_robot("ur5")
FREE = forcegp.ConstrainedSystem(ROBOT)
LIMITS = Limits.of(ROBOT, velocity=[2.0], acceleration=[6.0])
BOX = [0.3, 0.45, 0.3, 0.3, 0.3, 0.6]
START = [0.0, -1.5, 1.5, 0.0, 1.5, 0.0]
ROUNDING = 1e-8
"""Of limits, as a share."""


def unknowns(robot: forcegp.RobotModel = ROBOT, limits: Limits = LIMITS) -> Unknowns:
    return Unknowns.of(robot, limits.low, limits.high, limits.velocity, random_states(robot, limits, 50))


def collisions(boxes: tuple[list[float], ...] = ()) -> Collisions:
    return Collisions(FREE, shapes_of(ROBOT), boxes)


def short(seed: int = 0, boxes: tuple[list[float], ...] = (), **options: object) -> Excitation:
    near = collisions(boxes)
    settings: dict = {"limits": LIMITS, "collisions": near, "start": START, "seed": seed, "restarts": 1}
    return excite(FREE, 4.0, **settings | options)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_the_gradient_is_that_of_finite_differences(criterion: str, monkeypatch: pytest.MonkeyPatch) -> None:
    search = Search(Spline(np.array(START), 4.0), LIMITS, unknowns(), collisions(), CRITERIA[criterion])
    x = 1.5 * search.spline.random(LIMITS, np.random.default_rng(1))
    # Beyond limits of the joints, where hinges act; those of the clearance have a test of their own.
    used, _ = search.used(x, 0.1)
    assert used["acceleration"] > 1.0
    monkeypatch.setattr(search.collisions, "penalty", lambda q, _: (0.0, np.zeros_like(q)))
    w = search.flat(x)
    some = np.random.default_rng(0).choice(len(w), 12, replace=False)

    def along(part: np.ndarray) -> float:
        moved = w.copy()
        moved[some] = part
        return search(moved)[0]

    step = 1e-5
    numeric = [
        (along(w[some] + step * e) - along(w[some] - step * e)) / (2.0 * step) for e in np.eye(len(some))
    ]
    gradient = search(w)[1]
    assert np.abs(numeric - gradient[some]).max() < 1e-6 * np.abs(gradient).max()


def test_the_criterion_of_least_squares_is_their_error_if_other_functions_exist() -> None:
    """The error of the estimate K y from torques y = A θ + B g + noise, with K for g = 0."""
    found, q = unknowns(), torch.randn(3, 40, 6, dtype=torch.float64)
    links, each = found.base.rank, (found.parts["friction"].stop - found.base.rank) // 6
    fitted = [*range(links), *(links + each * j + k for j in range(6) for k in (0, 1))]
    others = [k for k in range(len(found.root)) if k not in fitted]
    rate = torch.randn(40, 6, dtype=torch.float64)
    Phi = torch.cat([found.columns(*q)[1][..., :-1], rate[..., None]], dim=-1)
    A, B = (
        (Phi[..., some] / found.noise[:, None]).flatten(0, 1) * (10.0 / LOOK / 40) ** 0.5
        for some in (fitted, others)
    )
    prior, spread = ((found.root @ found.root.mT)[some][:, some] for some in (fitted, others))
    K = torch.linalg.solve(torch.linalg.inv(prior) + A.mT @ A, A.mT)
    missed, biased = K @ A - torch.eye(len(fitted)), K @ B
    covariance = missed @ prior @ missed.mT + K @ K.mT + biased @ spread @ biased.mT
    rows = found.columns(*found.region)[1][..., fitted]
    variance = torch.einsum("njp,pk,njk->nj", rows, covariance, rows).mean(0)
    value = float(CRITERIA["V"](found.information(found.columns(*q)[1], 10.0, rate), found))
    assert value == pytest.approx(0.5 * float(variance.log().mean()), rel=1e-6)


def test_a_delay_of_the_torque_shifts_it_in_time() -> None:
    search = Search(Spline(np.array(START), 4.0), LIMITS, unknowns(), collisions(), CRITERIA["V"])
    x = 0.2 * search.spline.random(LIMITS, np.random.default_rng(1))

    def torque(t: np.ndarray) -> torch.Tensor:
        q, qd, qdd = (torch.from_numpy(m @ x) for m in search.spline.at(t))
        return rigid_torque(ROBOT, q + torch.tensor(START), qd, qdd)

    step, nodes = 1e-4, search.nodes
    rate = torch.zeros(len(nodes), 6, dtype=torch.float64)
    rate[1:-1] = (torque(nodes[1:-1] + step) - torque(nodes[1:-1] - step)) / (2.0 * step)
    Phi = search.unknowns.columns(*search.states(torch.from_numpy(x)))[1]
    expected = search.unknowns.information(Phi, 4.0, rate)[-1]
    found = search.information(Phi, torque(nodes))[-1]
    assert float((found - expected).norm()) < 0.1 * float(expected.norm())  # differences over 0.2 s


def test_the_gradient_of_the_clearance_is_that_of_finite_differences() -> None:
    near, margin, tested = collisions((BOX,)), 0.05, 0
    for q in np.random.default_rng(0).uniform(-2.0, 2.0, (300, 6)):
        if not 0.0 < near.penalty(q[None], margin)[0] < 0.9 or len(near.pairs(q)):
            continue  # apart, or in each other, where MuJoCo's distance is approximate
        numeric = approx_fprime(q, lambda x: near.penalty(x[None], margin)[0], 1e-7)
        gradient = near.penalty(q[None], margin)[1][0]
        assert np.abs(numeric - gradient).max() < 1e-3 * np.abs(gradient).max()
        tested += 1
    assert tested > 5


def test_splines_start_and_end_at_rest_and_have_their_derivatives() -> None:
    spline = Spline(np.array(START), 4.0)
    x = spline.random(LIMITS, np.random.default_rng(0))
    t = np.linspace(0.0, 4.0, 40001)
    q, qd, qdd = (matrix @ x for matrix in spline.at(t))
    for values in (q, qd, qdd):
        assert np.abs(values[[0, -1]]).max() < 1e-12
    assert np.abs(np.gradient(q, t, axis=0)[1:-1] - qd[1:-1]).max() < 1e-6
    assert np.abs(np.gradient(qd, t, axis=0)[1:-1] - qdd[1:-1]).max() < 1e-2  # q̈ has corners
    speed, rate = spline.differences(torch.from_numpy(x))
    assert (
        np.abs(qd).max() <= float(speed.abs().max()) and np.abs(qdd).max() <= float(rate.abs().max()) + 1e-12
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_all_limits_hold_at_1_khz_and_the_robot_stays_clear(seed: int) -> None:
    found = short(seed, (BOX,))
    motion = found.motion
    assert len(motion) == 4001 and float(motion.t[1]) == pytest.approx(1e-3)
    edge = 1.0 + ROUNDING
    assert bool((motion.q >= LIMITS.low).all() and (motion.q <= LIMITS.high).all())
    for values, limit in ((motion.qd, LIMITS.velocity), (motion.qdd, LIMITS.acceleration)):
        assert bool((values.abs() <= edge * limit).all())
    torque = inverse_dynamics(ROBOT, motion.q, motion.qd, motion.qdd) - damping_force(ROBOT, motion.qd)
    assert bool((torque.abs() <= edge * LIMITS.torque).all())
    assert torch.allclose(torque, motion.tau, atol=1e-8)
    assert collisions((BOX,)).depth(motion.q.numpy()).max() < 1e-9
    for rest in (motion.qd, motion.qdd):
        assert float(rest[[0, -1]].abs().max()) < 1e-9
    assert np.allclose(motion.q[0].numpy(), START) and np.allclose(motion.q[-1].numpy(), START)


def test_the_box_is_in_the_way_of_the_motion_without_it() -> None:
    assert collisions((BOX,)).depth(short(0).motion.q.numpy()).max() > 0.01


def test_the_motion_tells_more_than_its_random_start_and_the_same_seed_gives_it_again() -> None:
    found = short(5)
    search = Search(Spline(np.array(START), 4.0), LIMITS, found.before, collisions(), CRITERIA["A"])
    random = np.random.default_rng(5)
    starts = [search.shrunk(search.spline.random(LIMITS, random), 0.05)[0] for _ in range(4)]
    assert found.criterion[0] < min(search(search.flat(x))[0] for x in starts) - 0.2
    assert torch.equal(short(5).motion.q, found.motion.q)


def test_the_expected_covariance_is_that_of_the_dense_formula() -> None:
    before = unknowns()
    states = random_states(ROBOT, LIMITS, 30, seed=1)
    _, Phi = before.columns(*states)
    after = before.after(before.information(Phi, 30 * LOOK))
    A = (Phi / before.noise[:, None]).flatten(0, 1)
    prior = before.root @ before.root.mT
    exact = prior - prior @ A.mT @ torch.linalg.solve(torch.eye(len(A)) + A @ prior @ A.mT, A @ prior)
    assert torch.allclose(after.root @ after.root.mT, exact, rtol=1e-4, atol=1e-6 * float(exact.abs().max()))
    assert bool((after.torque_std()["all"] < before.torque_std()["all"]).all())


def test_columns_of_the_links_are_torques_of_other_links() -> None:
    before = unknowns()
    q, qd, qdd = random_states(ROBOT, LIMITS, 20, seed=2)
    heavier = ROBOT.replace(mass=1.1 * ROBOT.mass, inertia=1.1 * ROBOT.inertia)
    delta = torch.from_numpy(before.base.of(heavier) - before.base.of(ROBOT))
    _, Phi = before.columns(q, qd, qdd)
    change = rigid_torque(heavier, q, qd, qdd) - rigid_torque(ROBOT, q, qd, qdd)
    assert torch.allclose(Phi[..., before.parts["links"]] @ delta, change, atol=1e-8)


def test_the_share_holds_for_positions_as_for_the_other_limits() -> None:
    """Distances from the middle of the range, which need not be zero."""
    robot = ROBOT.replace(lower=torch.full((6,), -1.0).double(), upper=torch.full((6,), 2.0).double())
    limits = Limits.of(robot, velocity=[2.0], acceleration=[6.0], share=0.5)
    assert limits.low.tolist() == [-0.25] * 6 and limits.high.tolist() == [1.25] * 6
    assert limits.velocity.tolist() == [1.0] * 6 and limits.acceleration.tolist() == [3.0] * 6
    with pytest.raises(ParameterError, match="a larger --share"):
        excite(forcegp.ConstrainedSystem(robot), 4.0, limits=limits, start=[1.3] + [0.0] * 5)


def test_missing_limits_are_named_with_their_option() -> None:
    robot = ROBOT.replace(
        velocity_limit=ROBOT.velocity_limit.clone().index_fill(0, torch.tensor([1]), torch.inf)
    )
    with pytest.raises(ParameterError, match=r"velocity for shoulder_lift_joint(?s:.*)--velocity"):
        Limits.of(robot)
    robot = ROBOT.replace(effort_limit=torch.full_like(ROBOT.effort_limit, torch.inf))
    with pytest.raises(ParameterError, match=r"torque for shoulder_pan_joint(?s:.*)--torque"):
        Limits.of(robot)
    with pytest.raises(ParameterError, match="1 or 6 numbers"):
        Limits.of(ROBOT, acceleration=[1.0, 2.0])
    with pytest.raises(ParameterError, match="above 0, up to 1"):
        Limits.of(ROBOT, share=1.5)


def test_starts_in_collision_and_limits_without_room_are_refused() -> None:
    with pytest.raises(ParameterError, match=r"start is in collision(?s:.*)surroundings and link of wrist_3"):
        short(boxes=([0.5, 0.115, 0.42, 0.1, 0.1, 0.1],))
    with pytest.raises(ParameterError, match="not within the limits"):
        short(start=[9.0] * 6)
    weak = Limits.of(ROBOT, acceleration=[6.0], torque=[1.0])
    with pytest.raises(
        NumericalError, match=r"no motion from the start satisfies the limits of torque(?s:.*)--start"
    ):
        short(limits=weak)
    with pytest.raises(ParameterError, match="no collision-free position"):
        short(limits=Limits.of(ROBOT, torque=[0.01]), start=None)
    with pytest.raises(UnknownNameError, match="criterion"):
        short(criterion="B")
    with pytest.raises(ParameterError, match="six finite numbers"):
        collisions(([0.0, 0.0, 0.0, 1.0, 1.0, -1.0],))
    with pytest.raises(ParameterError, match="2 to 600 seconds"):
        excite(FREE, 0.5)


def test_the_command_writes_a_motion_that_simulate_follows(tmp_path: Path) -> None:
    run, motion, out = CliRunner().invoke, tmp_path / "motion.csv", tmp_path / "run.parquet"
    scene = tmp_path / "arm.toml"
    scene.write_text('[robot]\nmodel = "ur5"\n[simulation]\ncontact = "solver"\ndt = 0.004\n')
    options = ["--seconds", "3", "--acceleration", "5", "--restarts", "1", "--box", "0.9,0.9,0.5,0.2,0.2,0.2"]
    said = run(app, ["excite", "-s", str(scene), *options, "-o", str(motion)], catch_exceptions=False)
    assert said.exit_code == 0, said.output
    page = motion.with_suffix(".html").read_text()
    assert "shoulder_pan_joint" in page and "torque after" in page
    read = forcegp.Dataset.read(motion)
    assert len(read) == 3001 and read.joint_names == ROBOT.joint_names
    assert run(app, ["simulate", "-s", str(scene), "--motion", str(motion), "-o", str(out)]).exit_code == 0
    log = forcegp.Dataset.read(out)
    assert float(log.t[-1]) == pytest.approx(2.996)
    assert float((log.q - read.q[::4][: len(log)]).abs().max()) < 5e-3
    with pytest.raises(DataError, match=r"end the name in \.parquet"):
        run(app, ["excite", "-s", "ur5_free", "-o", str(tmp_path / "motion.txt")], catch_exceptions=False)
    with pytest.raises(ParameterError, match="--box is not a list of numbers"):
        run(app, ["excite", "-s", "ur5_free", "--box", "a,b", "-o", str(motion)], catch_exceptions=False)
