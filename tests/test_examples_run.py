"""The example scripts run as they stand, and their results are plausible."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from log_files import REAL, real_logs

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 600.0  # examples take under 20 s on one thread, the real contact minutes; machines may be busy


def run(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / script), *arguments]
    limited = os.environ | {"MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False, env=limited)


def example(name: str, folder: Path) -> str:
    """What an example prints; it must end by naming the figure that it has drawn."""
    figure = folder / f"{name}.png"
    done = run(f"examples/{name}.py", str(figure))
    assert done.returncode == 0, done.stderr
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert done.stdout.endswith(f"figure: {figure}\n")
    return done.stdout


def numbers(pattern: str, text: str) -> tuple[float, ...]:
    """The groups of the first match."""
    found = re.search(pattern, text)
    assert found is not None, text
    return tuple(map(float, found.groups()))


# Two examples run in `make test`; the others take 7 to 14 s each and run in `make test-slow`.
EXAMPLES = sorted(path.stem for path in (ROOT / "examples").glob("*.py"))


def test_every_example_is_a_tutorial() -> None:
    assert len(EXAMPLES) >= 8
    for name in EXAMPLES:
        text = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")
        assert f"test_{name}" in globals(), f"{name} is not tested"
        assert f"python examples/{name}.py" in text
        assert text.count("# %%") >= 1, "it opens as a notebook"


def test_minimal_sgp() -> None:
    done = run("examples/minimal_sgp.py")
    assert done.returncode == 0, done.stderr
    assert numbers(r"\(10\) .* beside the library's: (\S+)", done.stdout)[0] < 1e-9
    for name in ("qdd", "multiplier"):
        assert numbers(rf"\(25\) {name}: .* differ by (\S+)", done.stdout)[0] < 1e-9
    learned, prior = numbers(r"wire's force: ([\d.]+) N; of the prior ([\d.]+) N", done.stdout)
    assert learned < 0.3 * prior


def test_double_pendulum_on_a_wire(tmp_path: Path) -> None:
    text = example("double_pendulum_on_a_wire", tmp_path)
    model, file = numbers(r"force: ([\d.]+) N, of the robot file alone ([\d.]+) N", text)
    assert model < 0.1 * file
    assert numbers(r"within 2 sigma: (\d+)%", text)[0] >= 90
    assert numbers(r"\|A qdd - b\|: (\S+)", text)[0] < 1e-12


@pytest.mark.slow
def test_kuka_on_the_table(tmp_path: Path) -> None:
    text = example("kuka_on_the_table", tmp_path)
    model, file = numbers(r"mean error ([\d.]+) rad/s2, of the robot file alone ([\d.]+)", text)
    assert model < 0.7 * file
    mean, bar, true = numbers(r"normal force: ([\d.]+) \+- ([\d.]+) N on average, true ([\d.]+)", text)
    assert abs(mean - true) <= bar + 0.1, "both are printed with one decimal"


@pytest.mark.slow
def test_ur5_wiping(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    text = example("ur5_wiping", tmp_path)
    (file,) = numbers(r"robot file alone: bias \S+ N, standard deviation ([\d.]+)", text)
    bias, std, inside = numbers(r"model: bias (\S+) N, standard deviation ([\d.]+) N, .* (\d+)%", text)
    assert std < 0.8 * file and abs(bias) < std
    assert inside >= 90


@pytest.mark.slow
def test_quadruped_feet(tmp_path: Path) -> None:
    for package in ("mujoco", "cmeel"):
        pytest.importorskip(package)
    text = example("quadruped_feet", tmp_path)
    (agree,) = numbers(r"labels agree with MuJoCo in ([\d.]+)%", text)
    assert agree > 93.0, "a foot that chatters counts as closed"
    mean, error, inside = numbers(
        r"feet: ([\d.]+) N on average, error ([\d.]+) N, within 2 sigma (\d+)%", text
    )
    assert error < 0.15 * mean and inside > 50, "bars are too narrow while friction changes its direction"


@pytest.mark.slow
def test_payload_followed_online(tmp_path: Path) -> None:
    rows = re.findall(
        r"([\d.]+) \+- ([\d.]+) kg, true ([\d.]+)", example("payload_followed_online", tmp_path)
    )
    before, _, settled, last = [tuple(map(float, row)) for row in rows]
    for mass, bar, true in (before, settled, last):
        assert abs(mass - true) <= 2.0 * bar + 0.01


@pytest.mark.slow
def test_mpc_with_learned_friction(tmp_path: Path) -> None:
    for package in ("mujoco", "casadi"):
        pytest.importorskip(package)
    text = example("mpc_with_learned_friction", tmp_path)
    (file, _), (learned, _) = (
        numbers(rf"{name}: tracking error ([\d.]+) mrad, solve ([\d.]+) ms", text)
        for name in ("robot file", "learned")
    )
    assert learned < 0.5 * file


@pytest.mark.slow
@pytest.mark.xfail(reason="the force leaves its bounds in 21 % of the steps (required: 5 %), at 10.5 ± 2.2 N")
def test_mpc_holds_a_force(tmp_path: Path) -> None:
    for package in ("mujoco", "casadi"):
        pytest.importorskip(package)
    text = example("mpc_holds_a_force", tmp_path)
    (file, _), (learned, _) = (
        numbers(rf"{name}: outside 10 ± 3 N in ([\d.]+)% of the steps, solve ([\d.]+) ms", text)
        for name in ("robot file", "learned")
    )
    assert learned <= 5.0 < file


@pytest.mark.slow
@pytest.mark.xfail(reason="3.3004 N against 3.3002 N of the observer with identified friction")
def test_force_observer(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    figure = tmp_path / "force.png"
    done = run("examples/force_observer/force_observer.py", "--seconds", "6", str(figure))
    assert done.returncode == 0, done.stderr
    assert figure.read_bytes().startswith(b"\x89PNG")
    result = json.loads(done.stdout.partition("figure: ")[0])
    assert result["samples"] == 6000 and result["errors"] == 0
    assert result["rmse"] < 0.5 * result["rmse of the observer, file"]
    assert result["rmse"] < result["rmse of the observer, identified"]
    assert result["coverage"] > 0.8, "six seconds are few"
    assert result["processor p50 [us]"] < 300.0


@pytest.mark.slow
def test_two_contacts(tmp_path: Path) -> None:
    text = example("two_contacts", tmp_path)
    for contact in ("table", "rail"):
        model, file, inside = numbers(
            rf"{contact}: .* error ([\d.]+) N, of the robot file alone ([\d.]+) N; within 2 sigma (\d+)%",
            text,
        )
        assert model < 0.2 * file and inside >= 90


@pytest.mark.slow
def test_custom_prior(tmp_path: Path) -> None:
    text = example("custom_prior", tmp_path)
    (own,), (general,) = (
        numbers(rf"prior on {n}: .* ([\d.]+) N m", text) for n in ("the hose", "all joint forces")
    )
    assert own < 0.7 * general


@pytest.mark.slow
def test_learn_a_surface(tmp_path: Path) -> None:
    text = example("learn_a_surface", tmp_path)
    off, bar = numbers(r"is ([\d.]+) degrees off .* ([\d.]+) \(1 sigma\)", text)
    assert off < 4.0 * bar < 0.1
    (claimed,), (learned,) = (numbers(rf"the {n} table: ([\d.]+) mm", text) for n in ("claimed", "learned"))
    assert learned < 0.01 * claimed


@pytest.mark.slow
@pytest.mark.xfail(reason="joint 3: ±2σ holds 85 % (88 asked); its drive of 0.05 kg m² is not significant")
def test_real_iiwa_friction(tmp_path: Path) -> None:
    text = example("real_iiwa_friction", tmp_path)
    rows = re.findall(r"iiwa_joint_\d +([\d.]+) +([\d.]+) +(\d+)%", text)
    assert len(rows) == 7
    before, after, covered = zip(*(map(float, row) for row in rows), strict=True)
    assert all(new < old for new, old in zip(after, before, strict=True))
    summary = re.search(r"robot file: ([\d.]+) \(geometric mean\)", text)
    assert summary is not None and float(summary[1]) < 0.5
    # The range that is asked of coverage on held-out segments of this log.
    assert all(88.0 <= share <= 98.0 for share in covered)


@pytest.mark.parametrize(
    ("script", "log"),
    [
        pytest.param("real_logs", "kuka_iiwa14", marks=pytest.mark.slow),
        ("real_contact", "hopper/teststand.urdf"),
    ],
)
def test_missing_logs_are_named(script: str, log: str) -> None:
    done = run(f"benchmarks/{script}.py", "--logs", "/nowhere")
    assert done.returncode == 1
    assert f"/nowhere/{log}: this log is not here" in done.stderr
    assert "--logs" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture(scope="module")
def real_foot(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Scores of the force on a real foot."""
    path = tmp_path_factory.mktemp("foot") / "result.json"
    done = run("benchmarks/real_contact.py", "--logs", str(REAL), "--json", str(path))
    assert done.returncode == 0, done.stderr
    return json.loads(path.read_text(encoding="utf-8"))


