"""Learning of a structured Gaussian process that a later fit resumes where it was interrupted."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from forcegp.forces.learn import Problem
from forcegp.forces.measurements import Training
from forcegp.forces.start import Search
from forcegp.gp.optimise import LearningOptions, Progress
from forcegp.models.base import FitProgress
from forcegp.models.structured_learning import Lesson, prepared, solve
from forcegp.models.structured_spec import Specification
from forcegp.storage.checkpoint import Checkpoint
from forcegp.storage.system import pack_system


def learned(
    spec: Specification,
    problem: Problem,
    search: Search,
    file: Path | None,
    progress: FitProgress | None,
    begin: Mapping[str, Tensor] | None,
    neighbours: Training | None,
) -> tuple[Lesson, Checkpoint | None]:
    """Learn what is free in a search, and record it; where nothing is free, prepare the problem alone.

    Args:
        spec: the model.
        problem: all samples.
        search: what is learned and what is held.
        file: records the evaluations; learning that finds it goes on from there, to the same bits.
        progress: called after each evaluation.
        begin: where to begin.
        neighbours: see `forcegp.models.structured_learning.solve`.

    Returns:
        What was learned, and its record.

    Raises:
        ModelError: the file belongs to other learning.
    """
    if not search.start:
        return Lesson(prepared(spec, problem, search.held), search.held), None
    saved = None
    if file is not None:
        saved = Checkpoint(file, _key(spec, problem, search, begin))
        saved.read(search.start)
        search = dataclasses.replace(search, recorded=saved.recorded)
    report = None if progress is None else _reported(progress, search.options)
    lesson = solve(spec, problem, search, report, begin, neighbours)
    if saved is not None:
        saved.write()
    return lesson, saved


def _reported(progress: FitProgress, options: LearningOptions) -> Progress:
    return lambda evaluations, value, _: progress(evaluations, options.max_evaluations, value)


def _key(spec: Specification, problem: Problem, search: Search, begin: Mapping[str, Tensor] | None) -> str:
    """Identifies the learning of some tensors, on these data and this system, with these options."""
    training = problem.training
    data = [value for m in training.measurements for value in m.tensors]
    priors = [(type(prior).__name__, prior) for prior in problem.priors]
    record, robot = pack_system(problem.system)
    named = [pair for group in (search.start, search.held, begin or {}) for pair in group.items()]
    state = () if problem.state_std is None else (problem.state_std,)
    return Checkpoint.key_of(
        problem.mean, priors, spec.inference, search.options, training.quantities, *data, *training.noise_std,
        record, *robot.values(), *(part for pair in named for part in pair), *state,
    )  # fmt: skip
