"""What happens by the clock: freezing, difficulty, moving on, saving, pictures; and what is measured on the way."""

from depthreg.callbacks.difficulty import DifficultyRamp
from depthreg.callbacks.finite import FiniteLoss
from depthreg.callbacks.freeze import FreezeSchedule
from depthreg.callbacks.interruption import Interruption
from depthreg.callbacks.kept_row import KeptRow
from depthreg.callbacks.panels import Panels
from depthreg.callbacks.patience import Patience
from depthreg.callbacks.progress import StageProgress
from depthreg.callbacks.throughput import Throughput

__all__ = [
    "DifficultyRamp",
    "FiniteLoss",
    "FreezeSchedule",
    "Interruption",
    "KeptRow",
    "Panels",
    "Patience",
    "StageProgress",
    "Throughput",
]
