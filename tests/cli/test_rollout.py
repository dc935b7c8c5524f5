"""`forcegp rollout`: what it writes where samples diverge or the log's contact changes."""

from __future__ import annotations

import math

import pytest
import torch

import forcegp
from forcegp.cli.rollout import _as_data, _say_contact, _spread
from forcegp.rollout.trajectory import Divergence, Rollout
from logs import random_log


def test_the_spread_is_that_of_the_samples_that_are_left() -> None:
    q = torch.randn(5, 8, 3, dtype=torch.float64)
    torch.testing.assert_close(_spread(q), q.std(0))
    q[0, 3:] = math.nan
    q[1, 6:] = math.nan
    expected = torch.cat([q[:, :3].std(0), q[1:, 3:6].std(0), q[2:, 6:].std(0)])
    torch.testing.assert_close(_spread(q), expected)
    q[1:4, 7] = math.nan
    torch.testing.assert_close(_spread(q), expected[:7])


def test_a_contact_that_the_log_changes_is_said() -> None:
    log = random_log(40)
    closed = torch.ones(40, dtype=torch.bool)
    closed[:10] = False
    (name,) = log.contact
    log = log.replace(contact={name: closed})
    with pytest.warns(
        UserWarning, match=rf"keeps {name!r} open, .* but it changes in the log after .*--unilateral"
    ):
        _say_contact(log, unilateral=False)
    _say_contact(log, unilateral=True)
    _say_contact(log[10:], unilateral=False)


@pytest.mark.parametrize(("steps", "rows"), [(11.4, 12), (11.6, 12), (5.0, 6)])
def test_a_prediction_that_diverges_between_two_rows_ends_at_the_first(steps: float, rows: int) -> None:
    """The rollout has 12 rows; the time of the divergence is that of an integration step, not of a row."""
    scene, dt = forcegp.load_scene("pendulum_wire"), 0.01
    system = scene.system()
    log = random_log(40, joints=system.robot.joint_names)
    log = log.replace(
        contact=dict.fromkeys(system.contact_names, next(iter(log.contact.values()))), contact_extras={}
    )
    motion = [getattr(log, name)[:12] for name in ("t", "q", "qd", "qdd", "tau")]
    active = torch.stack(list(log.contact.values()), dim=-1)[:12]
    gone = Divergence(steps * dt, 0, [0.0, 0.0], [0.0, 0.0], "too fast")
    path = Rollout(system, *motion, *[torch.zeros(12, 1)] * 3, active, diverged=[gone])
    assert len(_as_data(path, log, dt)) == rows
