"""Draw the picture of the README: contact force of a UR5 with error bars, against a load cell.

    python docs/figures/contact_force.py

The log is `examples/data/ur5_wiping.csv`, in which MuJoCo's contact solver made the contact. The model is
trained on the first 15 s and has never seen a force; the last 5 s are drawn. Prints bias, spread, coverage.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import torch
from pyarrow import csv

import forcegp
from forcegp.logs import parse_mapping

HERE = Path(__file__).resolve().parent
LOG = HERE.parents[1] / "examples" / "data" / "ur5_wiping.csv"
MAPPING = LOG.with_suffix(".mapping.toml")
SPLIT, STEP = 15.0, 16
"""End of the training data [s], and which of their samples are taken: every STEP-th."""


def main() -> None:
    system = forcegp.load_scene("ur5_wiping").system()
    data = forcegp.read_log(LOG, system, parse_mapping(MAPPING.read_bytes(), "mapping"))
    load_cell = torch.tensor(csv.read_csv(LOG)["table_force"].to_numpy())
    quiet = data.impact["table"] == 0
    fit = forcegp.StructuredGP(system, mean="analytical").fit(data[(data.t < SPLIT) & quiet][::STEP])

    late = data.t >= SPLIT
    test, truth, closed = data[late], load_cell[late], data.contact["table"][late]
    force = fit.predict(test.q, test.qd, test.tau, "multiplier", active=test.active(["table"]), noise=True)
    assert force.std is not None
    mean, std = force.mean[:, 0], force.std[:, 0]
    counted = closed & quiet[late]
    error = (mean - truth)[counted]
    covered = float((error.abs() <= 2.0 * std[counted]).double().mean())
    print(f"bias {error.mean():.2f} N, standard deviation {error.std():.2f} N, within ±2σ {covered:.0%}")

    drawn = [torch.where(closed, x, torch.nan) for x in (mean - 2.0 * std, mean + 2.0 * std, mean)]
    figure, axis = plt.subplots(figsize=(8.0, 2.8))
    axis.fill_between(test.t, drawn[0], drawn[1], alpha=0.3, lw=0, label="±2σ")
    axis.plot(test.t, drawn[2], lw=1.5, label="predicted from motion and torques")
    axis.plot(test.t, truth, "k", lw=0.8, label="load cell, not seen by the model")
    axis.set(xlabel="time [s]", ylabel="normal force [N]", xlim=(SPLIT, float(test.t[-1])), ylim=(0.0, None))
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.2))
    figure.savefig(HERE / "contact_force.png", dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
