"""Selection of a set of force priors by cross-validation on a log.

Each candidate is a set in `SETS` with or without identification of the inertia. It is trained on one half of
the log and tested on the other, and vice versa. Each half consists of contiguous segments of the log, since
any set would score well if training and test samples were neighbours. The score is the mean log predictive
density of the measurements, including noise,

    S = 1/n Σ_i log[(1 − ε) p(N r_i; N V_i N) + ε p(N s_i; N diag(v + V_i) N)],  r_i = y_i − E z(x_i),

with the density p of a normal distribution of mean zero, V_i = Var z(x_i) + Σ, the mean ȳ and variance v of
all measurements, and s_i = y_i − ȳ. N = 1 − A⁺A removes the accelerations that closed contacts fix, which all
candidates predict alike, and from which a contact that is not perfectly rigid deviates by thousands of σ. The
second term limits the weight of a sample that no candidate explains, such as one with a wrong contact label.

Candidates are compared by the differences of S over blocks of rows, which also give a standard error. The
simplest candidate within one standard error of the best is selected. If the residuals of the best are
correlated so much that there are only κ n < `FEWEST` independent samples, each of its additional k parameters
must also gain ½ ln(κ n)/κ n nats per sample (Schwarz, *Estimating the dimension of a model*, 1978). No
candidate depends on the motor torque. In closed loop, such a residual learns to cancel the torque and appears
to have the best density.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.data import Dataset
from forcegp.errors import NumericalError
from forcegp.forces.inertia import Inertia
from forcegp.forces.measurements import Observation, Training, scaled, training_of
from forcegp.forces.priors.sets import FEW, SETS, PriorSet
from forcegp.forces.problem import is_finite, kernel_parameters
from forcegp.gp.optimise import LearningOptions
from forcegp.models.base import FitProgress
from forcegp.models.fit_result import Compared
from forcegp.models.structured_fit import StructuredFit, conditioned
from forcegp.models.structured_learning import (
    Specification,
    identified,
    in_motion,
    prepared,
    search_of,
    solve,
)

FEWEST = 100
"""Number of samples below which the set `FEW` is used, and of independent samples below which additional
parameters have a cost."""
HALVES, STRETCHES, BLOCKS = 2, 4, 8
"""Number of halves of the log, of alternating segments, and of blocks of rows compared in each half."""
ROWS = 400
"""Number of evenly spaced rows in each half on which a candidate is conditioned or tested."""
LEARN_ROWS = 150
"""Number of rows for learning hyperparameters if a prior has infinitely many features."""
OUTLIERS = 1e-12
"""Fraction ε of samples that no candidate explains, so small that it affects only impossible samples."""
QUICK = LearningOptions(tolerance=1e-5, max_evaluations=150)
"""Learning options for candidates. The tolerance can be loose, since their scores differ clearly."""
DROPPED = 2.0
"""Candidates further behind the best than this many standard errors are not tried on the second half."""


@dataclass(frozen=True)
class Candidate:
    """A set of priors, with or without identification of the inertia."""

    set: PriorSet
    inertia: bool = False

    @property
    def name(self) -> str:
        """Name of the candidate in the comparison table."""
        return f"{self.set.name}, inertia identified" if self.inertia else self.set.name


def candidates_of(spec: Specification, log: Training) -> list[Candidate]:
    """Return the candidates, simplest first. All include torque noise if joint forces are unknown.

    Accelerations do not show forces in the range of Aᵀ. A residual on (q, q̇) would be arbitrary there, so it
    is not a candidate if most samples are in contact and no force was measured.
    """
    candidates = []
    hidden = set(log.quantities) == {"qdd"} and 2 * log.free_motions < log.samples
    sets = [each for each in SETS.values() if each.fits(spec.system) and not (hidden and each.has_residual)]
    for chosen in sets if not spec.noise.external else [each for each in sets if each.has_joint_friction]:
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
    """Return the specification with the set for small data sets, and a table that contains only this set."""
    spec = spec.with_options(inertia=spec.options.inertia or "auto")
    return spec.with_set(FEW), (Compared(FEW.name, chosen=True, note=note),)


def with_priors(
    spec: Specification,
    data: Dataset | Sequence[Observation],
    learn: Sequence[str] | None = None,
    progress: FitProgress | None = None,
) -> tuple[Specification, tuple[Compared, ...]]:
    """Return the specification with automatically selected priors, and the comparison table.

    Args:
        spec: the model with the noise for these data.
        data: the log, or the rows of the log that are in memory.
        learn: the parts to learn. By default, all parts are learned.
        progress: a function called after each candidate with the number completed, the total number, and NaN.
    """
    if learn is not None:
        return without_comparison(spec, "not everything is learned")
    log, _ = in_motion(spec.system, training_of(data, spec.system, (), spec.noise.acceleration, {}))
    if min(len(m.q) for m in log.measurements) < FEWEST:
        return without_comparison(spec, f"fewer than {FEWEST} samples")
    trials = [Trial(candidate) for candidate in candidates_of(spec, log)]
    halves = [halves_of(m.q, m.qd, log.period > 0.0) for m in log.measurements]
    for half in range(HALVES):
        rows = [(own == half).nonzero()[:, 0] for own in halves]
        rest = [(own != half).nonzero()[:, 0] for own in halves]
        train, test = log.of_rows(rest), log.of_rows(rows).evenly(ROWS)
        inertia: Inertia | None = None
        for number, trial in enumerate(trials, 1):
            if not trial.note:
                if trial.candidate.inertia and inertia is None:
                    asking = spec.with_set(trial.candidate.set).with_options(inertia="auto")
                    inertia = asking.inertia_of(train)
                _score(spec, trial, trials, inertia, train, test)
            if progress is not None:
                progress(half * len(trials) + number, HALVES * len(trials), math.nan)
        if half + 1 < HALVES:
            _drop(trials)
    return _result(spec, trials)


@dataclass
class Trial:
    """The scores of a candidate so far.

    Attributes:
        candidate: the candidate.
        scores: the score of each block, by half.
        coverage: fraction of measured values within ±2σ, by half.
        independent: number of independent samples κ n in the halves on which the candidate was trained.
        begin: the hyperparameters learned on the first half.
        inertia_found: whether the identified inertia differs from that of the robot file.
        links_found: whether that of the links differs too, and not only that of the drives.
        note: the reason why the candidate was dropped.
    """

    candidate: Candidate
    scores: list[Tensor] = field(default_factory=list)
    coverage: list[float] = field(default_factory=list)
    independent: float = 0.0
    begin: Mapping[str, Tensor] | None = None
    inertia_found: bool = False
    links_found: bool = False
    note: str = ""

    @property
    def parameters(self) -> int:
        """Number of learned parameters of the kernels."""
        return sum(x.numel() for x in kernel_parameters(self.begin or {}).values())

    @property
    def name(self) -> str:
        """Name in the comparison table, which states whether inertia of links or only drives was found."""
        only_drives = self.inertia_found and not self.links_found
        return f"{self.candidate.set.name}, drives identified" if only_drives else self.candidate.name

    def row(self, best: Tensor, chosen: bool) -> Compared:
        """Return the row for this candidate in the comparison table."""
        if not self.scores:
            return Compared(self.name, note=self.note)
        own = torch.cat(self.scores)
        behind, error = difference(best[: len(own)], own)
        coverage = sum(self.coverage) / len(self.coverage)
        density = float(own.mean()) if len(own) == len(best) else None
        return Compared(self.name, density, behind, error, chosen, self.note, coverage)


def _score(
    spec: Specification,
    trial: Trial,
    trials: Sequence[Trial],
    inertia: Inertia | None,
    train: Training,
    test: Training,
) -> None:
    """Train a candidate on one half and score it on the other."""
    candidate, robot = trial.candidate, spec.system.robot
    if not candidate.inertia or inertia is None:
        inertia = Inertia(robot)
    trial.inertia_found |= inertia.robot is not robot
    trial.links_found |= inertia.per_gain is not None
    if candidate.inertia and inertia.robot is robot:
        # The model is the same as that without identification.
        for other in trials:
            same = other.candidate == Candidate(candidate.set) and not other.note
            if same and len(other.scores) == len(trial.scores) + 1:
                trial.scores.append(other.scores[-1])
                trial.coverage.append(other.coverage[-1])
                trial.independent = other.independent
                return
    try:
        fit = trained(spec.with_set(candidate.set), inertia, train, trial.begin)
        density, coverage = log_density(fit, test)
        trial.scores.append(blocks_of(density))
        trial.coverage.append(coverage)
        trial.independent += fit.problem.power * fit.problem.training.samples
        trial.begin = fit.hyperparameters
    except NumericalError as cause:
        trial.note = f"not computed: {str(cause).splitlines()[0]}"


def _drop(trials: Sequence[Trial]) -> None:
    """Drop the candidates that are far behind the best."""
    for trial, behind, error in behind_best([trial for trial in trials if not trial.note]):
        if behind > DROPPED * error:
            trial.note = "dropped after the first half"


def behind_best(trials: Sequence[Trial]) -> list[tuple[Trial, float, float]]:
    """Return the deficit of each candidate and its standard error.

    The deficit is relative to the best candidate, less the cost of the additional parameters of the best.
    """
    if not trials:
        return []
    best = max(trials, key=lambda trial: float(torch.cat(trial.scores).mean()))
    n, found = best.independent, []
    cost = 0.5 * math.log(n) / n if 1.0 < n < FEWEST else 0.0
    for trial in trials:
        behind, error = difference(torch.cat(best.scores), torch.cat(trial.scores))
        found.append((trial, behind - cost * max(best.parameters - trial.parameters, 0), error))
    return found


def _result(spec: Specification, trials: Sequence[Trial]) -> tuple[Specification, tuple[Compared, ...]]:
    """Return the specification with the selected set, and the comparison table."""
    found = any(trial.inertia_found for trial in trials)
    # If no different inertia was found, a candidate with identification equals the one without.
    shown = [t for t in trials if not t.candidate.inertia or spec.options.inertia == "auto" or found]
    whole = [trial for trial in shown if not trial.note]
    if not whole:
        return without_comparison(spec, "no candidate could be computed")
    chosen = next(trial for trial, by, error in behind_best(whole) if by <= error)
    best = max((torch.cat(trial.scores) for trial in whole), key=lambda x: float(x.mean()))
    table = tuple(trial.row(best, trial is chosen) for trial in shown)
    identifies = chosen.candidate.inertia or not found
    spec = spec.with_options(inertia=spec.options.inertia or ("auto" if identifies else "file"))
    return spec.with_set(chosen.candidate.set), table


def halves_of(q: Tensor, qd: Tensor, in_order: bool) -> Tensor:
    """Assign each row to a half, in alternating segments of time or along a direction in state space."""
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
    """Return a candidate conditioned on `ROWS` rows of one half of the data.

    Args:
        spec: the specification with the priors of the candidate.
        inertia: the robot inertia to use in learning.
    """
    spec, pinned = identified(spec, train, inertia) if inertia.per_gain is not None else (spec, {})
    rows = scaled(train.evenly(ROWS), spec.system, spec.priors, {}, spec.options.standardize)
    few = problem = spec.problem(rows, inertia.robot, pinned)
    if not is_finite(problem.priors):
        few = dataclasses.replace(problem, training=rows.evenly(LEARN_ROWS))
    search = search_of(spec, few, {}, None, QUICK)
    if begin is not None:
        begin = {key: begin.get(key, value) for key, value in search.start.items()}
    lesson = solve(spec, few, search, None, begin, rows)
    whole = dataclasses.replace(lesson.problem, training=rows)
    return conditioned(spec, prepared(spec, whole, lesson.hyperparameters), lesson.hyperparameters)


@torch.no_grad()
def log_density(fit: StructuredFit, test: Training) -> tuple[Tensor, float]:
    """Return the log density of each sample `(n,)`, and the fraction of values within ±2σ.

    If accelerations were measured, other measurements are ignored.

    Raises:
        NumericalError: a covariance is not positive definite.
    """
    judged = [m for m in test.measurements if m.quantity == "qdd"] or test.measurements
    densities, within = [], []
    for m in judged:
        prediction = fit.predict(m.q, m.qd, m.tau, m.quantity, active=m.active, noise=True)
        N = torch.eye(m.values.shape[-1], dtype=m.values.dtype, device=m.values.device)
        if m.quantity == "qdd" and fit.system.m:
            N = fit.system.equations(m.q, m.qd, m.active).N
        assert prediction.covariance is not None and prediction.std is not None
        own = _density(m.values - prediction.mean, prediction.covariance, N)
        spread = torch.diag_embed(m.values.var(0) + prediction.std**2)
        any_row = _density(m.values - m.values.mean(0), spread, N)
        densities.append(torch.logaddexp(own + math.log1p(-OUTLIERS), any_row + math.log(OUTLIERS)))
        within.append(((m.values - prediction.mean).abs() <= 2.0 * prediction.std).flatten())
    return torch.cat(densities), float(torch.cat(within).double().mean())


def _density(r: Tensor, V: Tensor, N: Tensor) -> Tensor:
    """Return log p(N r; N V N + 1 − N) `(n,)`, which is constant in the directions that N removes."""
    # N V N + 1 − N = L Lᵀ
    L, info = torch.linalg.cholesky_ex(N @ V @ N + torch.eye(N.shape[-1], dtype=N.dtype, device=N.device) - N)
    if bool(info.any()):
        raise NumericalError("a predictive covariance is not positive definite")
    normal = torch.distributions.MultivariateNormal(torch.zeros_like(r), scale_tril=L, validate_args=False)
    return normal.log_prob((N @ r[..., None])[..., 0])


def blocks_of(density: Tensor) -> Tensor:
    """Return the means `(BLOCKS,)` over contiguous blocks of rows."""
    return torch.stack([part.mean() for part in density.tensor_split(BLOCKS)])


def difference(best: Tensor, own: Tensor) -> tuple[float, float]:
    """Return the deficit of a score relative to the best, and its standard error, from blocks `(k,)`."""
    behind = best - own
    return float(behind.mean()), float(behind.std() / math.sqrt(len(behind)))
