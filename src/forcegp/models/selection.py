"""Which set of force priors a log asks for.

Each candidate, a set of `SETS` with or without the question whether the inertia differs from that of the
robot file, is trained on one half of the log and tested on the other, both ways. A half consists of
contiguous stretches, since neighbours in time would make any set look good. The score is the mean logarithm
of the predictive density of what was measured, noise included,

    S = 1/N Σ_i log N(y_i; E z(x_i), Var z(x_i) + Σ),

and candidates are compared by differences of S over blocks of rows, which have a standard error. The simplest
candidate within one standard error of the best is chosen. No candidate reads the motor torque: in closed loop
a residual that does learns to cancel it, and its density looks best.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.data import Dataset
from forcegp.errors import NumericalError
from forcegp.forces.inertia import Inertia
from forcegp.forces.inference import is_finite
from forcegp.forces.measurements import Training
from forcegp.forces.observations import Observation, scaled, training_of
from forcegp.forces.priors.sets import FEW, SETS, PriorSet
from forcegp.gp.optimise import LearningOptions
from forcegp.models.base import FitProgress
from forcegp.models.fit_result import Compared
from forcegp.models.structured_fit import StructuredFit, conditioned
from forcegp.models.structured_learning import Task, identified, in_motion, prepared, search_of, solve
from forcegp.models.structured_spec import Specification

FEWEST = 100
"""Samples below which the set `FEW` is taken."""
HALVES, STRETCHES, BLOCKS = 2, 4, 8
"""Halves of the log, stretches that they alternate between, and blocks of rows that a half is compared on."""
ROWS = 400
"""Evenly spaced rows of a half that a candidate is conditioned on, and tested on."""
LEARN_ROWS = 150
"""Rows that hyperparameters are learned on if a prior is not a finite number of features."""
QUICK = LearningOptions(tolerance=1e-5, max_evaluations=150)
"""How candidates learn: their scores differ by more than the last digits of a likelihood."""
DROPPED = 2.0
"""Standard errors behind the best after which a candidate is not tried on the second half."""


@dataclass(frozen=True)
class Candidate:
    """A set of priors, and whether the inertia is identified with it."""

    set: PriorSet
    inertia: bool = False

    @property
    def name(self) -> str:
        """As in the table of the comparison."""
        return f"{self.set.name}, inertia identified" if self.inertia else self.set.name


def candidates_of(spec: Specification) -> list[Candidate]:
    """The candidates for a model, simplest first."""
    candidates = []
    for chosen in (each for each in SETS.values() if each.fits(spec.system)):
        asks = (
            spec.options.inertia != "file"
            and chosen.has_joint_friction
            and spec.analytical_parameters is None
        )
        if not asks or spec.options.inertia is None:
            candidates.append(Candidate(chosen))
        if asks:
            candidates.append(Candidate(chosen, inertia=True))
    return candidates


def without_comparison(spec: Specification, note: str) -> tuple[Specification, tuple[Compared, ...]]:
    """The specification with the set for few samples, and a table that says so."""
    spec = spec.with_options(inertia=spec.options.inertia or "auto")
    return spec.with_set(FEW), (Compared(FEW.name, chosen=True, note=note),)


def with_priors(
    spec: Specification,
    data: Dataset | Sequence[Observation],
    learn: Sequence[str] | None = None,
    progress: FitProgress | None = None,
) -> tuple[Specification, tuple[Compared, ...]]:
    """The specification with the priors that were left to the data, and the comparison.

    Args:
        spec: the model, with the noise for these data.
        data: the log, or the rows of it that are held in memory.
        learn: what is learned, if not all.
        progress: called after each candidate with the number of candidates so far, of all, and NaN.
    """
    if learn is not None:
        return without_comparison(spec, "not everything is learned")
    log, _ = in_motion(spec.system, training_of(data, spec.system, (), spec.noise.acceleration, {}))
    if min(len(m.q) for m in log.measurements) < FEWEST:
        return without_comparison(spec, f"fewer than {FEWEST} samples")
    comparison = Comparison(spec, log, candidates_of(spec))
    for half in range(HALVES):
        comparison.test(half, progress)
    return comparison.result()


class Comparison:
    """Scores of candidates on halves of a log.

    Args:
        spec: the model.
        log: samples in motion.
        candidates: simplest first.
    """

    def __init__(self, spec: Specification, log: Training, candidates: Sequence[Candidate]) -> None:
        self.spec, self.log, self.candidates = spec, log, candidates
        self.halves = [halves_of(m.q, m.qd, log.period > 0.0) for m in log.measurements]
        self.scores: dict[str, list[Tensor]] = {}
        self.notes: dict[str, str] = {}
        self.begins: dict[str, Mapping[str, Tensor]] = {}
        self.inertia_found = False

    def test(self, half: int, progress: FitProgress | None) -> None:
        """Train each candidate on the other half, score it on this one, and drop those far behind."""
        rows = [(own == half).nonzero()[:, 0] for own in self.halves]
        rest = [(own != half).nonzero()[:, 0] for own in self.halves]
        train, test = self.log.of_rows(rest), self.log.of_rows(rows).evenly(ROWS)
        inertia: Inertia | None = None
        for number, candidate in enumerate(self.candidates, 1):
            name = candidate.name
            if name not in self.notes:
                robot = Inertia(self.spec.system.robot)
                if candidate.inertia:
                    spec = self.spec.with_set(candidate.set).with_options(inertia="auto")
                    inertia = inertia or spec.inertia_of(train)
                    robot, same = inertia, inertia.robot is self.spec.system.robot
                    self.inertia_found = self.inertia_found or not same
                self._score(candidate, robot, train, test)
            if progress is not None:
                count = len(self.candidates)
                progress(half * count + number, HALVES * count, math.nan)
        if half + 1 < HALVES:
            self._drop()

    def _drop(self) -> None:
        """Leave out the candidates that are far behind the best."""
        blocks = {name: torch.cat(parts) for name, parts in self.scores.items() if name not in self.notes}
        if not blocks:
            return
        best = max(blocks.values(), key=lambda x: float(x.mean()))
        for name, own in blocks.items():
            behind, error = difference(best, own)
            if behind > DROPPED * error:
                self.notes[name] = "dropped after the first half"

    def _score(self, candidate: Candidate, inertia: Inertia, train: Training, test: Training) -> None:
        name, plain = candidate.name, Candidate(candidate.set).name
        unchanged = candidate.inertia and inertia.robot is self.spec.system.robot
        tested = len(self.scores.get(name, ())) + 1
        if unchanged and len(self.scores.get(plain, ())) == tested and plain not in self.notes:
            self.scores.setdefault(name, []).append(self.scores[plain][-1])
            return
        try:
            fit = trained(self.spec.with_set(candidate.set), inertia, train, self.begins.get(name))
            score = blocks_of(log_density(fit, test))
        except NumericalError as cause:
            self.notes[name] = f"not computed: {str(cause).splitlines()[0]}"
            return
        self.begins[name] = fit.hyperparameters
        self.scores.setdefault(name, []).append(score)

    def result(self) -> tuple[Specification, tuple[Compared, ...]]:
        """The specification with the chosen set, and the table."""
        shown = [each for each in self.candidates if self._is_shown(each)]
        whole = {
            each.name: torch.cat(self.scores[each.name]) for each in shown if each.name not in self.notes
        }
        if not whole:
            return without_comparison(self.spec, "no candidate could be computed")
        best = max(whole.values(), key=lambda x: float(x.mean()))
        near = {name for name, x in whole.items() if difference(best, x)[0] <= difference(best, x)[1]}
        chosen = next(each for each in shown if each.name in near)
        table = tuple(self._row(each, best, each is chosen) for each in shown)
        identifies = chosen.inertia or not self.inertia_found
        spec = self.spec.with_options(inertia=self.spec.options.inertia or ("auto" if identifies else "file"))
        return spec.with_set(chosen.set), table

    def _is_shown(self, candidate: Candidate) -> bool:
        """Whether a candidate differs from those without the question about inertia."""
        return not candidate.inertia or self.spec.options.inertia == "auto" or self.inertia_found

    def _row(self, candidate: Candidate, best: Tensor, chosen: bool) -> Compared:
        parts = self.scores.get(candidate.name, [])
        note = self.notes.get(candidate.name, "")
        if not parts:
            return Compared(candidate.name, note=note)
        own = torch.cat(parts)
        behind, error = difference(best[: len(own)], own)
        return Compared(candidate.name, float(own.mean()), behind, error, chosen, note)


def halves_of(q: Tensor, qd: Tensor, in_order: bool) -> Tensor:
    """Which half each row belongs to `(n,)`: alternating stretches in time, or else along the direction in
    which the states vary most."""
    n = len(q)
    rank = torch.arange(n, device=q.device)
    if not in_order:
        x = torch.cat([q, qd], dim=-1)
        x = (x - x.mean(0)) / x.std(0).clamp(min=1e-12)
        along = torch.linalg.svd(x, full_matrices=False).Vh[0]
        # The sign of a singular vector is arbitrary.
        rank = (x @ (along * along[along.abs().argmax()].sign())).argsort().argsort()
    return rank * STRETCHES // max(n, 1) % HALVES


def trained(
    spec: Specification, inertia: Inertia, train: Training, begin: Mapping[str, Tensor] | None
) -> StructuredFit:
    """A candidate, conditioned on `ROWS` rows of a half.

    Args:
        spec: with the priors of the candidate.
        inertia: of the robot to learn with.
        train: the half.
        begin: hyperparameters to begin with.
    """
    spec, pinned = identified(spec) if inertia.identified else (spec, {})
    rows = scaled(train.evenly(ROWS), spec.system, spec.priors, {}, spec.options.standardize)
    few = problem = Task(spec, rows, inertia.robot, pinned).problem()
    if not is_finite(problem.priors):
        few = dataclasses.replace(problem, training=rows.evenly(LEARN_ROWS))
    search = search_of(spec, few, {}, None, QUICK)
    if begin is not None:
        begin = {key: begin.get(key, value) for key, value in search.start.items()}
    lesson = solve(spec, few, search, None, begin, rows)
    whole = dataclasses.replace(lesson.problem, training=rows)
    return conditioned(spec, prepared(spec, whole, lesson.hyperparameters), lesson.hyperparameters)


@torch.no_grad()
def log_density(fit: StructuredFit, test: Training) -> Tensor:
    """log N(y_i; E z, Var z + Σ) of each sample `(n,)`: of accelerations, or else of all measured values.

    Raises:
        NumericalError: a covariance is not positive definite.
    """
    judged = [m for m in test.measurements if m.quantity == "qdd"] or test.measurements
    densities = []
    for m in judged:
        prediction = fit.predict(m.q, m.qd, m.tau, m.quantity, active=m.active, noise=True)
        # Σ = L Lᵀ
        L, info = torch.linalg.cholesky_ex(prediction.covariance)
        if bool(info.any()):
            raise NumericalError("a predictive covariance is not positive definite")
        normal = torch.distributions.MultivariateNormal(prediction.mean, scale_tril=L, validate_args=False)
        densities.append(normal.log_prob(m.values))
    return torch.cat(densities)


def blocks_of(density: Tensor) -> Tensor:
    """Means over contiguous blocks of rows `(BLOCKS,)`."""
    return torch.stack([part.mean() for part in density.tensor_split(BLOCKS)])


def difference(best: Tensor, own: Tensor) -> tuple[float, float]:
    """How far a score lies behind the best, and the standard error of that, from blocks `(k,)` of each."""
    behind = best - own
    return float(behind.mean()), float(behind.std() / math.sqrt(len(behind)))
