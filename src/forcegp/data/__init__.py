"""Logged motion: the data set and its files, derivatives, noise, selection and splits."""

from forcegp.data.checks import RobotMismatchWarning
from forcegp.data.dataset import Dataset, NotLoggedError
from forcegp.data.derivative import SavitzkyGolay
from forcegp.data.fields import DataHeader
from forcegp.data.selection import (
    Split,
    complement,
    farthest_points,
    select_points,
    split_by_selection,
    split_by_stretches,
    standardized,
    standardized_inputs,
    with_noise,
    without_marked_impacts,
)
from forcegp.data.stream import StreamedDataset

__all__ = [
    "DataHeader",
    "Dataset",
    "NotLoggedError",
    "RobotMismatchWarning",
    "SavitzkyGolay",
    "Split",
    "StreamedDataset",
    "complement",
    "farthest_points",
    "select_points",
    "split_by_selection",
    "split_by_stretches",
    "standardized",
    "standardized_inputs",
    "with_noise",
    "without_marked_impacts",
]
