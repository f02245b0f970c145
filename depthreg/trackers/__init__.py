"""Where a run is looked at: one run of depthreg, whatever its stages and restarts, is one run in each tracker."""

from depthreg.trackers.base import Run, Tracker
from depthreg.trackers.csv_file import ResumableCSVLogger
from depthreg.trackers.several import Trackers, check_trackers, open_trackers

__all__ = ["ResumableCSVLogger", "Run", "Tracker", "Trackers", "check_trackers", "open_trackers"]
