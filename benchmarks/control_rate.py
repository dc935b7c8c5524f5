"""Microseconds per call of a fit as C, from C and from Python.

    python benchmarks/control_rate.py --json result.json

A KUKA iiwa in one contact (`kuka_plane`, simulated), with three models: `friction`, the default of a measured
robot (some 50 functions); the same with uncertain inertia (some 120); and `residual`, with inducing points
of a residual force of 21 inputs (some 460). Nothing is learned: time does not depend on hyperparameters.
The C code is compiled by gcc with `-O3 -march=native -ffp-contract=fast` and with `-O2`, both `-std=c99`,
and runs on one core over 256 logged states, contact closed; the time is the least mean of several rounds.
The Jacobian is that of q̈ and λ by q, q̇ and τ, mean included; the CasADi function gives the same.
Peers in the same run, if they are installed: `predict` and `update` of the fit; for the mechanics alone
Pinocchio's `aba`, from Python and in C++, and for the Gaussian processes alone GPyTorch, from Python (`pip
install --target peers --no-deps gpytorch linear_operator mpmath cmeel-eigen`, on PYTHONPATH). Updates are
timed four at a time, to be short beside the time slices of a shared core.

Then 100 function samples are rolled out for 10 s, and the examples of the force observer (60 s) and of
predictive control run. `quadruped` times `contact_force` of all four feet of a Solo12 (`legs.py`, friction
`coulomb`) with its covariance, and predictions, both without learning online and without Jacobians.

Times of calls are least ones, those of rollouts and control steps processor time.
`--only` measures a part. It takes some eight minutes, two of them for Pinocchio in C++.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import forcegp
from forcegp import dynamics
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointForcePrior, JointFrictionPrior
from forcegp.forces.priors.sets import friction_priors
from forcegp.gp.kernels import Matern32
from forcegp.gp.sparse import SparsePosterior
from forcegp.learning.specification import REST_SPEED
from forcegp.models.export.casadi_function import casadi_function
from forcegp.models.export.library import CompiledFit
from forcegp.models.prediction import Predictor
from forcegp.models.structured_fit import StructuredFit
from forcegp.rollout import RolloutOptions, inputs
from forcegp.simulate import SimulationConfig, simulate

POINTS, STATES, ROUNDS, SAMPLES = 71, 256, 60, 100
EXAMPLES = Path(__file__).parents[1] / "examples"
PARTS = ("calls", "rollouts", "observer", "tracking", "force", "quadruped")
LEVELS = {"-O3": ["-O3", "-march=native", "-ffp-contract=fast"], "-O2": ["-O2"]}
BOUNDS = {  # µs, at -O3
    "friction mean": 8.0,
    "friction covariance": 30.0,
    "friction+inertia mean": 8.0,
    "friction+inertia covariance": 30.0,
    "residual mean": 20.0,
    "residual covariance": 120.0,
    "residual jacobian": 60.0,
    "forward dynamics": 1.0,
    **{f"{name} mean python": 50.0 for name in ("friction", "friction+inertia", "residual")},
    **{f"{name} covariance python": 150.0 for name in ("friction", "friction+inertia", "residual")},
    # without `compiled()`
    "friction mean python predict": 1500.0,
    "residual update": 400.0,
    "python update": 600.0,
    # s of processor time for 100 trajectories of 10 s
    "friction rollout": 5.0,
    "residual rollout": 8.0,
    # µs of processor time; RMSE beside that of momentum observers
    "observer processor p99.9": 300.0,
    "observer rmse / file": 0.5,
    "observer rmse / identified": 1.0,
    "observer coverage above": -0.90,
    "observer coverage below": 0.98,
    # tracking error beside that of the file; ms; share of steps with the force outside its bound
    "tracking error / file": 0.5,
    "tracking solve": 20.0,
    "force outside": 0.05,
    "force solve": 20.0,
    # µs
    "quadruped feet": 40.0,
}
KINDS = ("mean", "covariance", "forward dynamics", "update", "covariance after updates", "jacobian")
PROGRAM = """\
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include "controller.h"
#include "states.h"

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec;
}

