"""Models asked with arguments of the wrong kind; run as a script by test_wrong_kinds.py."""

from __future__ import annotations

import copy
import pickle
import tempfile
from pathlib import Path

import torch

import forcegp
from forcegp.models.structured_fit import StructuredFit
from random_data import random_data, table_system
from raw_errors import outcomes

SYSTEM = table_system()
DATA = random_data(SYSTEM, 8)
Q, QD, TAU = DATA.q, DATA.qd, DATA.tau
MODEL = forcegp.StructuredGP(SYSTEM, "zero", noise=0.1)
ROBOT = SYSTEM.robot


def fitted(model: forcegp.StructuredGP) -> StructuredFit:
    return model.fit(DATA, options=forcegp.models.LearningOptions(max_evaluations=1))


FIT = fitted(MODEL)


def fit_with(**options: object) -> object:
    return forcegp.StructuredGP(SYSTEM, **options).fit(DATA)  # type: ignore[arg-type]


CALLS = {
    "quantity=5": lambda: FIT.predict(Q, QD, TAU, quantity=5),
    "quantity=None": lambda: FIT.predict(Q, QD, TAU, quantity=None),
    "quantity=[5]": lambda: FIT.predict(Q, QD, TAU, quantity=[5]),
    "quantity=[[]]": lambda: FIT.predict(Q, QD, TAU, quantity=[["qdd"]]),
    "q=list": lambda: FIT.predict(Q.tolist(), QD, TAU),
    "qd=numpy": lambda: FIT.predict(Q, QD.numpy(), TAU),
    "tau=None": lambda: FIT.predict(Q, QD, None),
    "qd=1e300": lambda: FIT.predict(Q, torch.full_like(QD, 1e300), TAU),
    "q=nan": lambda: FIT.predict(torch.full_like(Q, float("nan")), QD, TAU),
    "active=list": lambda: FIT.predict(Q, QD, TAU, active=[True]),
    "active=shape": lambda: FIT.predict(Q, QD, TAU, active=torch.ones(3, 5, dtype=torch.bool)),
    "batch": lambda: FIT.predict(Q[:3], QD[:4], TAU[:5]),
    "noise=text": lambda: fit_with(noise="loud"),
    "noise=negative": lambda: fit_with(noise=-0.1),
    "noise=[None]": lambda: fit_with(noise=[None] * 7),
    "data=list": lambda: forcegp.StructuredGP(SYSTEM, "zero", noise=0.1).fit([1, 2]),
    "data=None": lambda: forcegp.StructuredGP(SYSTEM, "zero", noise=0.1).fit(None),
    "mass_matrix(list)": lambda: forcegp.dynamics.mass_matrix(ROBOT, [0.0] * 7),
    "frame_pose(list)": lambda: forcegp.kinematics.frame_pose(ROBOT, [0.0] * 7, ROBOT.frame_names[-1]),
    "load_model(5)": lambda: forcegp.load_model("/dev/null"),
}


def copies() -> None:
    """A fit through pickle and deepcopy, and one of a copied model, predict the same bits."""
    expected = FIT.predict(Q, QD, TAU)
    for name, copied in (
        ("pickle", lambda: pickle.loads(pickle.dumps(FIT))),
        ("fit of a pickled model", lambda: fitted(pickle.loads(pickle.dumps(MODEL)))),
        ("deepcopy", lambda: copy.deepcopy(FIT)),
    ):
        found = copied().predict(Q, QD, TAU)
        same = torch.equal(found.mean, expected.mean) and torch.equal(found.covariance, expected.covariance)
        print(name, "same" if same else "different")
    with tempfile.TemporaryDirectory() as folder:
        FIT.save(Path(folder) / "model")
        found = forcegp.load_model(Path(folder) / "model").predict(Q, QD, TAU)
        print("save and load", "same" if torch.equal(found.mean, expected.mean) else "different")


if __name__ == "__main__":
    outcomes(CALLS)
    try:
        copies()
    except Exception as error:
        print("COPY", type(error).__name__, str(error)[:300])
