"""Fitting of a structured Gaussian process to a streamed log.

In a first pass, a sample of the log is drawn. It determines input scales, hyperparameters and inducing
points. In a second pass, the sums over all samples are computed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor

from forcegp.data import Dataset
from forcegp.data.stream import Keep, StreamedDataset, spaced_sample
from forcegp.errors import ModelError
from forcegp.forces.calibration import MOST_RESIDUALS, STRETCHES
from forcegp.forces.inverse_dynamics import without_delay
from forcegp.forces.measurements import Observation, Training, period_of, training_of
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.memory import LONGEST_STEP, PAST, Past, bristles
from forcegp.forces.problem import Problem, Totals, basis_of, posterior_of, total_over
from forcegp.gp.basis import LatentBasis
from forcegp.gp.features import Standardization
from forcegp.gp.kernels import sub
from forcegp.gp.sums import Sums, require_agreement, share_basis
from forcegp.models.base import FitProgress
from forcegp.models.structured_learning import FEWEST_MOVING, REST_SPEED, Specification, identity
from forcegp.storage.checkpoint import Checkpoint, beside

SAMPLE_ROWS = 20_000
"""Number of evenly spaced rows for learning. Fewer than twice this number are in memory at a time."""


@dataclass(frozen=True)
class Sample:
    """The samples that one pass over a streamed log keeps, or all samples of a log in memory.

    Attributes:
        data: the samples. Those of a streamed log are evenly spaced.
        count: total number of samples to condition on, or 0 if `data` contains all of them.
        log: the streamed log, if any.
        stretches: a few contiguous runs of samples, for estimating the correlation time of residuals.
        moving: whether samples at rest are ignored.
    """

    data: Dataset | Sequence[Observation]
    count: int = 0
    log: StreamedDataset | None = None
    stretches: Dataset | None = None
    moving: bool = False

    def neighbours(self, spec: Specification, training: Training) -> Training | None:
        """Return the contiguous runs of samples as training data.

        Args:
            training: the sample, with the input scales to keep.

        Returns:
            The training data, or `None` if the sample is the whole log or the model does not need neighbours.
        """
        if self.stretches is None or not spec.noise.learns_torque or len(self.data) == self.count:
            return None
        scales = kept_scales(spec.priors, training)
        stretches = training_of(self.stretches, spec.system, spec.priors, spec.noise.acceleration, scales)
        return without_delay(stretches, spec.priors)


@torch.no_grad()
def sample_of(spec: Specification, data: StreamedDataset) -> Sample:
    """Return evenly spaced training samples of a log, restricted to motion if the model requires it.

    Raises:
        DataError: a file is damaged or contains no samples.
        ModelError: the processes read different logs, or exact inference is requested for a streamed log.
    """
    if data.distributed:
        require_agreement("the log", data.digest, len(data), hint="pass the same files to each")
    moving = spec.automatic or spec.noise.learns_torque
    rows, stretches, count = _rows_of(data, moving_rows if moving else None)
    if moving and count < FEWEST_MOVING:
        moving = False
        rows, stretches, count = _rows_of(data, None)
    _check_inference(spec, count, len(rows))
    return Sample(rows, count, data, stretches, moving)


def _rows_of(log: StreamedDataset, keep: Keep | None) -> tuple[Dataset, Dataset, int]:
    """Return evenly spaced rows to keep, contiguous runs of rows to keep, and the number of all such rows."""
    stretches: list[Dataset] = []
    rows, count = spaced_sample(_with_stretches(log, stretches, keep), SAMPLE_ROWS, keep)
    return rows, Dataset.concatenate(stretches), count


def _with_stretches(stream: StreamedDataset, parts: list[Dataset], keep: Keep | None) -> Iterator[Dataset]:
    """Yield the pieces of a log, and append the first rows of some pieces to `parts`."""
    last, length = stream.piece_count - 1, MOST_RESIDUALS // STRETCHES
    pieces = (
        followed(stream.pieces()) if stream.header.ordered and not stream.distributed else stream.pieces()
    )
    wanted = {round(last * i / (STRETCHES - 1)) for i in range(STRETCHES)}
    for number, piece in enumerate(pieces):
        if number in wanted:
            parts.append((piece if keep is None else piece[keep(piece)])[:length])
        yield piece


def followed(pieces: Iterable[Dataset]) -> Iterator[Dataset]:
    """Yield the pieces of a log with the states of bristles, which continue from piece to piece."""
    past = None
    for piece in pieces:
        if len(piece) > 1 and not 0.0 < period_of(piece) <= LONGEST_STEP:
            yield piece
            continue
        history = bristles(piece.t, piece.qd, piece.segment, past)
        past = Past(piece.t[-1:], piece.qd[-1:], piece.segment[-1:], history[-1:])
        states = {f"{PAST}{k}": x for k, x in enumerate(history.unbind(-1))}
        yield piece.replace(extras={**piece.extras, **states})


def _check_inference(spec: Specification, count: int, held: int) -> None:
    """Raise `ModelError` if the model needs all samples in memory but only `held` samples are in memory."""
    if spec.noise.degrees_of_freedom is not None and count > held:
        raise ModelError(
            "heavy-tailed noise needs a weight for every sample, which a streamed log does not have",
            expected=f"at most {2 * SAMPLE_ROWS - 1:,} samples",
            got=f"{count:,}",
            hint="select rows, or omit degrees_of_freedom",
        )
    if spec.options.inference == "exact" and count > held:
        raise ModelError(
            f"exact inference on a log of {count:,} samples that is streamed",
            expected=f"at most {2 * SAMPLE_ROWS - 1:,} samples",
            hint='use inference="sparse"',
        )


def kept_scales(priors: Sequence[ForcePrior], training: Training) -> dict[str, Standardization]:
    """Return the input scales of the training data, keyed by prior."""
    return {prior.name: scale for prior, scale in zip(priors, training.scales, strict=True)}


def moving_rows(data: Dataset) -> Tensor:
    """Return the rows in which at least one joint moves."""
    return (data.qd.abs().amax(-1) > REST_SPEED).nonzero()[:, 0]


@dataclass(frozen=True)
class Pass:
    """A resumable pass over a streamed log in one or several processes.

    Attributes:
        spec: the model.
        log: the log.
        sample: the sample used for learning.
        checkpoint: the file that records the sums, or `None`.
        progress: a function called with the number of processed samples, the total number, and NaN.
    """

    spec: Specification
    log: StreamedDataset
    sample: Sample
    checkpoint: Path | None = None
    progress: FitProgress | None = None

    @torch.no_grad()
    def forces(
        self, problem: Problem, hyperparameters: Mapping[str, Tensor]
    ) -> tuple[ForcePosterior, Tensor]:
        """Return the forces conditioned on the whole log, and the likelihood terms independent of them.

        Raises:
            ModelError: the checkpoint belongs to a different fit.
            NumericalError: the sums are not finite.
        """
        basis, begin = basis_of(problem, hyperparameters), None
        saved = Checkpoint(self._own_file(), self._key(problem, hyperparameters)) if self.checkpoint else None
        kept, refused = {}, None
        if saved is not None:
            try:
                kept = saved.read(_tensors(basis, Totals.zero(problem, basis)))
            except ModelError as cause:
                refused = cause
            if self.log.distributed:
                # If one process stops, the others must not wait for it.
                hint = "resume with the original number of processes, or remove all parts of the checkpoint"
                require_agreement("their parts of the checkpoint", 2 if refused else bool(kept), hint=hint)
            if refused is not None:
                raise refused
        if kept:
            basis, begin = _restored(basis, kept)
        elif self.log.distributed:
            basis = share_basis(basis)
        processes = dist.get_world_size() if self.log.distributed else 1

        def after(total: Totals) -> None:
            if saved is not None:
                saved.write_now_and_then(lambda: _tensors(basis, total))
            if self.progress is not None:
                done = processes * int(total.samples)
                self.progress(done, self.sample.count, math.nan)

        pieces = self._pieces(problem, 0 if begin is None else begin.pieces)
        total = total_over(problem, hyperparameters, basis, pieces, begin, after)
        if self.log.distributed:
            total = total.over_processes()
        return posterior_of(problem, hyperparameters, basis, total), total.constant

    def _pieces(self, problem: Problem, start: int) -> Iterator[Training]:
        """Yield the samples of this process piece by piece. Pieces of other processes are empty."""
        rank, processes = (dist.get_rank(), dist.get_world_size()) if self.log.distributed else (0, 1)
        kept = kept_scales(problem.priors, problem.training)
        remembers = any(prior.remembers for prior in problem.priors) and processes == 1
        pieces = self.log.pieces(0 if remembers else start, (rank, processes))
        for number, piece in enumerate(followed(pieces) if remembers else pieces):
            if remembers and number < start:
                continue
            if self.sample.moving:
                piece = piece[moving_rows(piece)]
            if len(piece) == 0:
                yield problem.training.of_rows([torch.arange(0)] * len(problem.training.measurements))
            else:
                noise_std = self.spec.noise.acceleration
                rows = training_of(piece, self.spec.system, problem.priors, noise_std, kept)
                yield without_delay(rows, problem.priors)

    def _own_file(self) -> Path:
        assert self.checkpoint is not None
        path = beside(self.checkpoint)
        return path.with_name(f"{path.name}.{dist.get_rank()}") if self.log.distributed else path

    def _key(self, problem: Problem, hyperparameters: Mapping[str, Tensor]) -> str:
        """Return an identifier for the sums over a log with a given basis, system and noise."""
        files = [(path.name, path.stat().st_size) for path in self.log.files]
        points = [x for Z in problem.inducing or () for x in Z.values()]
        named = [part for pair in sorted(hyperparameters.items()) for part in pair]
        processes = dist.get_world_size() if self.log.distributed else 1
        streamed = (problem.power, files, self.log.differentiate, processes)
        return Checkpoint.key_of(*identity(problem), *streamed, *points, *named)


def _tensors(basis: LatentBasis, total: Totals) -> dict[str, Tensor]:
    """Return the intermediate results of a pass, keyed by name."""
    tensors = {f"basis.{name}": value for name, value in basis.tensors().items()}
    tensors |= {f"sums.{i}": value for i, value in enumerate(total.sums.tensors)}
    counts = {"constant": total.constant, "samples": total.samples, "pieces": torch.tensor(total.pieces)}
    return tensors | counts


def _restored(basis: LatentBasis, tensors: Mapping[str, Tensor]) -> tuple[LatentBasis, Totals]:
    """Restore the basis and totals from `_tensors`, with kernel inputs in the order of the prior."""
    own = LatentBasis.of_tensors(basis.processes, basis.params, sub(tensors, "basis"))
    sums = Sums(*(tensors[f"sums.{i}"] for i in range(len(fields(Sums)))))
    return own, Totals(sums, tensors["constant"], tensors["samples"], int(tensors["pieces"]))
