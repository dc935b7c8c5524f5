"""Profiles of a reproduction, from a few minutes to the sizes of the paper or all samples of the log."""

from __future__ import annotations

from dataclasses import dataclass, replace

from forcegp.errors import UnknownNameError


@dataclass(frozen=True)
class Profile:
    """Sizes of a reproduction.

    Attributes:
        name: name of the profile.
        duration: simulated motion [s].
        seeds: number of simulated runs, each with its own split.
        sizes: training points of the GP models.
        paper_kernels_up_to: largest size at which models with only the paper's kernel are also fitted.
        main: training points of the GP models in the figures over time.
        baseline_points: training points of the analytical model and the neural networks.
        networks: names of the networks to train.
        paper_split_seeds: number of simulated runs that are also scored on the paper's split.
        paper_split_baselines: whether analytical model and networks are also scored on the paper's split.
        stretch: duration of a held-out stretch, and of the window of figures 4 and 5 [s].
        test_samples: maximum number of test samples that are predicted for the scores.
        multiplier_seconds: length of figure 2 [s].
        identification_points: training points of the identification.
        identification_evaluations: iterations of the identification.
        rollout_seconds: length of the open-loop trajectories [s].
        rollout_starts: number of initial states, from an additional simulated run.
        rollout_samples: number of function samples for their bands.
        sparse_sizes: additional training set sizes for the structured models, with evenly spaced rows that
            are not held out.
        exact: whether the GP models follow the paper's settings wherever it states them: only its kernel,
            inputs in their units, the marginal likelihood without priors on hyperparameters, and ADAM with
            learning rate 0.2. Otherwise, the default models and models with the paper's kernel are fitted.
    """

    name: str
    duration: float
    seeds: int
    sizes: tuple[int, ...]
    paper_kernels_up_to: int
    main: int
    baseline_points: int
    networks: tuple[str, ...]
    paper_split_seeds: int = 1
    paper_split_baselines: bool = True
    stretch: float = 3.0
    test_samples: int = 2000
    multiplier_seconds: float = 10.0
    identification_points: int = 200
    identification_evaluations: int = 150
    rollout_seconds: float = 10.0
    rollout_starts: int = 16
    rollout_samples: int = 100
    sparse_sizes: tuple[int, ...] = ()
    exact: bool = False


QUICK = Profile(
    name="quick",
    duration=60.0,
    seeds=1,
    sizes=(50, 100, 200),
    paper_kernels_up_to=200,
    main=200,
    baseline_points=5000,
    networks=("nn",),
    paper_split_baselines=False,
    identification_points=100,
    rollout_seconds=1.0,
    rollout_starts=8,
    rollout_samples=20,
)
PAPER = Profile(
    name="paper",
    duration=600.0,
    seeds=3,
    sizes=(100, 200, 400, 600, 800, 1000),
    paper_kernels_up_to=400,
    main=1000,
    baseline_points=10_000,
    networks=("nn", "nn-30-20", "nn-200x4"),
)
EXACT = replace(PAPER, name="paper-exact", seeds=1, paper_kernels_up_to=0, exact=True)
WHOLE = {"sizes": (100, 400, 1000), "sparse_sizes": (4000, 20_000, 115_200)}
LARGE = replace(QUICK, name="large", duration=600.0, paper_kernels_up_to=0, main=1000, **WHOLE)
PROFILES = {profile.name: profile for profile in (QUICK, PAPER, EXACT, LARGE)}


def profile_of(name: str) -> Profile:
    """Return a profile by name.

    Raises:
        UnknownNameError: no such profile.
    """
    if name not in PROFILES:
        raise UnknownNameError("profile", name, PROFILES)
    return PROFILES[name]
