"""`forcegp rollout`: what it writes where samples diverge or the log's contact changes."""

from __future__ import annotations

import math

import pytest
import torch

from forcegp.cli.rollout import _say_contact, _spread
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
    with pytest.warns(UserWarning, match=rf"holds {name!r} open, .* the log changes it after .*--unilateral"):
        _say_contact(log, unilateral=False)
    _say_contact(log, unilateral=True)
    _say_contact(log[10:], unilateral=False)
