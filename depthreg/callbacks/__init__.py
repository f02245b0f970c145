"""What happens by the clock: freezing, difficulty, moving on, saving, pictures."""

from depthreg.callbacks.difficulty import DifficultyRamp
from depthreg.callbacks.finite import FiniteLoss
from depthreg.callbacks.freeze import FreezeSchedule
from depthreg.callbacks.interruption import Interruption
from depthreg.callbacks.panels import Panels
from depthreg.callbacks.patience import Patience

__all__ = ["DifficultyRamp", "FiniteLoss", "FreezeSchedule", "Interruption", "Panels", "Patience"]
