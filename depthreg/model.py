"""`depthreg.load()`: a trained network for one's own program, from arrays to arrays."""

from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from depthreg.checkpoint import RELEASED, load_network
from depthreg.data.sample import Measurement
from depthreg.networks import Network
from depthreg.networks.output import MIN_SIDE_PX
from depthreg.result import Layout, Result

Array = TypeVar("Array", np.ndarray, Tensor)


def load(checkpoint: str | Path | None = None, device: str | torch.device | None = None) -> "Model":
    """Load trained weights.

    Args:
        checkpoint: A stage's checkpoint or published weights (`.safetensors`); the released weights where not given.
        device: Where to compute; a GPU by default where there is one.

    Raises:
        InputError: The file can't be used.

    Examples:
        >>> import depthreg, numpy as np
        >>> model = depthreg.load(device="cpu")
        >>> rgb = np.zeros((96, 128, 3), np.uint8)
        >>> depth_m = np.zeros((96, 128), np.float32)
        >>> depth_m[::8, ::8] = 5.0  # a wall, seen by few rays
        >>> result = model(rgb, depth_m, K=np.array([[100.0, 0, 63.5], [0, 100, 47.5], [0, 0, 1]]))
        >>> result.depth_m.shape, bool(abs(result.depth_m - 5).max() < 1)
        ((96, 128), True)
    """
    network = load_network(RELEASED if checkpoint is None else Path(checkpoint))
    return Model(network).to(device or ("cuda" if torch.cuda.is_available() else "cpu"))


class Model:
    """A network that takes and gives arrays as its user has them.

    Args:
        network: Any of `depthreg.networks`; it stays where it is and gets into evaluation mode.
    """

    def __init__(self, network: Network) -> None:
        self.network = network.eval()

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return next(self.network.parameters()).device

    def to(self, device: str | torch.device) -> Self:
        """Move to a device.

        Returns:
            Itself.
        """
        self.network.to(device)
        return self

    def __call__(self, rgb: Array, depth_m: Array, K: np.ndarray | Tensor | None = None) -> Result[Array]:
        """Align colour with depth and complete the depth.

        What comes back is as what went in: NumPy or torch, its layout, colour's type.

        Args:
            rgb: Colour, uint8 or float in [0, 1]. NumPy: (H, W, 3), or a batch (B, H, W, 3); torch: (3, H, W), or
                (B, 3, H, W).
            depth_m: Sparse z-depth in metres, 0 or NaN where there is none. NumPy: (H, W) or (B, H, W); torch:
                likewise, or with a channel, (1, H, W) or (B, 1, H, W).
            K: Camera matrix of the depth image, (3, 3), or one for each of a batch; `Result.point_cloud` needs it.

        Raises:
            ValueError: Arrays that can't be meant; it says which, and what was expected.
        """
        colour, depth, layout = _colour(rgb), _depth(depth_m), Layout.of(rgb, depth_m)
        if colour.shape[0] != depth.shape[0] or colour.shape[-2:] != depth.shape[-2:]:
            raise ValueError(f"rgb is {_size(colour)} but depth_m is {_size(depth)}: one size was expected")
        if min(depth.shape[-2:]) < MIN_SIDE_PX:
            raise ValueError(f"rgb and depth_m are {_size(depth)}: at least {MIN_SIDE_PX}x{MIN_SIDE_PX} was expected")
        empty = (~(depth > 0).flatten(1).any(dim=1)).nonzero().flatten().tolist()
        if empty:
            raise ValueError(f"depth_m holds no return{'' if layout.single else f' in frame {empty[0]}'}")
        sample = Measurement(rgb=colour.to(self.device), depth_m=depth.to(self.device))
        if K is not None:
            sample["intrinsics"] = _camera(K, len(depth))
        with torch.inference_mode():
            output = self.network(sample["rgb"], sample["depth_m"])
        return Result(sample, output._replace(matches=[]), layout)


def _tensor(array: Any, name: str) -> Tensor:
    if isinstance(array, np.ndarray):
        if array.dtype.kind not in "uif":
            raise ValueError(f"{name} holds {array.dtype}: numbers were expected")
        return torch.from_numpy(np.ascontiguousarray(array))
    if isinstance(array, Tensor):
        return array.detach()
    raise ValueError(f"{name} is a {type(array).__name__}: a NumPy array or a torch tensor was expected")


def _colour(rgb: np.ndarray | Tensor) -> Tensor:
    """(B, 3, H, W) float32 in [0, 1]."""
    tensor = _tensor(rgb, "rgb")
    layout, axis = ("(H, W, 3)", -1) if isinstance(rgb, np.ndarray) else ("(3, H, W)", -3)
    if tensor.ndim not in (3, 4) or tensor.shape[axis] != 3:
        raise ValueError(f"rgb has the shape {tuple(tensor.shape)}: {layout} was expected, or a batch of it")
    tensor = tensor.movedim(axis, -3)
    tensor = tensor.reshape(-1, *tensor.shape[-3:])
    if tensor.dtype == torch.uint8:
        return tensor.float() / 255
    tensor = tensor.float()
    if not ((tensor >= 0) & (tensor <= 1)).all():  # NaN is not either
        raise ValueError("rgb must be uint8, or float in [0, 1]")
    return tensor


def _depth(depth_m: np.ndarray | Tensor) -> Tensor:
    """(B, 1, H, W) float32, 0 where there is none."""
    tensor = _tensor(depth_m, "depth_m")
    if not tensor.is_floating_point():
        raise ValueError(f"depth_m holds {tensor.dtype}: floating-point metres were expected (divide by their scale)")
    channel = isinstance(depth_m, Tensor) and tensor.ndim >= 3 and tensor.shape[-3] == 1
    if tensor.ndim not in ((2, 3, 4) if channel else (2, 3)):
        raise ValueError(f"depth_m has the shape {tuple(tensor.shape)}: (H, W) or (B, H, W) was expected")
    tensor = tensor.float().reshape(-1, 1, *tensor.shape[-2:])
    tensor = torch.where(tensor.isnan(), 0, tensor)
    if not ((tensor >= 0) & tensor.isfinite()).all():
        raise ValueError(
            "depth_m holds negative or infinite depths: positive ones, and 0 or NaN for none, were expected"
        )
    return tensor


def _camera(matrix: np.ndarray | Tensor, batch: int) -> Tensor:
    """(B, 3, 3) float32 on the CPU."""
    tensor = torch.as_tensor(matrix, dtype=torch.float32).cpu()
    if tensor.shape not in ((3, 3), (batch, 3, 3)):
        raise ValueError(f"K has the shape {tuple(tensor.shape)}: (3, 3) was expected, or one for each frame")
    if not (tensor[..., 0, 0] > 0).all() or not (tensor[..., 1, 1] > 0).all():
        raise ValueError("K must have positive focal lengths")
    return tensor.expand(batch, 3, 3)


def _size(image: Tensor) -> str:
    count = f"{len(image)} of " if len(image) > 1 else ""
    return f"{count}{image.shape[-1]}x{image.shape[-2]}"
