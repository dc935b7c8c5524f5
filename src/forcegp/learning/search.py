"""Search for hyperparameters by L-BFGS: initial values, bounds, weak priors, warm starts and restarts.

Inputs are standardized, so typical samples are correlated if the length-scale is about the square root of the
number of inputs. A log-normal prior around this initial value has a width of four e-folds above and one
below. It keeps the length-scales of irrelevant inputs from drifting to infinity, and penalises length-scales
so short that a force could fit the noise. The initial standard deviation of a force is the root mean square
of the force that best explains the training residuals in the least-squares sense.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import scipy
import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.forces.noise import initial_torque_noise
from forcegp.forces.priors.base import ANALYTICAL, ForcePrior
from forcegp.forces.priors.contact import below_jamming, initial_coulomb
from forcegp.forces.problem import (
    OWN,
    Problem,
    Tensors,
    is_finite,
    kernel_parameters,
    noise_key,
    typical,
    without_inducing,
)
from forcegp.forces.projection import WhitenedRows
from forcegp.forces.unknowns import stated_tips
from forcegp.gp.features import Block
from forcegp.gp.kernels import Parameters
from forcegp.gp.optimise import FIRST_STEP, Bounds, Learned, LearningOptions, Progress, minimise

LIMITS = {
    "log_coefficient": (math.log(1e-3), math.log(2.0)),
    "log_speed": (math.log(1e-3), math.log(1.0)),
    "log_smoothing": (math.log(1e-4), math.log(0.1)),
}
"""Bounds on the hyperparameters that have an absolute scale."""
RANGES = {"log_lengthscale": (4.0, 8.0)}
"""Range of the other hyperparameters below and above their initial values, in e-folds; `DEFAULT_RANGE` if not
listed. An input becomes irrelevant if its length-scale is 8 e-folds above the initial value."""
DEFAULT_RANGE = (7.0, 7.0)
AT_BOUND = 1e-6
"""Distance from a bound, in e-folds, within which a learned value is considered to be at the bound."""
WIDTH = {
    "log_coefficient": (2.0, 1.0),
    "log_smoothing": (2.0, 1.0),
    "log_speed": (1.0, 1.0),
    "log_lengthscale": (1.0, 4.0),
    "log_noise_std": (5.0, 5.0),
    "log_scale": (1.0, 1.0),
    "log_offset": (1.0, 1.0),
}
"""Standard deviations of log-normal priors below and above the initial value, in e-folds (default 3)."""
START_SAMPLES = 5000
"""Maximum number of evenly spaced samples used to compute initial values."""
FRICTION_SAMPLES = 200
"""Maximum number of samples used to select the initial Coulomb friction."""
COEFFICIENTS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Friction coefficients to try."""
UNSHOWN = 0.1
"""Stated size of a joint's friction, relative to its load, in directions on which no measurement depends. The
unexplained torque of a real iiwa 14 is .08 of the load, over all joints."""
PARALLEL = 1e-9
"""Two directions are considered parallel if one minus their mean cosine is below this value."""


def initial(
    problem: Problem, learn_noise: bool, learn_torque_noise: bool = False, automatic: bool = False
) -> Tensors:
    """Return the default initial values of all learnable parameters of a problem.

    Args:
        automatic: whether the priors were chosen automatically. Friction that no measurement shows then has
            the size `UNSHOWN`. Of given priors, it has that of least squares.
    """
    few = problem
    if problem.training.samples > START_SAMPLES:
        few = dataclasses.replace(problem, training=problem.training.evenly(START_SAMPLES))
    noise, unseen = {}, UNSHOWN * few.typical_load() if automatic else None
    if learn_torque_noise:
        closed = (m.at(few.system) for m in few.training.measurements)
        noise = initial_torque_noise(few.torque_residual(), few.system.robot.driven)
        noise |= stated_tips(few.system, closed)
    if problem.has_coulomb:
        start = _with_friction(few, noise, unseen)
    else:
        beyond_noise = problem.external_std is not None
        start = initial_hyperparameters(problem.priors, few.fixed_rows.blocks, beyond_noise, unseen)
    start |= noise
    if learn_noise:
        stds = problem.training.noise_std
        start |= {noise_key(i): typical(std).double().log() for i, std in enumerate(stds)}
    if problem.parameters is not None:
        named = problem.parameters.named_parameters()
        start |= {f"{ANALYTICAL}.{name}": value.detach().clone() for name, value in named}
    return start