int main(void) {
  static double mean[64], covariance[64 * 64], beyond[64], jacobian[64 * 21];
  static controller_learned learned;
  double best[6] = {1e30, 1e30, 1e30, 1e30, 1e30, 1e30}, sink = 0.0;
  controller_begin(&learned);
  for (int round = 0; round < ROUNDS; ++round)
    for (int kind = 0; kind < 6; ++kind) {
      const int states = kind < 3 || kind == 5 ? STATES : STATES / 64; /* short: a shared core */
      const double start = now();
      for (int i = 0; i < states; ++i) {
        if (kind == 2)
          controller_forward_dynamics(q[i], qd[i], tau[i], mean);
        else if (kind == 3) {
          if (controller_update(&learned, q[i], qd[i], tau[i], NULL, CONTROLLER_QDD, qdd[i], NULL)) return 2;
        } else if (kind == 4) {
          if (controller_predict_learned(&learned, 1, q[i], qd[i], tau[i], NULL,
                                         CONTROLLER_QDD | CONTROLLER_MULTIPLIER, 0, mean, covariance, beyond))
            return 3;
        } else if (kind == 5) {
          if (controller_jacobian(q[i], qd[i], tau[i], NULL, CONTROLLER_QDD | CONTROLLER_MULTIPLIER, mean,
                                  jacobian))
            return 4;
        } else if (controller_predict(q[i], qd[i], tau[i], NULL, CONTROLLER_QDD | CONTROLLER_MULTIPLIER, 0,
                                    mean, kind ? covariance : NULL, beyond))
          return 1;
        sink += mean[0];
      }
      const double each = (now() - start) / states;
      best[kind] = each < best[kind] ? each : best[kind];
    }
  for (int kind = 0; kind < 6; ++kind) printf("%g ", best[kind]);
  printf("%g\\n", sink);
  return 0;
}
"""


QUADRUPED = """\
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include "controller.h"
#include "states.h"

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec;
}

int main(void) {
  static double mean[64], covariance[64 * 64];
  double best[3] = {1e30, 1e30, 1e30}, sink = 0.0;
  for (int round = 0; round < ROUNDS; ++round)
    for (int kind = 0; kind < 3; ++kind) {
      const double start = now();
      for (int i = 0; i < STATES; ++i) {
        const int status =
            kind == 0 ? controller_contact_force(NULL, 1, q[i], qd[i], tau[i], qdd[i], NULL, NULL, mean,
                                                 covariance, NULL)
                      : controller_predict(q[i], qd[i], tau[i], NULL, CONTROLLER_QDD | CONTROLLER_MULTIPLIER,
                                           0, mean, kind == 1 ? NULL : covariance, NULL);
        if (status != 0 && status != CONTROLLER_UNDETERMINED) return 1;
        sink += mean[0];
      }
      const double each = (now() - start) / STATES;
      best[kind] = each < best[kind] ? each : best[kind];
    }
  printf("%g %g %g %g\\n", best[0], best[1], best[2], sink);
  return 0;
}
"""


def models() -> dict[str, StructuredFit]:
    """The fits, conditioned at the hyperparameters where learning begins."""
    system = forcegp.load_scene("kuka_plane").system()
    data = simulate(system, SimulationConfig(duration=4.0, seed=1)).data
    few = data[:: len(data) // 400]
    fits = {}
    for name, more in (("friction", []), ("friction+inertia", [InertialPrior()])):
        priors = [*friction_priors(system), *more]
        fits[name] = forcegp.StructuredGP(system, "analytical", priors, noise=0.1).fit(few, learn=[])
    rough = JointForcePrior(Matern32(shared=True))
    model = forcegp.StructuredGP(
        system,
        "analytical",
        [JointFrictionPrior(), rough],
        noise=0.1,
        inference=forcegp.models.Inference("sparse", inducing_points=POINTS),
    )
    fits["residual"] = model.fit(few, learn=[])
    return fits


def logged(fit: StructuredFit) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Training states in motion, and accelerations there."""
    m = fit.training.moving(REST_SPEED).measurements[0]
    return m.q[:STATES], m.qd[:STATES], m.tau[:STATES], m.values[:STATES]


