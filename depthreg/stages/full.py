"""Stage 3: everything together, with all artifacts."""

from collections.abc import Iterable

from torch import nn

from depthreg.stages.base import Stage


class FullStage(Stage):
    """Everything learns in every epoch."""

    name = "full"

    def frozen_modules(self, epoch: int) -> Iterable[nn.Module]:
        """Nothing."""
        return []
