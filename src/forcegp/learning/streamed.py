"""Fitting of a structured Gaussian process to a streamed log.

In a first pass, a sample of the log is drawn. It determines input scales, hyperparameters and inducing
points. In a second pass, the sums over all samples are computed.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from forcegp.cluster import on_cluster, worker_count
from forcegp.data import Dataset
from forcegp.data.selection import outliers
from forcegp.data.stream import Keep, StreamedDataset, spaced_sample
from forcegp.errors import ModelError
from forcegp.forces.measurements import Observation, Training, period_of, training_of
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.memory import LONGEST_STEP, PAST, Past, bristles
from forcegp.forces.problem import PIECE_SAMPLES, Problem, Totals, basis_of, posterior_of, total_over
from forcegp.gp.basis import LatentBasis
from forcegp.gp.features import Standardization
from forcegp.gp.optimise import FitProgress
from forcegp.learning.correlation import MOST_RESIDUALS, RUNS
from forcegp.learning.inverse_dynamics import without_delay
from forcegp.learning.specification import FEWEST_MOVING, REST_SPEED, Specification, at_rest, still_of
from forcegp.resources import one_thread
from forcegp.robot.model import RobotModel

if TYPE_CHECKING:
    from distributed import Client

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
        moving: whether samples at rest and outliers are ignored.
        outliers: number of outliers in a streamed log.
    """

    data: Dataset | Sequence[Observation]
    count: int = 0
    log: StreamedDataset | None = None
    stretches: Dataset | None = None
    moving: bool = False
    outliers: int = 0

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
        ModelError: exact inference is requested for a streamed log.
    """
    moving = spec.automatic or spec.noise.learns_torque
    dropped: list[int] = []
    robot = spec.system.robot
    rows, stretches, count = _rows_of(data, robot, moving_rows if moving else None, dropped)
    if moving and count < FEWEST_MOVING:
        moving = False
        rows, stretches, count = _rows_of(data, robot, None, dropped)
    _check_inference(spec, count, len(rows))
    return Sample(rows, count, data, stretches, moving, sum(dropped) if moving else 0)


def _rows_of(
    log: StreamedDataset, robot: RobotModel, keep: Keep | None, dropped: list[int]
) -> tuple[Dataset, Dataset, int]:
    """Return evenly spaced rows to keep, contiguous runs of rows to keep, and the number of all such rows.

    Args:
        dropped: receives the number of outliers of each piece.
    """
    stretches: list[Dataset] = []
    rows, count = spaced_sample(_with_stretches(log, robot, stretches, keep, dropped), SAMPLE_ROWS, keep)
    return rows, Dataset.concatenate(stretches), count


def _with_stretches(
    stream: StreamedDataset,
    robot: RobotModel,
    parts: list[Dataset],
    keep: Keep | None,
    dropped: list[int],
) -> Iterator[Dataset]:
    """Yield the pieces of a log, and append the first rows of some pieces to `parts`."""
    last, length = stream.piece_count - 1, MOST_RESIDUALS // RUNS
    pieces = stream.pieces() if keep is None else possible(stream.pieces(), dropped)
    pieces = followed(pieces, robot) if stream.header.ordered else pieces
    wanted = {round(last * i / (RUNS - 1)) for i in range(RUNS)}
    for number, piece in enumerate(pieces):
        if number in wanted:
            parts.append((piece if keep is None else piece[keep(piece)])[:length])
        yield piece


def possible(pieces: Iterable[Dataset], dropped: list[int] | None = None) -> Iterator[Dataset]:
    """Yield the pieces of a log without outliers, and append the number of outliers of each piece."""
    for piece in pieces:
        bad = outliers(piece.q, piece.qd, piece.qdd, piece.tau)
        count = int(bad.sum())
        if dropped is not None:
            dropped.append(count)
        yield piece[~bad] if count else piece


def followed(pieces: Iterable[Dataset], robot: RobotModel) -> Iterator[Dataset]:
    """Yield the pieces of a log with the states of bristles, which continue from piece to piece."""
    past = None
    for piece in pieces:
        if len(piece) > 1 and not 0.0 < period_of(piece) <= LONGEST_STEP:
            yield piece
            continue
        speed = robot.drive_motion(piece.qd)
        history = bristles(piece.t, speed, piece.segment, past)
        past = Past(piece.t[-1:], speed[-1:], piece.segment[-1:], history[-1:])
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
    if spec.inference.method == "exact" and count > held:
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


def _in_threads(
    work: Callable[[Dataset], Totals], pieces: Iterable[Dataset], threads: int
) -> Iterator[Totals]:
    """Yield the results of pieces in their order, of which each is computed by one thread."""
    waiting: deque[Future[Totals]] = deque()

    def alone(piece: Dataset) -> Totals:
        with one_thread():
            return work(piece)

    with ThreadPoolExecutor(threads) as pool:
        for piece in pieces:
            waiting.append(pool.submit(alone, piece))
            if len(waiting) >= threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@dataclass(frozen=True)
class Pass:
    """A pass over a streamed log, by this process or by the workers of a cluster.

    Attributes:
        spec: the model.
        log: the log.
        sample: the sample used for learning.
        client: client of a Dask cluster, or `None`.
        progress: a function called with the number of processed samples, the total number, and NaN.
    """

    spec: Specification
    log: StreamedDataset
    sample: Sample
    client: Client | None = None
    progress: FitProgress | None = None

    @torch.no_grad()
    def forces(
        self, problem: Problem, hyperparameters: Mapping[str, Tensor]
    ) -> tuple[ForcePosterior, Tensor]:
        """Return the forces conditioned on the whole log, and the likelihood terms independent of them.

        Raises:
            NumericalError: the sums are not finite.
        """
        basis, kept = basis_of(problem, hyperparameters), kept_scales(problem.priors, problem.training)
        rows = [torch.arange(0)] * len(problem.training.measurements)
        bare = dataclasses.replace(problem, training=problem.training.of_rows(rows))
        part = Part(self.spec, bare, dict(hyperparameters), basis, kept, self.sample.moving)
        if self.client is None:
            totals = _in_threads(part.piece, part.pieces(self.log), torch.get_num_threads())
        else:
            totals = on_cluster(self.client, part.share, shares(self.log, worker_count(self.client)))
        total = Totals.zero(problem, basis)
        for each in totals:
            total += each
            if self.progress is not None:
                self.progress(total.samples, self.sample.count, math.nan)
        return posterior_of(problem, hyperparameters, basis, total), total.constant


@dataclass(frozen=True)
class Part:
    """Settings with which a worker computes the sums over its part of a log.

    Attributes:
        spec: the model.
        problem: the problem without samples.
        hyperparameters: the hyperparameters.
        basis: the basis functions of all workers.
        scales: input scales, keyed by prior.
        moving: whether samples at rest and outliers are ignored.
    """

    spec: Specification
    problem: Problem
    hyperparameters: dict[str, Tensor]
    basis: LatentBasis
    scales: dict[str, Standardization]
    moving: bool

    def pieces(self, log: StreamedDataset, r: int = 0, k: int = 1) -> Iterator[Dataset]:
        """Yield piece r of every k, with the states of bristles if a prior depends on the past."""
        if any(prior.remembers for prior in self.problem.priors):
            return islice(followed(self._usable(log.pieces()), self.spec.system.robot), r, None, k)
        return self._usable(log.pieces((r, k)))

    def _usable(self, pieces: Iterator[Dataset]) -> Iterator[Dataset]:
        if not self.moving:
            return pieces
        still = still_of(self.spec, self.scales)
        return (at_rest(piece, still) for piece in possible(pieces))

    @torch.no_grad()
    def piece(self, piece: Dataset) -> Totals:
        """Return the totals over the samples of a piece."""
        if self.moving:
            piece = piece[moving_rows(piece)]
        if len(piece) == 0:
            return Totals.zero(self.problem, self.basis)
        noise_std, priors = self.spec.noise.acceleration, self.problem.priors
        rows = training_of(piece, self.spec.system, priors, noise_std, self.scales)
        pieces = without_delay(rows, priors).pieces(PIECE_SAMPLES)
        return total_over(self.problem, self.hyperparameters, self.basis, pieces)

    def share(self, share: tuple[StreamedDataset, int, int]) -> Totals:
        """Return the totals over every k-th piece of a log from piece r, on one thread."""
        torch.set_num_threads(1)
        return sum(map(self.piece, self.pieces(*share)), Totals.zero(self.problem, self.basis))


def shares(log: StreamedDataset, workers: int) -> list[tuple[StreamedDataset, int, int]]:
    """Return the parts of a log for some workers: its files, or every k-th piece of a file."""
    files, k = log.files, math.ceil(workers / len(log.files))
    return [(dataclasses.replace(log, paths=(file,)), r, k) for file in files for r in range(k)]
