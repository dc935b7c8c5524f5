"""Every bundled scene: simulate it, fit a model to a part of the log, and test it on the rest.

    python benchmarks/bundled_scenes.py
    python benchmarks/bundled_scenes.py panda_sphere ur5_wiping --duration 30 --points 200

The force priors are chosen by the log. Printed by scene: the set that was chosen; the error of the predicted
acceleration against the noise-free one, with the robot file alone and with the model; the share of measured
accelerations within ±2σ; and bias and standard deviation of the error of the normal force.
"""

from __future__ import annotations

import argparse
import dataclasses

from forcegp import ConstrainedSystem, Dataset, StructuredGP
from forcegp.data import split_by_stretches
from forcegp.evaluation import Evaluation, evaluate
from forcegp.models import LearningOptions
from forcegp.models.analytical import AnalyticalModel
from forcegp.models.registry import create
from forcegp.scene import BUNDLED, load_scene
from forcegp.simulate import simulate


def simulated(name: str, duration: float) -> tuple[ConstrainedSystem, Dataset]:
    """The system of a scene, and a log of it."""
    scene = load_scene(name)
    system, config = scene.system(), dataclasses.replace(scene.simulation, duration=duration)
    return system, simulate(system, config).data


def report(name: str, before: Evaluation, after: Evaluation) -> str:
    """One line of results."""
    assert before.clean is not None and after.clean is not None and after.uncertainty is not None
    coverage = after.uncertainty.coverage_noisy
    line = f"{name:16} {before.clean.rmse:12.4f} {after.clean.rmse:12.4f} {coverage:10.0%}"
    for force in after.multipliers:
        line += f"   {force.contact}: {force.bias:+.2f} ± {force.spread:.2f} N"
    return line


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=BUNDLED, help="names of bundled scenes; default all")
    parser.add_argument("--duration", type=float, default=20.0, help="of each log [s]")
    parser.add_argument("--points", type=int, default=100, help="training points")
    parser.add_argument("--evaluations", type=int, default=100, help="most evaluations of a fit")
    arguments = parser.parse_args()
    print(f"{'scene':16} {'file [rad/s2]':>12} {'model':>11} {'covered':>10}   normal force")
    for name in arguments.scenes:
        system, log = simulated(name, arguments.duration)
        split = split_by_stretches(log, arguments.points)
        train, test = log[split.train], log[split.test]
        options = LearningOptions(max_evaluations=arguments.evaluations)
        model = create("sgp", system)
        assert isinstance(model, StructuredGP)
        fit = model.fit(train, options=options)
        chosen = ", ".join(name for name, worth in fit.result.worth.items() if worth > 0.0)
        after = evaluate(fit, test, compare=False)
        before = evaluate(AnalyticalModel(system).nominal(), test, compare=False)
        print(report(name, before, after), f"  {chosen}", flush=True)


if __name__ == "__main__":
    main()
