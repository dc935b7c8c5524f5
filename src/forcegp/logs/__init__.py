"""Logs of other programs: readers, mappings of columns, clocks, units, derivatives, contact."""

from forcegp.logs.importing import Imported, import_log, read_log
from forcegp.logs.mapping import Mapping, load_mapping, parse_mapping
from forcegp.logs.report import Finding, Report

__all__ = [
    "Finding",
    "Imported",
    "Mapping",
    "Report",
    "import_log",
    "load_mapping",
    "parse_mapping",
    "read_log",
]
