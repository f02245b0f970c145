"""How large gradients are."""

import lightning as L
import torch
from torch.optim import Optimizer


class GradientNorm(L.Callback):
    """Logs `train/grad_norm`: the 2-norm over all that learns, before clipping, as the mean over an epoch's steps."""

    def on_before_optimizer_step(self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: Optimizer) -> None:
        """Add a step to the mean."""
        gradients = [parameter.grad for parameter in pl_module.parameters() if parameter.grad is not None]
        norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(gradient) for gradient in gradients]))
        pl_module.log("train/grad_norm", norm, on_step=False, on_epoch=True, batch_size=1)
