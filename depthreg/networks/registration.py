"""Registration: from colour and depth to the affine that aligns them."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from depthreg.geometry import compose_affines, exact_product, identity_affine, pixel_grid, sample_at, transform_points
from depthreg.networks.blocks import conv_norm_gelu


class LocalMatches(NamedTuple):
    """What one matcher saw: how likely each displacement is around each place, before an affine was fitted to it."""

    points_px: Tensor  # (N, 2) places on the depth's grid
    offsets_px: Tensor  # (K, 2) candidate displacements
    scores: Tensor  # (B, N, K) logits
    affine_before: Tensor  # (B, 2, 3), what `affine_rgb_from_depth` was when the matcher looked


def edge_strength(image: Tensor, window: int = 17) -> Tensor:
    """Horizontal and vertical contrast relative to that around, in [0, 1): faint edges in dull places count too.

    Args:
        image: (B, C, H, W) in [0, 1].
        window: Side of the neighbourhood, odd, in pixels.

    Returns:
        (B, 2, H, W): the strongest channel's difference to the right and lower neighbour.
    """
    right = F.pad((image[..., 1:] - image[..., :-1]).abs(), [0, 1, 0, 0]).amax(dim=1)
    down = F.pad((image[..., 1:, :] - image[..., :-1, :]).abs(), [0, 0, 0, 1]).amax(dim=1)
    contrast = torch.stack([right, down], dim=1)
    around = contrast.sum(dim=1, keepdim=True)
    for kernel in ((1, window), (window, 1)):  # the mean over a square, one axis at a time
        around = F.avg_pool2d(around, kernel, 1, (kernel[0] // 2, kernel[1] // 2), count_include_pad=False)
    return contrast / (contrast + around + 1e-3)


def local_correlation(fixed: Tensor, moving: Tensor, radius: int) -> Tensor:
    """Cosine similarity of every cell with the other image's cells around the same place.

    As matrix products, 5 to 8 times as fast as a product for each displacement: of 2r cells in a row with the 4r that
    lie within reach of any of them.

    Args:
        fixed: Features (B, C, h, w).
        moving: Features (B, C, h, w).
        radius: Largest displacement r in cells, at least 1.

    Returns:
        (B, (2r + 1)^2, h, w); channel (dy + r) (2r + 1) + dx + r compares fixed[y, x] with moving[y + dy, x + dx].
    """
    height, width = fixed.shape[-2:]
    block, side = 2 * radius, 2 * radius + 1
    blocks = (width + block - 1) // block
    exact = torch.promote_types(fixed.dtype, torch.float32)
    with torch.autocast(fixed.device.type, enabled=False):
        fixed, moving = (F.normalize(x.to(exact), dim=1).permute(0, 2, 3, 1) for x in (fixed, moving))
        cells = F.pad(fixed, [0, 0, 0, blocks * block - width]).unflatten(2, (blocks, block))
        padding = [0, 0, radius, (blocks + 1) * block - width - radius, radius, radius]
        around = F.pad(moving, padding).unflatten(2, (blocks + 1, block))
        reach = torch.cat([around[:, :, :-1], around[:, :, 1:]], dim=3).transpose(3, 4)  # (B, h + 2r, blocks, C, 4r)
        rows = [_band(cells @ reach[:, dy : dy + height], side) for dy in range(side)]
    return torch.cat(rows, dim=-1)[:, :, :width].permute(0, 3, 1, 2)


def _band(products: Tensor, side: int) -> Tensor:
    """Entries [x, x] to [x, x + side - 1] of each matrix: (B, h, blocks, b, 2b) -> (B, h, blocks b, side)."""
    rows, columns = products.shape[-2:]
    skewed = F.pad(products.flatten(3), [0, rows]).unflatten(3, (rows, columns + 1))  # moves row x to the left by x
    return skewed[..., :side].flatten(2, 3)


def fit_affine(points_px: Tensor, displacements_px: Tensor, weights: Tensor, stiffness: float = 1e-2) -> Tensor:
    """The affine that best explains displacements, by weighted least squares in closed form, either axis by itself.

    Args:
        points_px: (N, 2).
        displacements_px: Where each point should move, (B, N, 2).
        weights: Of each point's displacement along x and along y, (B, N, 2), summing to 1 over the points: an upright
            edge tells the one and not the other.
        stiffness: Pull towards a pure translation, relative to the points' spread, so that points on a line still
            give a finite answer.

    Returns:
        A (B, 2, 3) with A @ (p, 1) close to p + displacement.
    """
    w = weights.transpose(1, 2)[..., None]  # (B, 2 axes, N, 1)
    values = displacements_px.transpose(1, 2)[..., None]
    centre = (w * points_px).sum(dim=2, keepdim=True)  # (B, 2, 1, 2)
    shift = (w * values).sum(dim=2, keepdim=True)  # (B, 2, 1, 1)
    arms = points_px - centre  # (B, 2, N, 2)
    cross = (w * (values - shift) * arms).sum(dim=2)  # (B, 2, 2)
    a, b, d = ((w[..., 0] * arms[..., i] * arms[..., j]).sum(dim=2) for i, j in ((0, 0), (0, 1), (1, 1)))
    ridge = stiffness * points_px.var(dim=0).mean()
    a, d = a + ridge, d + ridge
    along_x, along_y = cross.unbind(dim=-1)
    linear = torch.stack([d * along_x - b * along_y, a * along_y - b * along_x], dim=-1)
    linear = linear / (a * d - b * b)[..., None]  # (B, 2, 2), the deviation from the identity
    offset = shift[:, :, 0] - (linear * centre[:, :, 0]).sum(dim=-1, keepdim=True)
    deviation = torch.cat([linear, offset], dim=2)
    return identity_affine(len(deviation), device=deviation.device, dtype=deviation.dtype) + deviation


def weigh(scores: Tensor, offsets_px: Tensor, trust: Tensor, stride: int) -> tuple[Tensor, Tensor]:
    """Each region's displacement, and what it is worth along x and y: the inverse square of its variance.

    Most regions see edges of one direction, and can't tell how far to slide along them (the aperture problem): their
    mean says "not at all" then, and would hold the others back.

    Args:
        scores: Logits of the displacements, (B, N, K).
        offsets_px: The displacements, (K, 2).
        trust: Logits of the regions, (B, N).
        stride: Pixels of a cell, within which a displacement isn't known.

    Returns:
        Mean displacement and weights that sum to 1 over the regions, (B, N, 2) each.
    """
    chance = scores.softmax(dim=-1)
    mean = exact_product(chance, offsets_px)
    variance = exact_product(chance, offsets_px.square()) - mean.square() + stride**2 / 12
    logits = trust[..., None] - 2 * variance.log()
    return mean, logits.softmax(dim=1)


class Tower(nn.Module):
    """Strided convolutions that turn full-resolution features into a pyramid at 1/2, 1/4, 1/8, ... resolution."""

    def __init__(self, in_channels: int, widths: Sequence[int]) -> None:
        super().__init__()
        inputs = [in_channels, *widths][:-1]
        self.levels = nn.ModuleList(
            nn.Sequential(conv_norm_gelu(i, o, stride=2), conv_norm_gelu(o, o))
            for i, o in zip(inputs, widths, strict=True)
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """(B, C, H, W) -> features at strides 2, 4, 8, ..."""
        pyramid = []
        for level in self.levels:
            x = level(x)
            pyramid.append(x)
        return pyramid


class Matcher(nn.Module):
    """Looks for the displacement of each region, then summarises all of them by one affine.

    A cell alone can't tell where it belongs: most lie on plain surfaces, or on an edge that may slide along itself. So
    the evidence of all cells of a window is averaged before the best displacement is taken.

    Args:
        channels: Channels of both feature maps.
        hidden: Width of the convolutions that read the correlation.
        stride: Pixels of a cell.
        radius: Largest displacement found, in cells.
        window: Side of a region in cells, odd.
        looks: How often it looks, each time with the colour where the look before has brought it.
    """

    def __init__(self, channels: int, hidden: int, stride: int, radius: int, window: int, looks: int = 1) -> None:
        super().__init__()
        self.stride, self.radius, self.window, self.looks = stride, radius, window, looks
        candidates = (2 * radius + 1) ** 2
        self.read = nn.Sequential(
            conv_norm_gelu(candidates + channels, hidden),
            conv_norm_gelu(hidden, hidden),
            nn.Conv2d(hidden, candidates + 1, 3, padding=1),
        )
        self.sharpness = nn.Parameter(torch.tensor(15.0))
        side = torch.arange(-radius, radius + 1, dtype=torch.float32) * stride
        dy, dx = torch.meshgrid(side, side, indexing="ij")
        self.offsets_px: Tensor
        self.register_buffer("offsets_px", torch.stack([dx, dy], dim=-1).reshape(-1, 2), persistent=False)

    def forward(self, rgb: Tensor, depth: Tensor, affine: Tensor) -> tuple[Tensor, LocalMatches]:
        """Improve `affine` (B, 2, 3), given features (B, C, h, w) of both images at this matcher's stride."""
        affine = affine.detach()  # each matcher answers for its own step
        size = depth.shape[-2:]
        cells = pixel_grid(*size, device=depth.device, dtype=affine.dtype)
        centres_px = cells * self.stride + (self.stride - 1) / 2  # of every cell, in full-resolution pixels
        seen_px = transform_points(affine, centres_px.reshape(1, -1, 2).expand(len(affine), -1, -1))
        seen_cells = (seen_px - (self.stride - 1) / 2) / self.stride
        moving, _ = sample_at(rgb, seen_cells.unflatten(1, size).to(rgb.dtype))

        correlation = local_correlation(depth, moving, self.radius)
        evidence = self.read(torch.cat([3 * correlation, depth], dim=1))
        evidence, trust = evidence.split([len(self.offsets_px), 1], dim=1)
        scores = self.sharpness * self._pool(correlation + evidence / 3).flatten(2).transpose(1, 2).to(affine.dtype)
        points_px = self._pool(centres_px.permute(2, 0, 1)[None])[0].flatten(1).T
        regions_trust = self._pool(trust).flatten(1).to(affine.dtype)
        update = fit_affine(points_px, *weigh(scores, self.offsets_px, regions_trust, self.stride))
        return compose_affines(affine, update), LocalMatches(points_px, self.offsets_px, scores, affine)

    def _pool(self, x: Tensor) -> Tensor:
        """Means over windows that overlap by half; at the border, over what lies inside the image."""
        return F.avg_pool2d(x, self.window, self.window // 2, self.window // 2, count_include_pad=False)


class RegistrationNet(nn.Module):
    """Spatial transformer whose localisation is coarse-to-fine matching of edge-like features.

    One tower describes colour and depth alike; from coarse to fine, every region of the depth looks for itself in the
    colour around it, and a least-squares fit turns those displacements into an affine. It is fully convolutional:
    nothing depends on the image's size, unlike a fully connected localisation head (Jaderberg et al., NeurIPS 2015).

    Args:
        in_channels: Channels of each of the two first feature maps.
        widths: Channels of the tower at strides 2, 4, 8, ... times `in_stride`.
        hidden: Width of the convolutions that read the correlation.
        matchers: Stride, radius in cells and window in cells of each matcher, and how often it looks if more than
            once, coarsest first; without any, the answer is the identity.
        in_stride: Pixels of a cell of the first feature maps.
    """

    def __init__(
        self,
        in_channels: int,
        widths: Sequence[int],
        hidden: int,
        matchers: Sequence[Sequence[int]],
        in_stride: int = 1,
    ) -> None:
        super().__init__()
        self.tower = Tower(in_channels, widths)
        strides = [in_stride * 2 ** (i + 1) for i in range(len(widths))]
        self.level_of_matcher = [strides.index(stride) for stride, *_ in matchers]
        built = [
            Matcher(widths[level], hidden, *matcher)
            for level, matcher in zip(self.level_of_matcher, matchers, strict=True)
        ]
        self.matchers, self.looks = nn.ModuleList(built), [matcher.looks for matcher in built]
        self.stride = strides[-1] if strides else in_stride

    def forward(self, rgb: Tensor, depth: Tensor) -> tuple[Tensor, list[LocalMatches]]:
        """Estimate the affine.

        Args:
            rgb: First features of the colour, (B, C, h, w); h and w times `in_stride` are multiples of `stride`.
            depth: First features of the depth, (B, C, h, w).

        Returns:
            `affine_rgb_from_depth` (B, 2, 3) in pixels, and what each matcher saw at each look.
        """
        rgb_pyramid, depth_pyramid = self.tower(rgb), self.tower(depth)
        affine = identity_affine(len(rgb), device=rgb.device, dtype=torch.promote_types(rgb.dtype, torch.float32))
        matches = []
        for level, matcher, looks in zip(self.level_of_matcher, self.matchers, self.looks, strict=True):
            for _ in range(looks):
                affine, seen = matcher(rgb_pyramid[level], depth_pyramid[level], affine)
                matches.append(seen)
        return affine, matches
