"""What happens by the clock: freezing, difficulty, pictures."""

from depthreg.callbacks.difficulty import DifficultyRamp
from depthreg.callbacks.freeze import FreezeSchedule
from depthreg.callbacks.panels import Panels

__all__ = ["DifficultyRamp", "FreezeSchedule", "Panels"]
