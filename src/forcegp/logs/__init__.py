"""Logs of other programs: readers, mappings of columns, clocks, units, derivatives, contact."""

from forcegp.logs.importing import Imported, import_log, read_log
from forcegp.logs.mapping import Mapping, load_mapping, parse_mapping
from forcegp.logs.signals import ImportFinding, ImportReport

__all__ = [
    "ImportFinding",
    "ImportReport",
    "Imported",
    "Mapping",
    "import_log",
    "load_mapping",
    "parse_mapping",
    "read_log",
]
