"""Stage 2: learn completion alone."""

from collections.abc import Iterable

from torch import nn

from depthreg.stages.base import Stage


class CompletionStage(Stage):
    """Registration and the first convolutions that it reads stay as stage 1 left them, to the bit."""

    name = "completion"

    def frozen_modules(self, epoch: int) -> Iterable[nn.Module]:
        """The whole registration side, in every epoch."""
        return self.network.registration_modules()
