"""Stage 1: learn both tasks together on simple scenes."""

from collections.abc import Iterable
from typing import Any

from torch import nn

from depthreg.stages.base import Stage


class JointStage(Stage):
    """Registration learns in every epoch, completion in every other one.

    Args:
        freeze_period: Completion is frozen in every `freeze_period`-th epoch; 2 in the paper.
        **options: See `Stage`.
    """

    name = "joint"

    def __init__(self, freeze_period: int = 2, **options: Any) -> None:
        super().__init__(**options)
        self.freeze_period = freeze_period

    def frozen_modules(self, epoch: int) -> Iterable[nn.Module]:
        """The completion layers, in every `freeze_period`-th epoch; the first epoch trains everything."""
        return self.network.completion_modules() if epoch % self.freeze_period == self.freeze_period - 1 else []
