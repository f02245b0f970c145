"""What happens by the clock: freezing, difficulty, moving on, pictures."""

from depthreg.callbacks.difficulty import DifficultyRamp
from depthreg.callbacks.freeze import FreezeSchedule
from depthreg.callbacks.panels import Panels
from depthreg.callbacks.patience import Patience

__all__ = ["DifficultyRamp", "FreezeSchedule", "Panels", "Patience"]