@torch.no_grad()
def _with_friction(problem: Problem, noise: Tensors, unseen: Tensor | None) -> Tensors:
    """Return the most likely Coulomb friction coefficient, and hyperparameters of the remaining forces.

    From a poor coefficient, learning may reach a local optimum in which friction depends on the state.
    """
    few = dataclasses.replace(problem.showing_coulomb(FRICTION_SAMPLES), inducing=None)
    # A force that no law names is learned from what the laws leave.
    laws = few.without_priors([prior.name for prior in problem.priors if prior.remainder])
    laws = without_inducing(laws) if is_finite(laws.priors) else laws
    like = problem.system.robot.mass
    friction = initial_coulomb(problem.priors, like)
    limits = below_jamming(problem.system, problem.training.measurements, problem.priors, limits_of(friction))

    def start_at(x: float, few: Problem = laws) -> tuple[Tensors, WhitenedRows]:
        trial = {
            key: like.new_tensor(min(x, limits[key][1])) if key.endswith("log_coefficient") else value
            for key, value in friction.items()
        }
        rows = few.rows({**trial, **noise})
        start = initial_hyperparameters(few.priors, rows.blocks, few.external_std is not None, unseen)
        return start | trial, rows

    def value(x: float) -> float:
        start, rows = start_at(x)
        return float(laws.negative_log_likelihood(kernel_parameters({**start, **noise}), rows))

    best = min(range(1, len(COEFFICIENTS) - 1), key=lambda k: value(math.log(COEFFICIENTS[k])))
    around = (math.log(COEFFICIENTS[best - 1]), math.log(COEFFICIENTS[best + 1]))
    optimum = scipy.optimize.minimize_scalar(value, bounds=around, method="bounded", options={"xatol": 1e-3})
    return start_at(float(optimum.x), few)[0]


def initial_hyperparameters(
    priors: Sequence[ForcePrior],
    blocks: Sequence[Block],
    beyond_noise: bool = False,
    unseen: Tensor | None = None,
) -> dict[str, Tensor]:
    """Return the initial log-hyperparameters, keyed by `<prior>.<name>`.

    Args:
        beyond_noise: whether to subtract the contribution of noise, for example if unknown forces are given.
        unseen: standard deviation of joint forces `(nq,)` in directions that no measurement shows.

    Raises:
        ModelError: contacts hold all joints in every sample, so no measurement depends on a force.
    """
    if not any(block.target.shape[-1] for block in blocks):
        raise ModelError(
            "no measurement depends on a force",
            expected="a direction in which the robot can move",
            got="contacts that hold all joints in every sample",
            hint="add samples in which these contacts are open",
        )
    params: dict[str, Tensor] = {}
    # Some priors share the hyperparameters of another prior.
    for p, prior in [(p, prior) for p, prior in enumerate(priors) if prior.prefix == prior.name]:
        widths = {name: x.shape[-1] for name, x in blocks[0].features[p].items()}
        stated = unseen if prior.per_joint else None
        scale = _force_scale(p, blocks, prior.commensurate, beyond_noise, stated)
        initial = prior.stated(prior.kernel.initial(len(scale), widths, scale.log().cpu().double()))
        params |= {f"{prior.name}.{name}": value.to(scale.device) for name, value in initial.items()}
    return params


def _force_scale(
    p: int, blocks: Sequence[Block], commensurate: bool, beyond_noise: bool, unseen: Tensor | None = None
) -> Tensor:
    """Return the root mean square `(components,)` of the least-squares force of prior p.

    The rows do not depend on the directions 1 − W⁺W, such as those of joints that act along a contact. The
    least-squares force W⁺y is zero there, so the given standard deviation `unseen` is used instead.

    The rows determine only the sum of components with the same direction, which the minimum-norm solution
    divides evenly. Components with different units, such as viscous and dry friction, are fitted separately.
    """
    operators = [block.operators[p] for block in blocks]
    each = torch.arange(operators[0].shape[-1], device=operators[0].device)
    first = each if commensurate else _first_parallel(operators)
    groups, alone = first.unique(), (first[:, None] == first).sum(0) == 1
    total = torch.zeros_like(blocks[0].operators[p][0, 0])
    weight = torch.zeros_like(total)
    for block in blocks:
        W = block.operators[p]
        inverse, square = torch.linalg.pinv(W[..., groups], rtol=1e-6), torch.zeros_like(W[:, 0])
        square[:, groups] = (inverse @ block.target[..., None])[..., 0] ** 2
        if beyond_noise:
            square[:, groups] -= inverse.square().sum(-1)
        if unseen is not None:
            hidden = 1.0 - (inverse @ W[..., groups]).diagonal(dim1=-2, dim2=-1)
            square[:, groups] += hidden.clamp(min=0.0) * unseen[groups] ** 2
        size = torch.where(alone, 1.0, W.square().sum(1))
        total, weight = total + (square * size)[:, first].sum(0), weight + size.sum(0)
    return (total.clamp(min=0.0) / weight.clamp(min=1e-300)).sqrt().clamp(1e-3, 1e4)


