"""Torque errors on real logs as pictures: one per test, one panel per joint, one bar per model."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def draw_errors(folder: Path, case: str, tests: dict[str, dict[str, dict]]) -> None:
    """Write `<case>_<test>.svg` for every test of a case."""
    folder.mkdir(parents=True, exist_ok=True)
    for test, by_model in tests.items():
        names = list(by_model)
        joints = range(len(by_model[names[0]]["torque_rmse"]))
        figure, axes = plt.subplots(
            1, len(joints), figsize=(2.0 + 1.5 * len(joints), 2.8), sharey=True, layout="constrained"
        )
        for joint, ax in zip(joints, axes, strict=True):
            errors = [by_model[name]["torque_rmse"][joint] for name in names]
            colours = ["C1" if name.startswith("structured") else "0.6" for name in names]
            ax.barh(names, errors, color=colours)
            ax.set_title(f"joint {joint + 1}", fontsize=9)
            ax.tick_params(labelsize=8)
        axes[0].invert_yaxis()
        figure.supxlabel("root-mean-square torque error [N m]", fontsize=9)
        figure.suptitle(f"{case}: {test}", fontsize=10)
        name = "_".join(re.findall(r"\w+", f"{case} {test}".lower()))
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        plt.close(figure)
