"""A fit to a log that is read piece by piece is the fit to the log in memory."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

import forcegp
from forcegp import StreamedDataset
from forcegp.cluster import cluster, on_cluster
from forcegp.data import stream
from forcegp.errors import ModelError
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.gp.sparse import SparsePosterior
from forcegp.learning import streamed
from forcegp.models import LearningOptions
from forcegp.models.structured_fit import StructuredFit
from forces.cases import draw, friction_and_residual, logged, mixed_contacts, two_contacts

SAME = 1e-8
"""Of sums in another order, through a factorisation of some dozens of basis functions."""
ADDED = 1e-9
"""Relative: the same sums in another order."""
PIECE = 16
SHORT = LearningOptions(max_evaluations=3)
data = logged(two_contacts(), 100)


def model(inference: str = "sparse") -> forcegp.StructuredGP:
    """A model with finite priors, whose fits are exact and fast."""
    priors, noise = [JointFrictionPrior()], forcegp.Noise(acceleration=0.1, torque=0.2)
    return forcegp.StructuredGP(two_contacts(), "analytical", priors, noise=noise, inference=inference)


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StreamedDataset:
    monkeypatch.setattr(stream, "PIECE_ROWS", PIECE)
    data[:70].write(tmp_path / "a.parquet")
    data[70:].write(tmp_path / "b.parquet")
    return StreamedDataset((tmp_path / "a.parquet", tmp_path / "b.parquet"))


def assert_same(one: StructuredFit, other: StructuredFit, tolerance: float) -> None:
    q, qd, tau = draw(5, seed=3)
    for quantity in ("qdd", "multiplier"):
        a, b = (m.predict(q, qd, tau, quantity, active=mixed_contacts(5)) for m in (one, other))
        torch.testing.assert_close(a.mean, b.mean, rtol=tolerance, atol=tolerance)
        torch.testing.assert_close(a.covariance, b.covariance, rtol=tolerance, atol=tolerance)
    assert one.result.log_marginal_likelihood == pytest.approx(other.result.log_marginal_likelihood, rel=SAME)


def test_as_in_memory(files: StreamedDataset) -> None:
    fit = model().fit(files, options=SHORT)
    assert_same(fit, model().fit(data, options=SHORT), SAME)
    assert (fit.result.samples, fit.result.inference) == (100, "sparse")


def test_inducing_points(files: StreamedDataset) -> None:
    priors, sparse = friction_and_residual(), forcegp.models.Inference("sparse", inducing_points=12)
    small = forcegp.StructuredGP(two_contacts(), "analytical", priors, 0.1, inference=sparse)
    fit = small.fit(files, learn=[])
    assert_same(fit, small.fit(data, learn=[]), SAME)
    assert isinstance(fit.posterior.latent, SparsePosterior)
    basis = fit.posterior.latent.basis
    assert max(len(next(iter(part.inducing.values()))) for part in basis.parts) == 12
    assert fit.result.basis_functions == basis.size and fit.result.more_points_would_help
    assert any("more inducing points would help" in warning for warning in fit.result.warnings)


@pytest.mark.parametrize("streamed", [False, True])
def test_samples_with_an_impossible_value_are_excluded_and_counted(
    files: StreamedDataset, tmp_path: Path, streamed: bool
) -> None:
    qdd = data.qdd.clone()
    qdd[33, 1] = 1e6
    friction, found = forcegp.StructuredGP(two_contacts(), "analytical", [JointFrictionPrior()]), []
    for log in (data.replace(qdd=qdd), data[torch.arange(len(data)) != 33]):
        log[log.t < data.t[70]].write(tmp_path / "a.parquet")
        found.append(friction.fit(files if streamed else log, options=SHORT))
    warnings = [" ".join(fit.result.warnings) for fit in found]
    assert "excluded 1 outlier:" in warnings[0] and "outlier" not in warnings[1]
    assert_same(*found, 1e-6)


@pytest.mark.slow
def test_a_measured_robot(files: StreamedDataset) -> None:
    """Samples in motion, torque noise, and forces that the robot contains."""
    priors = [JointFrictionPrior(), InertialPrior()]
    measured = forcegp.StructuredGP(two_contacts(), "analytical", priors, noise=0.1)
    streamed, whole = measured.fit(files, options=SHORT), measured.fit(data, options=SHORT)
    assert streamed.problem.errors and streamed.posterior.latent.errors == 1
    assert_same(streamed, whole, 1e-6)  # The updated robot comes from an optimiser of its own.


def test_a_part_of_a_long_log_is_learned_from(
    files: StreamedDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streamed, "SAMPLE_ROWS", 20)
    fit = model().fit(files, learn=[])
    assert fit.training.samples == 25 and fit.result.samples == 100
    assert isinstance(fit.posterior.latent, SparsePosterior)
    assert float(fit.posterior.latent.moments.rows) > 400


def test_exact_inference_needs_the_whole_log(files: StreamedDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    assert model("exact").fit(files, learn=[]).result.inference == "exact"
    monkeypatch.setattr(streamed, "SAMPLE_ROWS", 20)
    with pytest.raises(ModelError, match=r"exact inference on a log of 100 samples[\s\S]*sparse"):
        model("exact").fit(files, learn=[])


def weights(fit: StructuredFit) -> torch.Tensor:
    assert isinstance(fit.posterior.latent, SparsePosterior)
    return fit.posterior.latent.weights


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    pytest.importorskip("distributed")
    with cluster(2) as client:
        yield client


@pytest.mark.parametrize("file_count", [1, 2])
def test_two_workers_equal_one_process(client: Any, tmp_path: Path, file_count: int) -> None:
    """A file is shared piece by piece, and several files file by file."""
    rows = [data] if file_count == 1 else [data[:70], data[70:]]
    for number, part in enumerate(rows):
        part.write(tmp_path / f"{number}.parquet")
    log = StreamedDataset(tuple(tmp_path / f"{number}.parquet" for number in range(file_count)))
    alone, shared = model().fit(log, learn=[]), model().fit(log, learn=[], client=client)
    difference = (weights(shared) - weights(alone)).abs().max()
    assert float(difference) < ADDED * float(weights(alone).abs().max())
    assert shared.result.log_marginal_likelihood == pytest.approx(
        alone.result.log_marginal_likelihood, rel=ADDED
    )


def once_killed(folder: str, item: int) -> int:
    """Ends its process without notice at the first call."""
    mark = Path(folder) / "killed"
    if item == 1 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def test_workers_keep_their_memory(client: Any) -> None:
    """With a threshold for returning memory, glibc returns every large array at once."""
    assert set(client.run(os.environ.get, "MALLOC_TRIM_THRESHOLD_").values()) == {None}


@pytest.mark.slow
def test_the_tasks_of_a_killed_worker_are_repeated(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with cluster(2) as own:
        assert list(on_cluster(own, partial(once_killed, str(tmp_path)), range(4))) == [0, 1, 2, 3]
    assert (tmp_path / "killed").exists()
