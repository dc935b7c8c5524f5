"""Minimisation: the optimum of known functions, honest flags, the best point kept."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from forcegp.errors import ModelError, NumericalError, UnknownNameError
from forcegp.gp.optimise import FIRST_STEP, LearningOptions, minimise

START = {"a": torch.tensor([3.0, -2.0], dtype=torch.float64), "b": torch.tensor(1.5, dtype=torch.float64)}


def bowl(x: dict[str, Tensor]) -> Tensor:
    """Smallest, at 2, where a = (1, 4) and b = −0.5."""
    return (
        ((x["a"] - torch.tensor([1.0, 4.0])) ** 2 * torch.tensor([1.0, 10.0])).sum()
        + (x["b"] + 0.5) ** 4
        + 2.0
    )


def rosenbrock(x: dict[str, Tensor]) -> Tensor:
    return (1 - x["a"][0]) ** 2 + 100 * (x["a"][1] - x["a"][0] ** 2) ** 2 + x["b"] ** 2


@pytest.mark.parametrize(
    ("options", "close"),
    [
        (LearningOptions(tolerance=1e-12), 1e-6),
        (LearningOptions("adam", max_evaluations=2000, tolerance=1e-9, learning_rate=0.1), 1e-3),
    ],
    ids=["lbfgs", "adam"],
)
def test_the_optimum_is_found(options: LearningOptions, close: float) -> None:
    learned = minimise(bowl, START, options)
    assert learned.converged and learned.message.islower(), learned.message
    assert learned.value == pytest.approx(2.0, abs=close)
    assert learned.tensors["a"].tolist() == pytest.approx([1.0, 4.0], abs=close**0.5)
    assert learned.evaluations == len(learned.history)
    assert learned.value == min(learned.history) == pytest.approx(float(bowl(learned.tensors)))


@pytest.mark.parametrize("optimizer", ["lbfgs", "adam"])
def test_running_out_of_evaluations_is_no_convergence(optimizer: str) -> None:
    learned = minimise(rosenbrock, START, LearningOptions(optimizer, max_evaluations=6))  # type: ignore[arg-type]
    assert not learned.converged
    assert learned.evaluations == 6
    assert learned.message
    assert learned.value < learned.history[0]


def test_lbfgs_keeps_to_bounds_and_adam_has_two_rates() -> None:
    bounded = minimise(bowl, START, LearningOptions(tolerance=1e-12), bounds={"a": (0.0, 3.0)})
    assert bounded.tensors["a"].tolist() == pytest.approx([1.0, 3.0], abs=1e-4)
    options = LearningOptions("adam", max_evaluations=2, learning_rate=0.1, analytical_learning_rate=0.01)
    moved: list[dict[str, Tensor]] = []

    def record(x: dict[str, Tensor]) -> Tensor:
        moved.append({key: value.detach().clone() for key, value in x.items()})
        return bowl(x)

    minimise(record, START, options, analytical=frozenset({"b"}))
    step = {key: (moved[1][key] - moved[0][key]).abs().max() for key in START}
    assert float(step["a"]) == pytest.approx(0.1, rel=1e-4)  # Adam's first step is its rate
    assert float(step["b"]) == pytest.approx(0.01, rel=1e-4)


def test_the_first_step_in_a_box_is_limited_where_the_objective_is_steep() -> None:
    """Without a limit L-BFGS-B evaluates the corner of the box."""
    moved: list[float] = []

    def steep(x: dict[str, Tensor]) -> Tensor:
        moved.append(float((x["a"].detach() - START["a"]).abs().max()))
        return 1e4 * bowl(x)

    box = {"a": (START["a"] - 50.0, START["a"] + 50.0), "b": (-50.0, 50.0)}
    learned = minimise(steep, START, LearningOptions(tolerance=1e-12), bounds=box)
    assert learned.converged and learned.value == pytest.approx(2e4, abs=1e-3)
    assert 0.0 < moved[1] <= FIRST_STEP * (1.0 + 1e-9)


def test_tensors_that_do_not_matter_stay_and_the_start_is_not_changed() -> None:
    start = {**START, "idle": torch.tensor([7.0], dtype=torch.float64)}
    learned = minimise(bowl, start, LearningOptions(max_evaluations=20))
    assert learned.tensors["idle"].tolist() == [7.0]
    assert START["a"].tolist() == [3.0, -2.0]


def test_progress_sees_every_evaluation_and_the_best_tensors() -> None:
    seen: list[tuple[int, float, float]] = []
    learned = minimise(
        rosenbrock,
        START,
        LearningOptions(max_evaluations=15),
        progress=lambda n, v, best: seen.append((n, v, float(rosenbrock(best)))),
    )
    assert [n for n, _, _ in seen] == list(range(1, learned.evaluations + 1))
    best = [value for _, _, value in seen]
    assert best == pytest.approx([min(learned.history[: i + 1]) for i in range(len(seen))])


def test_what_cannot_be_learned_is_refused() -> None:
    with pytest.raises(NumericalError, match="not finite at the start"):
        minimise(lambda x: bowl(x) * float("nan"), START, LearningOptions(max_evaluations=3))
    with pytest.raises(UnknownNameError, match=r"unknown optimizer 'lbfg'[\s\S]*did you mean 'lbfgs'"):
        _unchecked("lbfg")
    with pytest.raises(ModelError, match=r"max_evaluations ≥ 1\n.*got: 0"):
        LearningOptions(max_evaluations=0)


def _unchecked(name: str) -> LearningOptions:
    from jaxtyping import config

    config.update("jaxtyping_disable", True)
    try:
        return LearningOptions(name)  # type: ignore[arg-type]
    finally:
        config.update("jaxtyping_disable", False)
