"""Data sets made of what is not a tensor; run as a script by test_hostile_tables.py."""

from logs import random_log
from raw_errors import outcomes

LOG = random_log()
VALUES = {
    "t": LOG.t.tolist(),
    "q": LOG.q.tolist(),
    "qd": None,
    "tau": 5,
    "qdd": LOG.qdd.numpy(),
    "segment": [0] * 60,
    "contact": [True] * 60,
    "contact.table": {"table": [True] * 60},
    "extras": [1.0],
    "Q": {"Q": [[1.0]]},
    "contact_extras": [1.0],
    "F_I": {"F_I": [1.0]},
    "F_I.table": {"F_I": {"table": [1.0]}},
}
FIELD = {"Q": "extras", "F_I": "contact_extras", "F_I.table": "contact_extras", "contact.table": "contact"}

if __name__ == "__main__":
    outcomes({name: lambda n=name, v=v: LOG.replace(**{FIELD.get(n, n): v}) for name, v in VALUES.items()})