def _first_parallel(operators: Sequence[Tensor]) -> Tensor:
    """Return, for each component, the first one with the same direction at all samples, `(components,)`."""
    along = most = torch.zeros_like(operators[0][0].mT @ operators[0][0])
    for W in operators:
        size = W.square().sum(1).sqrt()
        along = along + (W.mT @ W).abs().sum(0)
        most = most + (size[:, :, None] * size[:, None, :]).sum(0)
    # |w_k·w_l| ≤ |w_k||w_l|: if the sums are equal, so are the two sides at every sample.
    parallel = ((along >= (1.0 - PARALLEL) * most) & (most > 0.0)).fill_diagonal_(True)
    return parallel.to(torch.uint8).argmax(0)


def limits_of(params: Parameters) -> dict[str, tuple[float, float]]:
    """Return the bounds on the hyperparameters that have an absolute scale."""
    return {key: LIMITS[_kind(key)] for key in params if _kind(key) in LIMITS}


def box_around(
    start: Parameters, begin: Parameters | None = None
) -> dict[str, tuple[float | Tensor, float | Tensor]]:
    """Return the bounds on each hyperparameter for the optimiser.

    Far from the initial values, double precision cannot resolve the likelihood, for example if forces are a
    million times as large as the noise.

    Args:
        begin: additional initial values that the bounds must include.
    """
    box: dict[str, tuple[float | Tensor, float | Tensor]] = {}
    for key, x in start.items():
        below, above = RANGES.get(_kind(key), DEFAULT_RANGE)
        y = x if begin is None else begin[key]
        box[key] = torch.minimum(x - below, y), torch.maximum(x + above, y)
    return {**box, **limits_of(start)}


def doubts_at_bounds(tensors: Mapping[str, Tensor], box: Bounds) -> tuple[str, ...]:
    """Return warnings about hyperparameters that ended at a bound.

    Noise at either bound and forces at the upper bound are questionable.
    """
    doubts = []
    for key, (low, high) in box.items():
        at = {"lower": low, "upper": high}
        sides = {"log_lengthscale": ("lower",), "log_noise_std": ("lower", "upper")}.get(
            _kind(key), () if _kind(key) in LIMITS else ("upper",)
        )
        for side in sides:
            count = int((tensors[key] - at[side]).abs().lt(AT_BOUND).sum())
            if count:
                doubts.append(
                    f"{count} of {tensors[key].numel()} values of {key} ended at their {side} bound, "
                    "far from their initial values: look for outliers, or specify the noise"
                )
    return tuple(doubts)


def _kind(key: str) -> str:
    """Return the kind of a hyperparameter, which is the last part of its name."""
    return key.rsplit(".", 1)[-1]


def negative_log_prior(params: Parameters, start: Mapping[str, Tensor]) -> Tensor | float:
    """Return Σ ½ ((θ − θ_start)/width)², the negative log density of the weak priors up to a constant."""
    total: Tensor | float = 0.0
    for key, value in params.items():
        below, above = WIDTH.get(_kind(key), (3.0, 3.0))
        shift = value - start[key]
        total = total + (0.5 * (shift / torch.where(shift < 0.0, below, above)) ** 2).sum()
    return total


