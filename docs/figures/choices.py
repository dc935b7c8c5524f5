"""Draw the plots of the pages on choices: models, priors and stabilization, on the paper's task.

    python docs/figures/choices.py [model] [prior] [stabilization]

A KUKA iiwa slides over a table in simulation. All fits learn from one motion and are tested on another one.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from matplotlib.axes import Axes

import forcegp
from forcegp.models.base import Model
from forcegp.simulate import SimulationConfig, simulate

HERE = Path(__file__).resolve().parent
SIZES = (12, 25, 50, 100, 200)


def system() -> forcegp.ConstrainedSystem:
    return forcegp.load_scene("kuka_plane").system()


def logs() -> tuple[forcegp.Dataset, forcegp.Dataset]:
    """A training log and a log of another motion, 20 s and 10 s."""
    motions = (SimulationConfig(duration=20.0, seed=0), SimulationConfig(duration=10.0, seed=1))
    train, test = (simulate(system(), motion).data for motion in motions)
    return train, test[::5]


Curves = dict[str, list[float]]


def errors(models: Mapping[str, Model], train: forcegp.Dataset, test: forcegp.Dataset) -> Curves:
    """Mean error against noise-free accelerations of each model at each training size."""
    curves: Curves = {}
    for name, model in models.items():
        curves[name] = []
        for count in SIZES:
            fit = model.fit(train[:: len(train) // count][:count])
            mean = fit.predict(test.q, test.qd, test.tau).mean
            curves[name].append(float((mean - test.qdd_clean).abs().mean()))
            print(f"{name}, {count} samples: {curves[name][-1]:.4f} rad/s²", flush=True)
    return curves


def draw_errors(curves: Curves, file: float, name: str) -> None:
    _, axis = plt.subplots()
    axis.axhline(file, color="black", ls="--", lw=1, label="robot file, nothing learned")
    for label, values in curves.items():
        axis.loglog(SIZES, values, "o-", ms=4, label=label)
    axis.set(xlabel="training samples", ylabel="error of q̈ on another motion [rad/s²]")
    axis.set_xticks(SIZES, [str(size) for size in SIZES], minor=False)
    axis.minorticks_off()
    finished(axis, name)


def finished(axis: Axes, name: str) -> None:
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    axis.figure.savefig(HERE / f"choose_{name}.svg", metadata={"Date": None})


def nominal(test: forcegp.Dataset) -> float:
    mean = forcegp.AnalyticalModel(system()).nominal().predict(test.q, test.qd, test.tau).mean
    return float((mean - test.qdd_clean).abs().mean())


def model() -> None:
    train, test = logs()
    models = {
        "gp": forcegp.models.IndependentGP(system()),
        "sgp-zero": forcegp.StructuredGP(system(), "zero"),
        "sgp": forcegp.StructuredGP(system(), mean="analytical"),
    }
    draw_errors(errors(models, train, test), nominal(test), "model")


def prior() -> None:
    train, test = logs()
    priors = {
        "JointForcePrior": forcegp.priors.JointForcePrior(),
        "ContactForcePrior": forcegp.priors.ContactForcePrior("table"),
        "SlidingFrictionPrior": forcegp.priors.SlidingFrictionPrior("table"),
    }
    models = {name: forcegp.StructuredGP(system(), "analytical", [one]) for name, one in priors.items()}
    draw_errors(errors(models, train, test), nominal(test), "prior")


def stabilization() -> None:
    from forcegp.rollout import RolloutOptions

    log = simulate(system(), SimulationConfig(duration=10.0, seed=1)).data
    fit = forcegp.StructuredGP(system(), "analytical").fit(log[::40])
    _, axis = plt.subplots()
    for stabilization in ("none", "baumgarte", "projection"):
        for method, style in (("semi_implicit_euler", "-"), ("rk4", ":")):
            options = RolloutOptions(method=method, stabilization=stabilization)
            path = fit.rollout(log.q[0], log.qd[0], log, duration=5.0, options=options)
            drift = path.drift.abs().reshape(len(path.t), -1).amax(-1).clamp_min(1e-17)
            color = {"none": "C1", "baumgarte": "C0", "projection": "C2"}[stabilization]
            axis.semilogy(path.t, drift, style, color=color, lw=1, label=f"{stabilization}, {method}")
            print(f"{stabilization}, {method}: {float(drift.max()):.1e} m", flush=True)
    axis.set(xlabel="time [s]", ylabel="distance from the surface |c| [m]")
    finished(axis, "stabilization")


if __name__ == "__main__":
    torch.set_num_threads(1)
    plt.rcParams.update({"figure.figsize": (5.2, 3.0), "font.size": 9, "svg.hashsalt": "forcegp"})
    plt.rcParams.update({"axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False})
    plt.rcParams.update({"axes.grid": True, "grid.alpha": 0.3, "savefig.bbox": "tight"})
    for name in sys.argv[1:] or ("model", "prior", "stabilization"):
        globals()[name]()