def states_in_c(states: Sequence[Tensor]) -> str:
    """Logged states as C tables."""
    lines = [f"enum {{ STATES = {len(states[0])}, ROUNDS = {ROUNDS} }};"]
    for name, x in zip(("q", "qd", "tau", "qdd"), states, strict=True):
        rows = ", ".join("{" + ", ".join(map(repr, row)) + "}" for row in x.tolist())
        lines.append(f"static const double {name}[STATES][{x.shape[1]}] = {{{rows}}};")
    return "\n".join(lines)


def in_c(fit: StructuredFit, flags: list[str]) -> dict[str, float]:
    """µs of each of `KINDS`."""
    with tempfile.TemporaryDirectory() as place:
        folder = fit.export(Path(place) / "c").folder
        (folder / "states.h").write_text(states_in_c(logged(fit)))
        (folder / "time.c").write_text(PROGRAM)
        command = ["gcc", "-std=c99", *flags, "time.c", "controller.c", "-o", "run", "-lm"]
        subprocess.run(command, cwd=folder, check=True)
        done = subprocess.run([str(folder / "run")], capture_output=True, text=True, check=True)
    return dict(zip(KINDS, map(float, done.stdout.split()), strict=False))


def in_python(call: Callable[[int], object], calls: int = 32) -> float:
    """µs of a call from Python, the least mean of several rounds."""
    best = float("inf")
    for _ in range(640 // calls):
        start = time.perf_counter()
        for i in range(calls):
            call(i)
        best = min(best, 1e6 * (time.perf_counter() - start) / calls)
    return best


def predicting(predictor: Predictor, fit: StructuredFit, covariance: bool) -> float:
    """µs of `predict` of q̈ and λ at single states."""
    q, qd, tau, _ = logged(fit)
    return in_python(
        lambda i: predictor.predict(q[i], qd[i], tau[i], ["qdd", "multiplier"], covariance=covariance)
    )


def linearizing(predictor: Predictor, fit: StructuredFit) -> float:
    """µs of `linearize`: q̈ and λ with their Jacobians by q, q̇ and τ."""
    q, qd, tau, _ = logged(fit)
    return in_python(lambda i: predictor.linearize(q[i], qd[i], tau[i]))


def in_casadi(fit: StructuredFit) -> float:
    """µs of the same by the CasADi function, called from Python."""
    f = casadi_function(fit._exported(None))
    outputs = [f"jac:{z}:{x}" for z in ("qdd", "multiplier") for x in ("q", "qd", "tau")]
    slopes, states = f.factory("slopes", f.name_in(), ["qdd", "multiplier", *outputs]), logged(fit)
    return in_python(lambda i: slopes(*(x[i].numpy() for x in states[:3]), 1.0))


def updating(predictor: CompiledFit | StructuredFit, fit: StructuredFit) -> float:
    """µs of `update` with one sample."""
    q, qd, tau, qdd = logged(fit)
    if isinstance(predictor, CompiledFit):
        begun = predictor.update(q[0], qd[0], tau[0], qdd[0])
        return in_python(lambda i: begun.update(q[i], qd[i], tau[i], qdd[i]), 4)
    names, t = fit.system.robot.joint_names, torch.arange(len(q), dtype=torch.float64)
    closed = {name: torch.ones(len(q), dtype=torch.bool) for name in fit.system.contact_names}
    data = forcegp.Dataset(t, q, qd, tau, qdd, names, contact=closed)
    samples = [data[i : i + 1] for i in range(4)]
    return in_python(lambda i: predictor.update(samples[i]), 4)


def pinocchio(fit: StructuredFit) -> float | None:
    """µs of Pinocchio's articulated-body algorithm from Python."""
    try:
        import pinocchio
    except ImportError:
        return None
    path = Path(forcegp.__file__).parent / "robot/bundled/kuka_iiwa.urdf"
    pin: Any = pinocchio
    model = pin.buildModelFromUrdf(str(path))
    data, states = model.createData(), [x.numpy() for x in logged(fit)[:3]]
    return in_python(lambda i: pin.aba(model, data, *(x[i] for x in states)))


PINOCCHIO = """\
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/multibody.hpp>
#include <pinocchio/serialization.hpp>
#include <chrono>
#include <cstdio>
#include <vector>
#include "states.h"

int main() {
  pinocchio::Model model;
  model.loadFromText("model.txt");
  pinocchio::Data data(model);
  double best = 1e30, sink = 0.0;
  std::vector<Eigen::VectorXd> x;
  typedef Eigen::Map<const Eigen::VectorXd> V;
  for (int i = 0; i < STATES; ++i)
    x.push_back(V(q[i], 7)), x.push_back(V(qd[i], 7)), x.push_back(V(tau[i], 7));
  for (int round = 0; round < ROUNDS; ++round) {
    const auto start = std::chrono::steady_clock::now();
    for (int i = 0; i < STATES; ++i)
      sink += pinocchio::aba(model, data, x[3 * i], x[3 * i + 1], x[3 * i + 2])[0];
    const std::chrono::duration<double, std::micro> time = std::chrono::steady_clock::now() - start;
    best = std::min(best, time.count() / STATES);
  }
  std::printf("%g %g\\n", best, sink);
}
"""


def pinocchio_in_cpp(fit: StructuredFit) -> float | None:
    """µs of the same in C++, by the library in the wheel, if that of Eigen, `cmeel-eigen`, is installed."""
    places = [Path(x) / "cmeel.prefix" for x in sys.path]
    eigen = [x / "include/eigen3" for x in places if (x / "include/eigen3").is_dir()]
    prefix = [x for x in places if (x / "include/pinocchio").is_dir()]
    if not eigen or not prefix:
        return None
    import pinocchio

    pin: Any = pinocchio
    with tempfile.TemporaryDirectory() as place:
        robot = Path(forcegp.__file__).parent / "robot/bundled/kuka_iiwa.urdf"
        pin.buildModelFromUrdf(str(robot)).saveToText(str(Path(place) / "model.txt"))
        (Path(place) / "states.h").write_text(states_in_c(logged(fit)))
        (Path(place) / "aba.cpp").write_text(PINOCCHIO)
        flags = ["-std=c++17", "-O2", "-DNDEBUG", "-w", "-DPINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION"]
        flags += ["-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"]
        flags += [f"-I{prefix[0] / 'include'}", f"-I{eigen[0]}"]
        library = prefix[0] / "lib"
        link = [f"-L{library}", f"-Wl,-rpath,{library}", "-lpinocchio_default", "-lboost_serialization"]
        subprocess.run(["g++", *flags, "aba.cpp", "-o", "aba", *link], cwd=place, check=True)
        done = subprocess.run(["./aba"], cwd=place, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[0])


def gpytorch(fit: StructuredFit) -> dict[str, float]:
    """µs of GPyTorch's fast predictive variances for the Gaussian processes of `residual` alone, one for each
    joint over `POINTS` points, without mechanics."""
    try:
        import gpytorch as package
    except ImportError:
        return {}
    gp: Any = package
    q, qd, tau, qdd = logged(fit)
    x, joints = torch.cat([q, qd, tau], dim=-1), torch.Size([7])

    class Model(gp.models.ExactGP):
        def __init__(self) -> None:
            super().__init__(x[:POINTS].expand(7, -1, -1), qdd[:POINTS].mT, noise)
            self.mean = gp.means.ZeroMean(batch_shape=joints)
            kernel = gp.kernels.MaternKernel(nu=1.5, ard_num_dims=x.shape[1], batch_shape=joints)
            self.kernel = gp.kernels.ScaleKernel(kernel, batch_shape=joints)

        def forward(self, at: Tensor) -> Any:
            return gp.distributions.MultivariateNormal(self.mean(at), self.kernel(at))

    noise = gp.likelihoods.GaussianLikelihood(batch_shape=joints).double()
    model = Model().double().eval()

    def read(i: int, covariance: bool) -> object:
        found = model(x[i].expand(7, 1, -1))
        return (found.mean, found.variance) if covariance else found.mean

    times = {}
    for name, fast in (
        ("mean", gp.settings.skip_posterior_variances),
        ("variance", gp.settings.fast_pred_var),
    ):
        with torch.no_grad(), fast():
            times[f"residual {name} gpytorch from python"] = in_python(
                lambda i, spread=name == "variance": read(i, spread)
            )
    return times


def calls(name: str, fit: StructuredFit) -> dict[str, float]:
    """Times of single calls, µs."""
    latent = fit.posterior.latent
    assert isinstance(latent, SparsePosterior)
    result: dict[str, float] = {f"{name} functions": latent.basis.size}
    for level, flags in LEVELS.items():
        for what, value in in_c(fit, flags).items():
            result[f"{name} {what} {level}"] = value
    fast = fit.compiled()
    for kind, predictor in (("compiled", fast), ("predict", fit)):
        for what, covariance in (("mean", False), ("covariance", True)):
            result[f"{name} {what} python {kind}"] = predicting(predictor, fit, covariance)
    result[f"{name} jacobian python compiled"] = linearizing(fast, fit)
    if importlib.util.find_spec("casadi") and name == "friction":
        result[f"{name} jacobian casadi"] = in_casadi(fit)
    result[f"{name} update python compiled"] = updating(fast, fit)
    result[f"{name} update python predict"] = updating(fit, fit)
    result |= gpytorch(fit) if name == "residual" else {}
    if name == "friction" and (peer := pinocchio(fit)) is not None:
        result["forward dynamics pinocchio from python"] = peer
    if name == "friction" and (peer := pinocchio_in_cpp(fit)) is not None:
        result["forward dynamics pinocchio in C++"] = peer
    return result


def quadruped() -> dict[str, float]:
    """µs of the forces of four closed feet and of predictions; s of the export and of the compiler."""
    import legs

    legged = legs.Legged("solo12", "coulomb", 3)
    gaits = legs.gaits(legged)
    parts = ((legged.sway(), 4.0), (gaits["trot"], 6.0))
    train = forcegp.Dataset.concatenate([legs.dataset(legged, legged.record(*part)) for part in parts])
    walk = legs.dataset(legged, legged.record(gaits["walk"], 4.0))[::10]
    fit = forcegp.StructuredGP(legs.system_of(legged)).fit(train[::5])
    latent, result = fit.posterior.latent, dict[str, float]()
    assert isinstance(latent, SparsePosterior)
    result["quadruped functions"] = latent.basis.size
    for jacobians in (False, True):
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory() as place:
            folder = fit.export(Path(place) / "c", jacobians=jacobians, online=False).folder
            (folder / "states.h").write_text(states_in_c((walk.q, walk.qd, walk.tau, walk.qdd)))
            (folder / "time.c").write_text(QUADRUPED)
            command = ["gcc", "-std=c99", *LEVELS["-O3"], "time.c", "controller.c", "-o", "run", "-lm"]
            subprocess.run(command, cwd=folder, check=True)
            seconds = time.perf_counter() - begin
            done = subprocess.run([str(folder / "run")], capture_output=True, text=True, check=True)
        result[f"quadruped export and gcc [s]{', jacobians' if jacobians else ''}"] = seconds
        if not jacobians:
            names = ("feet", "mean", "covariance")
            result |= {
                f"quadruped {x} -O3": float(y) for x, y in zip(names, done.stdout.split(), strict=False)
            }
    return result


def rolled_out(name: str, fit: StructuredFit) -> dict[str, float]:
    """Seconds of processor time of function samples that follow another run for 10 s at 240 Hz, and of making
    the C code before."""
    run = simulate(fit.system, SimulationConfig(duration=10.1, seed=2)).data
    gains, rate = 25.0 * dynamics.mass_matrix(fit.system.robot, run.q[0]).diagonal(), 1.0 / inputs.STEP

    def law(t: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        k = (t[..., 0] * rate + 0.5).long().clamp(max=len(run) - 1)
        return run.tau[k] + gains * ((run.q[k] - q) + 0.4 * (run.qd[k] - qd))

    kept, empty = os.environ.get("FORCEGP_CACHE"), tempfile.TemporaryDirectory()
    os.environ["FORCEGP_CACHE"] = empty.name  # so that the C code is compiled
    begin = time.process_time() + resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    fit.compiled_motion(RolloutOptions().stabilized(fit.system), fit.force_field())
    made = time.process_time() + resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - begin
    os.environ.pop("FORCEGP_CACHE")
    os.environ |= {} if kept is None else {"FORCEGP_CACHE": kept}
    empty.cleanup()
    begin, options = time.process_time(), RolloutOptions(on_divergence="keep")
    path = fit.rollout(run.q[0], run.qd[0], law, 10.0, SAMPLES, options=options)
    seconds = time.process_time() - begin
    assert path.samples is not None and not path.samples.diverged, "a trajectory that ends early is fast"
    return {f"{name} rollout": seconds, f"{name} rollout, C code made before": made}


def shown(example: str, *arguments: str) -> str:
    """What an example prints."""
    with tempfile.TemporaryDirectory() as place:
        command = [sys.executable, str(EXAMPLES / example), *arguments, str(Path(place) / "figure.png")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    return done.stdout


def observer(seconds: float) -> dict[str, float]:
    """The force in a loop of 1 kHz, MuJoCo in another process."""
    text = shown("force_observer/force_observer.py", "--seconds", str(seconds))
    found = json.loads(text[text.index("{") : text.rindex("}") + 1])
    result = {f"observer {name}": value for name, value in found.items()}
    for name in ("file", "identified"):
        result[f"observer rmse / {name}"] = found["rmse"] / found[f"rmse of the observer, {name}"]
    result |= {"observer coverage below": found["coverage"], "observer coverage above": -found["coverage"]}
    return result | {"observer processor p99.9": found["processor p99.9 [us]"]}


def controlled(example: str, name: str, pattern: str) -> dict[str, float]:
    """A number of a controller with the robot file and with the learned model, and the time of a step, ms."""
    found = {}
    for line in shown(example).splitlines():
        model, _, rest = line.partition(":")
        if model in ("robot file", "learned"):
            number, solve = (re.search(x, rest) for x in (pattern, r"solve ([\d.]+) ms"))
            assert number is not None and solve is not None, line
            found[f"{name}, {model}"], found[f"{name} solve, {model}"] = float(number[1]), float(solve[1])
    return found | {f"{name.split()[0]} solve": found[f"{name} solve, learned"]}


def measure(parts: Sequence[str], seconds: float) -> dict[str, float]:
    """All results of some parts."""
    result: dict[str, float] = {}
    if {"calls", "rollouts"} & set(parts):
        for name, fit in models().items():
            result |= calls(name, fit) if "calls" in parts else {}
            result |= rolled_out(name, fit) if "rollouts" in parts and name != "friction+inertia" else {}
    result |= observer(seconds) if "observer" in parts else {}
    if "tracking" in parts:
        name = "tracking error [mrad]"
        result |= controlled("mpc_with_learned_friction.py", name, r"error ([\d.]+) mrad")
        result["tracking error / file"] = result[f"{name}, learned"] / result[f"{name}, robot file"]
    if "force" in parts:
        found = controlled("mpc_holds_a_force.py", "force outside [%]", r"in ([\d.]+)%")
        result |= found | {"force outside": found["force outside [%], learned"] / 100.0}
    result |= quadruped() if "quadruped" in parts else {}
    return result


def main() -> None:
    """Measure, print, and say which bounds hold."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path, help="file for the result")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to measure")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the loop of the observer")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    result = measure(arguments.only, arguments.seconds)
    for name, value in result.items():
        print(f"{name:52} {value:10.3f}")
    calls_of = {
        "forward dynamics": "friction forward dynamics -O3",
        "python update": "residual update python compiled",
    }
    calls_of |= {name: f"{name} compiled" for name in BOUNDS if name.endswith(" python")}
    found = {name: calls_of.get(name, name if name in result else f"{name} -O3") for name in BOUNDS}
    found = {name: result[key] for name, key in found.items() if key in result}
    for name, value in found.items():
        verdict = "holds" if value <= BOUNDS[name] else "MISSED"
        print(f"{name:52} {value:10.3f}  bound {BOUNDS[name]:7.2f}  {verdict}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"results": result, "bounds": BOUNDS, "found": found}, indent=1))


if __name__ == "__main__":
    main()
