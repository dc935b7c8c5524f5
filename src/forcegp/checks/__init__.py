"""Checks of a log against a scene before a model is fitted to it."""

from forcegp.checks.finding import KINDS, Finding, Report
from forcegp.checks.log import Log, log_of, read_log
from forcegp.checks.run import check

__all__ = ["KINDS", "Finding", "Log", "Report", "check", "log_of", "read_log"]
