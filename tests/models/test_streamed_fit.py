"""A fit to a log that is read piece by piece is the fit to the log in memory."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.multiprocessing
from safetensors.torch import load_file

import forcegp
from forcegp import LearningOptions, StreamedDataset
from forcegp.data import stream
from forcegp.errors import ModelError
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.gp.sparse import SparsePosterior
from forcegp.models import structured_stream
from forcegp.models.structured_fit import StructuredFit
from forcegp.storage import checkpoint
from forcegp.storage.checkpoint import beside
from forces.cases import draw, logged, mixed_contacts, two_contacts
from models.stream_worker import PIECE, model, run

SAME = 1e-8
"""Of sums in another order, through a factorisation of some dozens of basis functions."""
ADDED = 1e-9
"""Relative: the same sums in another order."""
SHORT = LearningOptions(max_evaluations=3)
data = logged(two_contacts(), 100)


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StreamedDataset:
    monkeypatch.setattr(stream, "PIECE_ROWS", PIECE)
    monkeypatch.setattr(checkpoint, "INTERVAL", 0.0)
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
    small = forcegp.StructuredGP(
        two_contacts(), "analytical", "friction+residual", 0.1, inference="sparse", inducing_points=12
    )
    fit = small.fit(files, learn=[])
    assert_same(fit, small.fit(data, learn=[]), SAME)
    assert isinstance(fit.posterior.latent, SparsePosterior)
    basis = fit.posterior.latent.basis
    assert max(len(next(iter(part.inducing.values()))) for part in basis.parts) == 12
    assert fit.result.basis_functions == basis.size and fit.result.more_points_would_help
    assert any("more inducing points would help" in warning for warning in fit.result.warnings)


@pytest.mark.slow
def test_a_measured_robot(files: StreamedDataset) -> None:
    """Samples in motion, torque noise, and forces that the robot contains."""
    priors = [JointFrictionPrior(), InertialPrior()]
    measured = forcegp.StructuredGP(two_contacts(), "analytical", priors, noise=0.1)
    streamed, whole = measured.fit(files, options=SHORT), measured.fit(data, options=SHORT)
    assert streamed.posterior.process.pinned
    assert_same(streamed, whole, 1e-6)  # The updated robot comes from an optimiser of its own.


def test_a_part_of_a_long_log_is_learned_from(
    files: StreamedDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(structured_stream, "SAMPLE_ROWS", 20)
    fit = model().fit(files, learn=[])
    assert fit.training.samples == 25 and fit.result.samples == 100
    assert isinstance(fit.posterior.latent, SparsePosterior)
    assert float(fit.posterior.latent.moments.rows) > 400


class Interrupted(Exception):
    """Stands for the end of the process."""


@pytest.mark.parametrize("after", [1, 3, 7])
def test_a_fit_goes_on_where_it_stopped(files: StreamedDataset, tmp_path: Path, after: int) -> None:
    reference = model().fit(files, options=SHORT)
    seen: list[int] = []

    def stop(done: int, most: int, value: float) -> None:
        if value != value:
            seen.append(done)
            if len(seen) == after:
                raise Interrupted

    file = tmp_path / "checkpoint"
    with pytest.raises(Interrupted):
        model().fit(files, options=SHORT, checkpoint=file, progress=stop)
    assert beside(file).is_file()
    again = model().fit(files, options=SHORT, checkpoint=file, progress=stop)
    assert seen == [16, 32, 48, 64, 70, 86, 100]
    assert file.is_file() and beside(file).is_file(), "kept until the caller has saved the fit"
    assert_same(again, reference, 0.0)


def test_a_checkpoint_of_another_log(files: StreamedDataset, tmp_path: Path) -> None:
    file = tmp_path / "checkpoint"
    model().fit(files, learn=[], checkpoint=file)
    data[5:].write(files.paths[1])
    with pytest.raises(ModelError, match="belongs to a different fit"):
        model().fit(StreamedDataset(files.paths), learn=[], checkpoint=file)
    beside(file).write_bytes(b"cut off")
    with pytest.raises(ModelError, match="damaged"):
        model().fit(files, learn=[], checkpoint=file)


def test_exact_inference_needs_the_whole_log(files: StreamedDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    assert model("exact").fit(files, learn=[]).result.inference == "exact"
    monkeypatch.setattr(structured_stream, "SAMPLE_ROWS", 20)
    with pytest.raises(ModelError, match=r"exact inference on a log of 100 samples[\s\S]*sparse"):
        model("exact").fit(files, learn=[])


def test_two_processes_equal_one(tmp_path: Path) -> None:
    data.write(tmp_path / "log.parquet")
    torch.multiprocessing.spawn(run, args=(2, str(tmp_path)), nprocs=2)
    fit = model().fit(data, learn=[])
    for rank in range(2):
        got = load_file(tmp_path / f"{rank}.safetensors")
        want = fit.posterior.latent.weights  # type: ignore[attr-defined]
        assert float((got["weights"] - want).abs().max()) < ADDED * float(want.abs().max())
        assert float(got["likelihood"]) == pytest.approx(fit.result.log_marginal_likelihood, rel=ADDED)


def refusals(folder: Path, processes: int, stops: bool = False) -> list[str]:
    """What each of some processes says of a fit that cannot be made; none of them hangs."""
    (folder / "store").unlink(missing_ok=True)
    for file in folder.glob("*.error"):
        file.unlink()
    torch.multiprocessing.spawn(run, args=(processes, str(folder), stops), nprocs=processes)
    return [file.read_text() for file in sorted(folder.glob("*.error"))]


def test_processes_with_different_files_refuse_the_fit(tmp_path: Path) -> None:
    data.write(tmp_path / "log.parquet")
    data.replace(tau=data.tau + 1.0).write(tmp_path / "log.1.parquet")
    said = refusals(tmp_path, 2)
    assert len(said) == 2 and all("differ in the log" in text and "process 1" in text for text in said)


OTHERS = [pytest.param(3, False, marks=pytest.mark.slow), pytest.param(2, True, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("processes", "missing"), [(1, False), *OTHERS])
def test_a_distributed_fit_resumes_with_its_own_processes_only(
    tmp_path: Path, processes: int, missing: bool
) -> None:
    data.write(tmp_path / "log.parquet")
    (tmp_path / "recorded").touch()
    assert len(refusals(tmp_path, 2, stops=True)) == 2
    parts = sorted(tmp_path.glob("fit.part.sums.*"))
    assert len(parts) == 2
    if missing:
        parts[1].unlink()
    said = refusals(tmp_path, processes)
    assert len(said) == processes and all("checkpoint" in text for text in said)
    assert not list(tmp_path.glob("*.safetensors"))


def test_a_distributed_fit_resumes(tmp_path: Path) -> None:
    data.write(tmp_path / "log.parquet")
    (tmp_path / "recorded").touch()
    assert len(refusals(tmp_path, 2, stops=True)) == 2
    assert not refusals(tmp_path, 2)
    want = model().fit(data, learn=[]).posterior.latent.weights  # type: ignore[attr-defined]
    got = load_file(tmp_path / "1.safetensors")["weights"]
    assert float((got - want).abs().max()) < ADDED * float(want.abs().max())
