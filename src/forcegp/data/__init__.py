"""Logged motion: data sets and their files, derivatives, noise, selection, and splits."""

from forcegp.data.dataset import Dataset as Dataset
from forcegp.data.dataset import NotLoggedError as NotLoggedError
from forcegp.data.derivative import SavitzkyGolay as SavitzkyGolay
from forcegp.data.fields import DataHeader as DataHeader
from forcegp.data.fields import RobotMismatchWarning as RobotMismatchWarning
from forcegp.data.selection import Split as Split
from forcegp.data.selection import complement as complement
from forcegp.data.selection import farthest_points as farthest_points
from forcegp.data.selection import select_points as select_points
from forcegp.data.selection import split_by_selection as split_by_selection
from forcegp.data.selection import split_by_stretches as split_by_stretches
from forcegp.data.selection import standardized as standardized
from forcegp.data.selection import standardized_inputs as standardized_inputs
from forcegp.data.selection import without_marked_impacts as without_marked_impacts
from forcegp.data.stream import StreamedDataset as StreamedDataset
