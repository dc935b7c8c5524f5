"""Rollouts by C code: the trajectories of the law in PyTorch, of means and of function samples."""

from __future__ import annotations

import dataclasses
import subprocess
from pathlib import Path

import pytest
import torch
from torch import Tensor

from forcegp import dynamics
from forcegp.models.export.motion import CompiledMotion
from forcegp.models.export.source import c_source
from forcegp.rollout import RolloutOptions, forward
from forcegp.rollout.trajectory import Rollout
from models.test_export import COMPILERS, STRICT, fitted, states
from slow import slow_except

SAME = 1e-9  # of the largest value: sums in another order, carried over twenty steps
FIELDS = ("q", "qd", "qdd", "multiplier", "c", "cd")
SMOOTH = ("exact", "every_friction", "zero_mean")  # function samples are made in PyTorch
CASES = [
    "one_contact",
    "free_friction",
    "sparse",
    "exact",
    "every_friction",
    "uncertain_inertia",
    "zero_mean",
]


def both(
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    samples: int,
    still: bool = False,
    duration: float = 0.02,
    **options,
) -> list[Rollout]:
    """A rollout by the law in PyTorch, and by C code."""
    fit, paths = fitted(name), []
    state, active = states(fit)
    q, qd, tau, active = (x[1:4] for x in (*state, active))
    if still:
        qd, tau = 1e-3 * qd, -dynamics.gravity_force(fit.system.robot, q)
        tau[:, 3] += torch.tensor([0.1, 1.0, 8.0])
    how = RolloutOptions(dt=1e-3, on_divergence="keep", **options)
    calls, motion = list[int](), CompiledMotion.__call__

    def counted(self: CompiledMotion, q: Tensor, *others) -> tuple[Tensor, ...]:
        calls.append(len(q))
        return motion(self, q, *others)

    monkeypatch.setattr(CompiledMotion, "__call__", counted)
    for steps in (10**9, 1):
        assert not calls
        monkeypatch.setattr(forward, "COMPILED_STEPS", steps)
        paths.append(fit.rollout(q, qd, tau[:, None], duration, samples, active=active, options=how))
    assert {3, 3 * samples} - {0} == set(calls), "means and samples come from C code"
    return paths


def agree(torch_path: Rollout, compiled: Rollout) -> None:
    for field in FIELDS:
        expected, got = getattr(torch_path, field), getattr(compiled, field)
        if expected.numel():
            scale = float(expected.abs().nan_to_num(0.0).max()) + 1e-12
            torch.testing.assert_close(got, expected, rtol=0.0, atol=SAME * scale, equal_nan=True, msg=field)


@pytest.mark.parametrize("name", slow_except(CASES, "one_contact", "sparse"))
def test_trajectories_are_those_of_the_law_in_pytorch(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = both(monkeypatch, name, 0 if name in SMOOTH else 3)
    agree(first, second)
    if first.samples is not None and second.samples is not None:
        agree(first.samples, second.samples)


@pytest.mark.parametrize("options", [{"method": "rk4"}, {"sticking": False}, {"stabilization": "projection"}])
def test_so_they_are_with_other_options(options: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    # One of the states needs the search of `dry_friction_force`. It is unstable: in PyTorch alone, a change
    # of q by 1e-13 grows to 1e-6 in 20 ms of rk4.
    duration = 0.004 if options.get("method") == "rk4" else 0.02
    first, second = both(monkeypatch, "one_contact", 0, duration=duration, **options)
    assert duration == 0.02 or not (first.diverged or second.diverged)
    agree(first, second)


def test_joints_stick_and_start_to_slide_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = both(monkeypatch, "free_friction", 0, still=True)
    assert 0 < int((first.qd[:, -1] == 0.0).sum()) < 21, "some joints stick"
    agree(first, second)


def test_the_law_in_pytorch_gives_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forward, "COMPILED_STEPS", 1)
    fit = fitted("free_friction")
    q, qd, tau = (x[1].clone() for x in states(fit)[0])
    fit.rollout(q, qd.requires_grad_(), tau[None], 0.005, options=RolloutOptions(dt=1e-3)).q.sum().backward()
    assert qd.grad is not None and bool((qd.grad != 0.0).any())


MAIN = """
#include "forcegp.c"

int main(void) {
  static double table[4096];
  waves w[PRIORS];
  double q[4][NQ], qd[4][NQ], tau[4][NQ], h[4] = {1e-3, 1e-3, 1e-3, 1e-3}, qdd[4][NQ];
  double multiplier[4 * SOME(ROWS)], c[4 * SOME(ROWS)], cd[4 * SOME(ROWS)];
  unsigned char closed[4 * SOME(CONTACTS)], held[4][NQ];
  int wrong = 0;
  memset(closed, 1, sizeof closed);
  for (int i = 0; i < 4096; ++i) table[i] = 1e-3 * (i % 17);
  for (int p = 0; p < PRIORS; ++p) {
    w[p].turn = w[p].phase = w[p].weights = table;
    w[p].rows = 1, w[p].n = p % 2 ? 5 : 0;
  }
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < NQ; ++j)
      q[i][j] = 0.3 * j - 0.2 * i, qd[i][j] = i < 2 ? 0.0 : 0.1 * j, tau[i][j] = i * j;
  qd[3][1] = NAN; /* its motion is not a number, those of others are */
  for (int sticking = 0; sticking < 2; ++sticking) {
    wrong |= forcegp_motions(NULL, w, 4, 2, q[0], qd[0], tau[0], closed, h, sticking, qdd[0], multiplier, c,
                             cd, held[0]);
    for (int i = 0; i < 4; ++i) wrong |= (isfinite(qdd[i][0]) != 0) != (i < 3);
  }
  return wrong;
}
"""


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", slow_except(["one_contact", "sparse", "uncertain_inertia"], "one_contact"))
def test_its_code_compiles_without_warnings_and_sanitizers_find_nothing(
    name: str, compiler: str, tmp_path: Path
) -> None:
    model = dataclasses.replace(fitted(name)._exported(None), functions=0)
    header, source = c_source(model, "forcegp", rollout=True)
    for file, text in (("forcegp.h", header), ("forcegp.c", source), ("main.c", MAIN)):
        (tmp_path / file).write_text(text)
    sanitized = ["-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    command = [compiler, *STRICT, *sanitized, "main.c", "-o", "run", "-lm"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:3000]
    ran = subprocess.run([str(tmp_path / "run")], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
