"""How a proposed mapping knows whether a contact is closed."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.errors import DataError
from forcegp.logs import evidence
from forcegp.logs.contact import force_levels, level_and_spread
from forcegp.logs.draft import Draft
from forcegp.logs.sections import ContactSection
from forcegp.logs.signals import Array, Signals
from forcegp.logs.table import LogTable

LEAST_FORCE = 1.0
"""A contact that is always closed presses with more than this [N]."""


def propose_contacts(
    table: LogTable, draft: Draft, system: ConstrainedSystem, signals: Callable[[], Signals]
) -> None:
    """Write into a draft how the state of each contact of the scene may be known.

    Args:
        table: the log.
        draft: gets a table for each contact.
        system: the robot with its contacts.
        signals: reads the log by the draft, with accelerations.
    """
    trial: Signals | None = None
    for contact in system.contacts:
        name = contact.name
        column = next(
            (c for c in table.names if "contact" in c.lower() and (name in c or system.m == 1)), None
        )
        if column is not None and np.isin(table.stream_of(column).columns[column], (0.0, 1.0)).all():
            draft.contacts[name] = ['source = "column"', f"column = {json.dumps(column)}"]
        elif draft.wrench or not isinstance(contact, SurfaceContact):
            draft.contacts[name] = ['source = "wrench"' if draft.wrench else 'source = "always"']
        else:
            trial = signals() if trial is None else trial
            values = evidence.multiplier(trial, system, contact)
            source, reason = _state(values, name)
            draft.contacts[name] = [f'source = "{source}"   # or "multiplier", "distance", "always", "never"']
            draft.say(f"contact {name}", f"no contact column; {reason}", doubt=True)


def _state(values: Array, name: str) -> tuple[str, str]:
    """Whether λ of the rigid body shows two states, or which one it shows."""
    middle, spread = level_and_spread(values)
    try:
        high, low = force_levels(values, name, ContactSection(source="multiplier"))
    except DataError:
        source = "always" if middle > max(2.0 * spread, LEAST_FORCE) else "never"
        return source, f"λ of the rigid body shows one state, {middle:.3g} ± {spread:.2g} N"
    return "multiplier", f"λ of the rigid body shows two states, parted at {low:.3g} to {high:.3g} N"