@real_logs
@pytest.mark.slow
@pytest.mark.xfail(
    strict=True, reason="fore-aft and vertical force with a sensor in training: 0.21 and 1.70 N (0.11, 0.73)"
)
def test_the_force_on_a_pushed_foot_is_as_good_as_least_squares(real_foot: dict[str, Any]) -> None:
    """Least squares with offset, gain, viscous, Coulomb and load friction leaves 0.11 and 0.73 N."""
    fore_aft, vertical = real_foot["pushed"]["forcegp sensor, second half"]["rmse_N"]
    assert fore_aft < 0.11 and vertical < 0.73


@real_logs
@pytest.mark.slow
@pytest.mark.xfail(
    strict=True,
    reason="errors on a hopping leg are 0.907 of the equations of motion's (0.9); pushed, ±2σ holds 63 %",
)
def test_the_force_on_a_real_foot_is_better_than_the_equations_of_motion(real_foot: dict[str, Any]) -> None:
    """Learned without the sensor from the other half."""
    result, ratios = real_foot, []
    for half in ("hopping, first half", "hopping, second half"):
        own, plain = (result[half][name] for name in ("forcegp", "equations of motion"))
        ratios += [a / b for a, b in zip(own["rmse_N"], plain["rmse_N"], strict=True)]
        assert min(own["coverage"]) >= 0.9
    assert math.prod(ratios) ** 0.25 <= 0.9 and max(ratios) <= 1.0
    own = result["pushed"]["forcegp, learned on hopping"]
    for name in ("static", "equations of motion"):
        assert all(a <= b for a, b in zip(own["rmse_N"], result["pushed"][name]["rmse_N"], strict=True))
    assert min(own["coverage"]) >= 0.9
    labels = result["contact labels"]
    assert labels["flight_found"] >= 0.9 and labels["stance_called_open"] <= 0.01
    assert abs(labels["lift_off_ms"]) <= 10.0 and abs(labels["landing_ms"]) <= 10.0
