"""The paper's own settings: inputs in their units, and no priors on hyperparameters."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp.learning.search import Search
from forcegp.models import LearningOptions
from forcegp.models.independent_gp import IndependentGP
from forces.cases import draw, logged, two_contacts
from forces.textbook import Textbook, squared_exponential

MAXIMUM_LIKELIHOOD = LearningOptions("adam", max_evaluations=5, warm_start=None, hyperpriors=False)


def model() -> forcegp.StructuredGP:
    priors = [forcegp.priors.JointForcePrior(scaled=False)]
    return forcegp.StructuredGP(two_contacts(), "analytical", priors, 0.1, inference="exact")


def test_inputs_enter_in_their_units() -> None:
    """The dense likelihood with kernels on q, q̇, τ as they are logged."""
    own = model()
    fit = own.fit(logged(two_contacts(), 8), options=MAXIMUM_LIKELIHOOD)
    m = fit.training.measurements[0]
    x = torch.cat([m.q, m.qd, m.tau], dim=-1)
    params = {k.removeprefix("joint."): v for k, v in fit.hyperparameters.items()}
    k = squared_exponential(params, x, x)
    y, noise, maps = Textbook(fit).data()
    H = maps[0][1][0]
    K = torch.einsum("iab,bij,jcb->iajc", H, k, H).reshape(len(y), -1) + torch.diag(noise)
    L = torch.linalg.cholesky(K)
    alpha = torch.cholesky_solve(y[:, None], L)[:, 0]
    dense = -float(0.5 * y @ alpha + L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi))
    assert fit.result.log_marginal_likelihood == pytest.approx(dense, rel=1e-9)


def test_the_objective_is_the_likelihood_alone() -> None:
    fit = model().fit(logged(two_contacts(), 6), learn=[])
    start = dict(fit.hyperparameters)
    away = {key: value + 0.7 for key, value in start.items()}
    likelihood = float(fit.problem.negative_log_likelihood(away, fit.problem.fixed_rows))
    alone = Search(start, {}, MAXIMUM_LIKELIHOOD).objective(fit.problem, away)
    weak = Search(start, {}, LearningOptions()).objective(fit.problem, away)
    assert float(alone) == pytest.approx(likelihood, rel=1e-12)
    assert float(weak) > likelihood + 1.0


def test_independent_processes_on_inputs_in_their_units(tmp_path: Path) -> None:
    own = IndependentGP(two_contacts(), 0.1, standardize=False)
    fit = own.fit(logged(two_contacts(), 8), options=MAXIMUM_LIKELIHOOD)
    assert all(bool((x == 1.0).all()) for x in fit.training.scale.std.values())
    fit.save(tmp_path / "gp")
    q, qd, tau = draw(3, seed=1)
    again = forcegp.load_model(tmp_path / "gp").predict(q, qd, tau)
    torch.testing.assert_close(again.mean, fit.predict(q, qd, tau).mean)
