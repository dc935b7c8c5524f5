"""Code that uses the public interface passes pyright in strict mode."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import forcegp

PROGRAM = """# pyright: strict
import forcegp
from forcegp.simulate import SimulationConfig, simulate

scene = forcegp.load_scene("kuka_plane")
system = scene.system()
data = simulate(system, SimulationConfig(duration=2.0)).data[::16]
plane = forcegp.Plane(normal=(0, 0, 1), offset=0.1)
tip = forcegp.SurfaceContact("tip", "tool", (0, 0, 0.1), plane, radius=0.01)
other = forcegp.ConstrainedSystem(forcegp.load_robot("ur5"), [tip], forcegp.constraints.Baumgarte())
theta = forcegp.robot.AnalyticalParameters(system.robot, {"mass": ["joint"], "damping": "all"})
sliding = forcegp.priors.SlidingFrictionPrior("table", terms=("viscous", "dry"))
priors = [sliding, forcegp.priors.JointFrictionPrior()]
noise = forcegp.Noise(torque="learn")
model = forcegp.StructuredGP(system, "analytical", priors, noise, analytical_parameters=theta)
sensed = forcegp.priors.Observation(data, "multiplier", noise_std=0.1)
fit = model.fit([forcegp.priors.Observation(data), sensed])
force = fit.predict(data.q, data.qd, data.tau, quantity="multiplier")
if force.std is not None:
    print(force.mean + 2.0 * force.std, fit.result.warnings, fit.hyperparameters)
path = fit.rollout(data.q[0], data.qd[0], data, samples=3, options=forcegp.rollout.RolloutOptions(dt=0.01))
print(path.q.shape, path.multiplier)
fit.save("model")
second = model.fit(data, learn=["noise"], after=fit).update(data)
print(second.condition(data).result.log_marginal_likelihood, second.forget(0.9).training.samples)
loaded = forcegp.load_model("model")
print(forcegp.evaluate(loaded, data).verdict, forcegp.check(system, data).verdict)
eom = other.equations(data.q, data.qd)
print(eom.A @ forcegp.dynamics.mass_matrix(theta(), data.q), eom.multiplier(eom.Q_K))
print(forcegp.StreamedDataset(("a.parquet", "b.parquet")).header.dt, forcegp.Dataset.read("a.parquet").t)
"""


PYRIGHT = shutil.which("pyright", path=str(Path(sys.executable).parent))


@pytest.mark.slow
@pytest.mark.skipif(PYRIGHT is None, reason="no pyright")
def test_strict_type_checker_accepts_code_that_uses_the_interface(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    (tmp_path / "forcegp").symlink_to(Path(str(forcegp.__file__)).parent, target_is_directory=True)
    command = [str(PYRIGHT), "--outputjson", "--pythonpath", sys.executable]
    done = subprocess.run([*command, "program.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    found = json.loads(done.stdout)["generalDiagnostics"]
    assert not [(one["range"]["start"]["line"] + 1, one["message"]) for one in found]
