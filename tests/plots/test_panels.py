"""Plots of data sets, predictions, models and rollouts: what stands on the axes is what the objects hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cache

import matplotlib
import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import FillBetweenPolyCollection

import forcegp
from forcegp.errors import ParameterError, ShapeError, UnknownNameError
from forcegp.models.structured_fit import StructuredFit
from forcegp.rollout.trajectory import FIELDS
from forces.cases import logged, two_contacts
from logs import JOINTS, random_log

matplotlib.use("Agg")

import matplotlib.pyplot as plt


@pytest.fixture(autouse=True)
def closed_figures() -> Iterator[None]:
    yield
    plt.close("all")


@cache
def fitted() -> StructuredFit:
    return forcegp.StructuredGP(two_contacts(), "analytical", noise=0.1).fit(
        logged(two_contacts(), 12), learn=[]
    )


def curve(axes: Axes, label: str) -> np.ndarray:
    """The y values of a curve, without its gaps."""
    line = next(line for line in axes.get_lines() if line.get_label() == label)
    y = np.asarray(line.get_ydata(), dtype=float)
    return y[~np.isnan(y)]


def band(axes: Axes) -> FillBetweenPolyCollection:
    found = [c for c in axes.collections if isinstance(c, FillBetweenPolyCollection)]
    assert len(found) == 1
    return found[0]


def test_a_data_set_at_a_glance() -> None:
    data = random_log(40)
    axes = data.plot()
    assert [a.get_ylabel().split("[")[1] for a in axes] == [
        "rad, m]",
        "rad/s, m/s]",
        "N m, N]",
        "rad/s², m/s²]",
        "N]",
    ]
    np.testing.assert_array_equal(curve(axes[2], "elbow"), data.tau[:, 1])
    assert axes[-1].get_xlabel() == "time [s]"


def test_one_quantity_of_some_joints() -> None:
    data = random_log(40)
    (axes,) = data.plot("qdd", joints=["wrist"])
    assert axes.get_title(loc="left") == "wrist"
    np.testing.assert_array_equal(curve(axes, "logged"), data.qdd[:, 2])
    (force,) = data.plot("F_I")
    np.testing.assert_array_equal(curve(force, "z"), data.F_I["table"][:, 2])
    for wrong in ({"quantity": "qddd"}, {"joints": ["wris"]}):
        with pytest.raises(UnknownNameError, match=r"qdd|wrist"):
            data.plot(**wrong)


def test_axes_of_the_caller_are_used() -> None:
    _, axes = plt.subplots(len(JOINTS))
    assert random_log(20).plot("q", ax=axes) == list(axes)
    assert plt.get_fignums() == [1]
    with pytest.raises(ParameterError, match="3 axes"):
        random_log(20).plot("q", ax=axes[0])


def test_predictions_stand_beside_measurements_with_their_band() -> None:
    model, data = fitted(), logged(two_contacts(), 10, seed=5)
    axes = model.plot(data, "qdd", joints=["lbr_iiwa_joint_2"])
    found = model.predict(data.q, data.qd, data.tau, active=data.active(("table", "ball")))
    np.testing.assert_allclose(curve(axes[0], "predicted"), found.mean[:, 1])
    np.testing.assert_array_equal(curve(axes[0], "measured"), data.qdd[:, 1])
    assert found.std is not None
    lower, upper = found.mean[:, 1] - 2 * found.std[:, 1], found.mean[:, 1] + 2 * found.std[:, 1]
    box = band(axes[0]).get_datalim(axes[0].transData)
    np.testing.assert_allclose((box.y0, box.y1), (lower.min(), upper.max()))
    assert axes[0].get_ylabel().endswith("[rad/s²]")
    assert "in contact" in [text.get_text() for text in axes[0].get_legend().get_texts()]


def test_forces_of_contacts_are_named() -> None:
    model, data = fitted(), logged(two_contacts(), 10, seed=5)
    axes = model.plot(data, "multiplier")
    assert [a.get_title(loc="left") for a in axes] == ["table", "ball"]
    np.testing.assert_array_equal(curve(axes[1], "measured"), data.multiplier["ball"])
    assert len(model.plot(data, "contact_force")) == 6
    (free,) = model.plot(data, "qdd_free", joints=["lbr_iiwa_joint_1"])
    assert "measured" not in free.get_legend_handles_labels()[1], "no log contains it"


def test_a_prediction_by_itself() -> None:
    model, data = fitted(), logged(two_contacts(), 10, seed=5)
    found = model.predict(data.q, data.qd, data.tau, "multiplier")
    axes = found.plot(names=["table", "ball"])
    np.testing.assert_allclose(curve(axes[1], "predicted"), found.mean[:, 1])
    assert axes[-1].get_xlabel() == "sample"
    with pytest.raises(ShapeError, match="names does not match"):
        found.plot(names=["table"])
    with pytest.raises(ShapeError, match=r"\(n, d\)"):
        model.predict(data.q[0], data.qd[0], data.tau[0]).plot()


def test_a_rollout_with_the_spread_of_its_samples() -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    law = forcegp.AnalyticalModel(system).nominal()
    q = torch.tensor([0.3, -0.2], dtype=torch.float64)
    tau = torch.zeros(11, 2, dtype=torch.float64)
    path = law.rollout(q, 0.0 * q, tau, duration=0.1, options=forcegp.rollout.RolloutOptions(0.01))
    spread = torch.stack([path.q + 0.1, path.q - 0.1, path.q])
    path = dataclasses.replace(path, samples=dataclasses.replace(path, q=spread))
    axes = path.plot(joints=[system.robot.joint_names[1]])
    np.testing.assert_array_equal(curve(axes[0], "predicted"), path.q[:, 1])
    box = band(axes[0]).get_datalim(axes[0].transData)
    # Three samples, 0.1 above, 0.1 below and at the mean: their standard deviation is 0.1.
    np.testing.assert_allclose(box.y1, float(path.q[:, 1].max()) + 0.2, rtol=1e-12)
    with pytest.raises(UnknownNameError, match="qdd"):
        path.plot("acceleration")
    batch = {name: getattr(path, name).expand(2, -1, -1) for name in FIELDS}
    several = dataclasses.replace(path, samples=None, **batch)
    with pytest.raises(ParameterError, match=r"rollout\[0\]"):
        several.plot()
