"""Torque errors on real logs as pictures: one per test, with a panel per joint and a bar per model."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLUMNS = 2


def draw_errors(folder: Path, case: str, tests: dict[str, dict[str, dict]]) -> None:
    """Write `<case>_<test>.svg` for every test of a case."""
    folder.mkdir(parents=True, exist_ok=True)
    for test, by_model in tests.items():
        names = list(by_model)
        joints = len(by_model[names[0]]["torque_rmse"])
        rows = -(-joints // COLUMNS)
        size = (6.4, 0.6 + 2.0 * rows)
        figure, axes = plt.subplots(
            rows, COLUMNS, figsize=size, sharey=True, squeeze=False, layout="constrained"
        )
        for joint, ax in enumerate(axes.flat[:joints]):
            errors = [by_model[name]["torque_rmse"][joint] for name in names]
            colours = ["C1" if name.startswith("structured") else "0.6" for name in names]
            ax.barh(names, errors, color=colours)
            ax.set_title(f"joint {joint + 1}")
        axes[0, 0].invert_yaxis()
        for ax in axes.flat[joints:]:
            ax.set_axis_off()
        figure.supxlabel("root-mean-square torque error [N m]")
        figure.suptitle(f"{case}: {test}")
        name = "_".join(re.findall(r"\w+", f"{case} {test}".lower()))
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        plt.close(figure)