def checked_start(values: Mapping[str, Tensor], start: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Check initial values against the defaults, and return them.

    Raises:
        ModelError: a value is missing or has the wrong shape.
    """
    for key, value in start.items():
        got = values[key].shape if key in values else None
        if got != value.shape:
            raise ModelError(
                f"incompatible initial hyperparameters: {key}",
                expected=tuple(value.shape),
                got="none" if got is None else tuple(got),
                hint="use those of a model with the same priors",
            )
    return {key: values[key].detach().to(value) for key, value in start.items()}


def random_starts(start: Mapping[str, Tensor], restarts: int, seed: int) -> Iterator[dict[str, Tensor]]:
    """Yield the initial values, and then one set of random values around them per restart."""
    generator = torch.Generator().manual_seed(seed)
    yield dict(start)
    for _ in range(restarts):
        yield {
            key: value
            if key.startswith(OWN)
            else value + torch.randn(value.shape, dtype=torch.float64, generator=generator).to(value)
            for key, value in start.items()
        }


def warm_start_sizes(samples: int, first: int | None) -> list[int]:
    """Return the numbers of samples used for warm starts, which double up to half of all samples."""
    sizes: list[int] = []
    size = first
    while size is not None and samples > 2 * size:
        sizes.append(size)
        size *= 2
    return sizes


@dataclass(frozen=True)
class Search:
    """Search for hyperparameters.

    Attributes:
        start: default initial values, on which the weak priors are centred.
        held: fixed values, which are not learned.
        options: optimiser options.
    """

    start: Tensors
    held: Tensors
    options: LearningOptions

    def solve(
        self, problem: Problem, progress: Progress | None = None, begin: Mapping[str, Tensor] | None = None
    ) -> Learned:
        """Learn the hyperparameters, with warm starts and restarts as requested by the options.

        Args:
            progress: called after each evaluation on all data.
            begin: initial values for learning from all data, which replace warm starts and restarts.

        Raises:
            ModelError: `begin` does not match the learned parameters.
            NumericalError: the likelihood cannot be computed.
        """
        if begin is not None:
            return self._minimise(problem, checked_start(begin, self.start), progress)
        candidates = (
            self._minimise(problem, self._warmed(problem, cold), progress)
            for cold in random_starts(self.start, self.options.restarts, self.options.seed)
        )
        return min(candidates, key=lambda learned: learned.value)

    def values(self, learned: Learned) -> Tensors:
        """Return all hyperparameters, both learned and fixed."""
        return {**self.held, **learned.tensors}

    def objective(self, problem: Problem, tensors: Tensors) -> Tensor:
        """Return −κ log p(y | θ) − log p(θ), or a bound on it; p(θ) is the weak prior, if enabled."""
        hyper = {key: v for key, v in tensors.items() if not key.startswith(ANALYTICAL + ".")}
        weak = negative_log_prior(hyper, self.start) if self.options.hyperpriors else 0.0
        rows = problem.rows_for(tensors, self.held)
        return problem.negative_log_likelihood(kernel_parameters({**self.held, **tensors}), rows) + weak

    def _warmed(self, problem: Problem, cold: Tensors) -> Tensors:
        """Return the values learned from fewer samples, or `cold` if it is a better start for all data."""
        first = cold
        for samples in warm_start_sizes(problem.training.samples, self.options.warm_start):
            small = dataclasses.replace(problem, training=problem.training.thinned(samples))
            first = self._minimise(small, self._better(small, first, cold), None).tensors
        return self._better(problem, first, cold)

    @torch.no_grad()
    def _better(self, problem: Problem, one: Tensors, two: Tensors) -> Tensors:
        if one is two:
            return one
        return min((one, two), key=lambda tensors: float(self.objective(problem, tensors)))

    def _minimise(self, problem: Problem, begin: Tensors, progress: Progress | None) -> Learned:
        analytical = frozenset(key for key in begin if key.startswith(ANALYTICAL + "."))
        hyper = {key: value for key, value in self.start.items() if key not in analytical}
        bounds = box_around(hyper, begin)
        if problem.has_coulomb:
            limits = limits_of(self.start)
            bounds |= below_jamming(problem.system, problem.training.measurements, problem.priors, limits)
        # The tolerance is relative to the objective, so its part that is independent of θ is left out.
        constant = float(problem.fixed_rows.constant)

        def objective(tensors: Tensors) -> Tensor:
            return self.objective(problem, tensors) - constant

        report = None if progress is None else lambda n, value, best: progress(n, value + constant, best)
        # With Coulomb friction, neither rule leads to the better optimum on all logs
        # (benchmarks/notes/inference.md), so the first step is not limited.
        step = math.inf if problem.has_coulomb else FIRST_STEP
        learned = minimise(objective, begin, self.options, analytical, bounds, report, step)
        history = [value + constant for value in learned.history]
        doubts = doubts_at_bounds(learned.tensors, bounds)
        return dataclasses.replace(learned, value=learned.value + constant, history=history, doubts=doubts)
