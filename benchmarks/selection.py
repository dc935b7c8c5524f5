"""Force priors chosen by the data, beside every set that could have been chosen, on simulated logs.

    python benchmarks/selection.py --json result.json            # about half an hour
    python benchmarks/selection.py ur5_wiping kuka_plane --seconds 20

The simulated logs lose their seed and their noise-free accelerations, so that they look like any other log.
Models are trained on the first three quarters of each log and tested on the rest against the noise-free
accelerations. Printed by log: the chosen set, its mean absolute error and that of the best candidate, their
ratio, the shares of noise-free and of measured accelerations within ±2σ, and the duration of the fit.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
import warnings
from pathlib import Path
from typing import Any

import torch
from results_page import table

import forcegp
from forcegp.errors import ForceGPError
from forcegp.files import write_text
from forcegp.forces.priors.sets import SETS
from forcegp.simulate import Sensors, simulate

CLEAN = "qdd_clean"
NOISY = Sensors(encoder_resolution=1e-5, velocity_noise=1e-3, torque_noise=0.05)
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "kuka_plane": ("kuka_plane", {}),
    "kuka_sphere": ("kuka_sphere", {}),
    "kuka_two_points": ("kuka_two_points", {}),
    "panda_tilted": ("panda_tilted", {}),
    "pendulum_wire": ("pendulum_wire", {}),
    "panda_sphere": ("panda_sphere", {}),
    "panda_sphere, noisy": ("panda_sphere", {"sensors": NOISY}),
    "ur5_free": ("ur5_free", {}),
    "ur5_free, noisy": ("ur5_free", {"sensors": NOISY}),
    "ur5_wiping": ("ur5_wiping", {}),
    "ur5_wiping, noisy": ("ur5_wiping", {"sensors": NOISY}),
}
"""Scene and changes of its simulation. MuJoCo's solver makes the contact of the last six."""


def parts_of(case: str, seconds: float, seed: int) -> tuple[Any, forcegp.Dataset, forcegp.Dataset]:
    """System, training part without a word of its origin, and test part of a simulated log."""
    name, changes = CASES[case]
    scene = forcegp.load_scene(name)
    system = scene.system()
    log = simulate(system, dataclasses.replace(scene.simulation, duration=seconds, seed=seed, **changes)).data
    split = len(log) * 3 // 4
    header = log.header.model_copy(update={"seed": None, "provenance": None})
    train = log[:split].replace(header=header, extras={}, contact_extras={})
    return system, train, log[split:]


def tested(fit: Any, system: Any, test: forcegp.Dataset) -> tuple[float, float, float]:
    """Mean absolute error of noise-free accelerations [rad/s²], and coverage of these and of measured ones by
    ±2σ; σ of the latter contains the noise of torque and acceleration."""
    active = test.active(system.contact_names)
    clean, noisy = (
        fit.predict(test.q, test.qd, test.tau, active=active, noise=noise) for noise in (False, True)
    )
    error, missed = (clean.mean - test.extras[CLEAN]).abs(), (clean.mean - test.qdd).abs()
    covered = [float((e <= 2.0 * s).double().mean()) for e, s in ((error, clean.std), (missed, noisy.std))]
    return float(error.mean()), covered[0], covered[1]


def compared(case: str, seconds: float, seed: int) -> dict[str, Any]:
    """One log: the choice of the data, and every set that fits the system."""
    system, train, test = parts_of(case, seconds, seed)
    begin = time.perf_counter()
    fit = forcegp.StructuredGP(system, "analytical").fit(train)
    result: dict[str, Any] = {"case": case, "rows": len(train), "seconds": time.perf_counter() - begin}
    chosen = next(each.name for each in fit.result.comparison if each.chosen)
    result |= {"chosen": chosen, "table": [vars(each) for each in fit.result.comparison]}
    result["error"], result["coverage"], result["measured"] = tested(fit, system, test)
    others: dict[str, Any] = {chosen: result["error"]}
    for name, each in SETS.items():
        for inertia in ("file", "auto") if each.has_joint_friction else ("file",):
            label = name + (", inertia identified" if inertia == "auto" else "")
            if each.fits(system) and label not in others:
                try:
                    other = forcegp.StructuredGP(system, "analytical", name, inertia=inertia).fit(train)
                    others[label] = tested(other, system, test)[0]
                except ForceGPError as error:
                    others[label] = str(error).splitlines()[0]
    result["candidates"] = others
    result["best"] = min(x for x in others.values() if isinstance(x, float))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", nargs="*", default=list(CASES), help="logs; default: all")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each log [s]")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--json", type=Path, help="write the results there")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(2)
    results = []
    for case in arguments.cases:
        results.append(compared(case, arguments.seconds, arguments.seed))
        last = results[-1]
        print(
            f"{case:22} {last['chosen']:38} error {last['error']:.5f} best {last['best']:.5f} "
            f"ratio {last['error'] / last['best']:.2f} coverage {last['coverage']:.3f} "
            f"measured {last['measured']:.3f} "
            f"{last['seconds']:.0f} s",
            flush=True,
        )
        if arguments.json:
            write_text(arguments.json, json.dumps(results, indent=1))
    header = ["log", "chosen", "error [rad/s²]", "best candidate", "ratio", "±2σ", "±2σ, measured"]
    rows = [
        [r["case"], r["chosen"], f"{r['error']:.5f}", f"{r['best']:.5f}", f"{r['error'] / r['best']:.2f}",
         f"{r['coverage']:.3f}", f"{r['measured']:.3f}"] for r in results
    ]  # fmt: skip
    print(table(header, rows))


if __name__ == "__main__":
    main()
