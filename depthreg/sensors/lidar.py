"""What a LiDAR reports: lost and mixed returns, offsets of each laser, noise, fewer lines.

Received power follows the LiDAR equation, reflectivity / range^2 * exp(-2 extinction * range). CARLA's model has the
last factor alone (its 0.004 / m is twice our extinction) and drops 45 % of all returns by chance, which no real scanner
does: KITTI's rings on open ground are complete.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch, LidarColumns
from depthreg.errors import InputError
from depthreg.rendering import SCANNERS, Rig

_MOST_LINES = 128
_NEAREST_M = 0.5


def rasterize(uv_px: Tensor, depth_m: Tensor, size: tuple[int, int]) -> Tensor:
    """Draw returns into a depth image; where several fall into a pixel, the nearest wins.

    Args:
        uv_px: Positions (column, row), (B, N, 2).
        depth_m: z-depth, (B, N); 0 for a return that was lost.
        size: Height and width.

    Returns:
        (B, 1, H, W) in metres, 0 where nothing fell.
    """
    height, width = size
    column, row = uv_px.round().long().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (depth_m > 0)
    pixel = torch.where(inside, row * width + column, 0)
    candidate = torch.where(inside, depth_m, torch.inf)
    image = torch.full((len(uv_px), height * width), torch.inf, device=uv_px.device)
    image = image.scatter_reduce(1, pixel, candidate, reduce="amin")
    return torch.where(image.isinf(), 0, image).unflatten(1, (1, height, width))


def keep_lines(ring: Tensor, total: Tensor, lines: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Choose evenly spread lasers, starting at a random one.

    Args:
        ring: Laser of each return, (B, N), 0 to total - 1.
        total: How many lasers there are, (B,).
        lines: How many of them to keep, (B,), in [1, total].

    Returns:
        bool (B, N), True for returns of the chosen lasers.
    """
    phase = torch.rand(len(ring), 1, generator=generator).to(ring.device)
    share = (lines / total)[:, None]
    # A laser is kept where the running count of kept lasers steps up: Bresenham's rule for evenly spread picks.
    return torch.floor((ring + 1) * share + phase) > torch.floor(ring * share + phase)


def reflectivity(albedo: Tensor, cos_incidence: Tensor, gloss: Tensor, roughness_rad: float) -> Tensor:
    """Light that a surface sends back to where it came from, relative to a white one seen head-on.

    Oren and Nayar 1994, their equation 30 with both directions equal, so that a rough surface still answers at grazing
    incidence, as roads do; less what polish mirrors away on the light's way in and out (Schlick 1994).
    """
    variance = roughness_rad**2
    dull, rough = 1 - 0.5 * variance / (variance + 0.33), 0.45 * variance / (variance + 0.09)
    mirrored = gloss * (0.08 + 0.92 * (1 - cos_incidence) ** 5)
    return albedo * (cos_incidence + rough / dull * (1 - cos_incidence**2)) * (1 - mirrored) ** 2


def received_power(reflectivity: Tensor, range_m: Tensor, extinction_per_m: float) -> Tensor:
    """Power of an echo by the LiDAR equation, relative to a white wall's at 1 m in clear air."""
    return reflectivity * torch.exp(-2 * extinction_per_m * range_m) / range_m.clamp(min=_NEAREST_M) ** 2


def merge_echoes(
    near_m: Tensor, far_m: Tensor, near_power: Tensor, far_power: Tensor, pulse_m: float
) -> tuple[Tensor, Tensor]:
    """Range and power that a scanner reports of a beam that an edge splits.

    Echoes closer than half a pulse's length overlap: the detector sees one, and reports its centre of gravity (Hebert
    and Krotkov 1992, "mixed pixels"). Of echoes farther apart the stronger one is reported, which is the default of
    HDL-64E, VLP-16 and OS1.
    """
    together = far_m - near_m < pulse_m
    power = near_power + far_power
    middle_m = (near_m * near_power + far_m * far_power) / power.clamp(min=1e-20)
    stronger_m = torch.where(near_power >= far_power, near_m, far_m)
    apart_power = torch.maximum(near_power, far_power)
    return torch.where(together & (power > 0), middle_m, stronger_m), torch.where(together, power, apart_power)


def move_along_rays(columns: LidarColumns, intrinsics: Tensor, by_m: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel positions (B, N, 2) and z-depths (B, N) of returns whose ranges change by `by_m` (B, N).

    Rays start at the LiDAR, not at the camera, so a return at another range also lies at another pixel.
    """
    focal = intrinsics[:, [0, 1], [0, 1]][:, None]  # (B, 1, 2)
    center = intrinsics[:, None, :2, 2]
    uv_px = torch.stack([columns.u_px, columns.v_px], dim=-1)
    shift = by_m[..., None] * torch.stack([columns.ray_x, columns.ray_y], dim=-1)
    depth_m = columns.depth_m + by_m * columns.ray_z
    across_m = (uv_px - center) / focal * columns.depth_m[..., None] + shift
    return across_m / depth_m.clamp(min=0.1)[..., None] * focal + center, depth_m


@dataclass(frozen=True)
class Lidar:
    """Depth that thins out from dense into a scanner's returns as the difficulty grows.

    At difficulty 0 it reports the dense truth. In between, dense pixels survive with probability (1 - difficulty)^4
    beside the scanner's returns; at 1 there are only returns, with everything that follows at its full size.

    Args:
        scanners: Names of the scanners, keys of `SCANNERS`; each frame is scanned by one of them.
        min_lines: Fewest of the lines in the image that are kept; drawn evenly in the logarithm, up to all of them.
        reach_10_m: How far 10 % of reflectivity are seen at grazing incidence: data sheets speak of pavement.
        reach_80_m: Likewise for 80 %.
        roughness_rad: Spread of the slopes of rough surfaces (Oren-Nayar's sigma).
        fading: Standard deviation of the logarithm of a return's power: speckle, dirt, the detector's noise.
        drop_share: Share of returns lost by chance.
        range_bias_m: Standard deviation between lasers of a constant error of each laser's range.
        range_noise_m: Standard deviation of each range.
        pulse_m: Echoes that are closer than this merge: half a pulse's length.
        outlier_share: Share of returns that are somewhere before the surface: dust, rain, other scanners' light.

    Raises:
        InputError: A scanner is unknown, or a number can't be meant.
    """

    scanners: Sequence[str] = ("hdl64",)
    min_lines: int = 32
    reach_10_m: float = 50.0
    reach_80_m: float = 120.0
    roughness_rad: float = 0.5
    fading: float = 0.3
    drop_share: float = 0.005
    range_bias_m: float = 0.02
    range_noise_m: float = 0.02
    pulse_m: float = 0.75
    outlier_share: float = 0.0005

    def __post_init__(self) -> None:
        unknown = sorted(set(self.scanners) - set(SCANNERS))
        if unknown or not self.scanners:
            raise InputError(f"sensor.scanners must name some of {sorted(SCANNERS)}, got {list(self.scanners)}")
        if not 1 <= self.min_lines <= _MOST_LINES:
            raise InputError(f"sensor.min_lines must lie between 1 and {_MOST_LINES}, got {self.min_lines}")
        # Without extinction 80 % is seen sqrt(8) times as far as 10 %; air can only shorten that.
        if not 0 < self.reach_10_m < self.reach_80_m <= 8**0.5 * self.reach_10_m:
            reaches = f"{self.reach_10_m} and {self.reach_80_m}"
            raise InputError(f"sensor.reach_80_m must be 1 to 2.83 times a positive sensor.reach_10_m, got {reaches}")
        if self.drop_share + self.outlier_share > 1:
            raise InputError("sensor.drop_share and sensor.outlier_share must not exceed 1 together")
        for field in fields(self)[4:]:
            if getattr(self, field.name) < 0:
                raise InputError(f"sensor.{field.name} must not be negative, got {getattr(self, field.name)}")

    @property
    def rig(self) -> Rig:
        """One scanner a frame."""
        return Rig(scans=tuple(SCANNERS[name] for name in self.scanners))

    @property
    def extinction_per_m(self) -> float:
        """What the air takes away, so that both reaches come true."""
        ratio = 8 * (self.reach_10_m / self.reach_80_m) ** 2
        return float(torch.tensor(ratio).log()) / (2 * (self.reach_80_m - self.reach_10_m))

    @property
    def least_power(self) -> float:
        """What the detector needs: the echo of grazed 10 % at `reach_10_m`."""
        albedo, none = torch.tensor(0.1), torch.tensor(0.0)
        grazed = reflectivity(albedo, none, none, self.roughness_rad)
        return float(received_power(grazed, torch.tensor(self.reach_10_m), self.extinction_per_m))

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """Sparse, noisy z-depth in metres, (B, 1, H, W); 0 where there is no return."""
        truth_m = frames["depth_m"]
        if difficulty == 0:
            return truth_m
        survivors = torch.rand(truth_m.shape, generator=generator).to(truth_m.device) < (1 - difficulty) ** 4
        columns = LidarColumns(*frames["lidar"].unbind(-1))
        range_m, found = self._detect(columns, difficulty, generator)
        found = found & self._kept(columns, difficulty, generator)
        range_m = self._disturb(columns, range_m, difficulty, generator)
        uv_px, depth_m = move_along_rays(columns, frames["intrinsics"], range_m - columns.range_m)
        scanned = rasterize(uv_px, torch.where(found, depth_m, 0), (truth_m.shape[-2], truth_m.shape[-1]))
        return torch.where(scanned > 0, scanned, truth_m * survivors)

    def _detect(
        self, columns: LidarColumns, difficulty: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Ranges without noise, and whether the echo was strong enough, (B, N) each."""
        near = reflectivity(columns.albedo, columns.cos_incidence, columns.gloss, self.roughness_rad)
        far = reflectivity(columns.far_albedo, columns.far_cos_incidence, columns.far_gloss, self.roughness_rad)
        # A beam that grows from a line: the part that its centre doesn't hit grows with the difficulty.
        share = columns.near_share
        share = torch.where(share < 0.5, share * difficulty, 1 - (1 - share) * difficulty)
        near_power = share * received_power(near, columns.range_m, self.extinction_per_m)
        far_power = (1 - share) * received_power(far, columns.far_range_m, self.extinction_per_m)
        range_m, power = merge_echoes(columns.range_m, columns.far_range_m, near_power, far_power, self.pulse_m)
        fade = torch.randn(power.shape, generator=generator).to(power.device) * self.fading
        return range_m, power * fade.exp() > self.least_power * difficulty**2

    def _kept(self, columns: LidarColumns, difficulty: float, generator: torch.Generator | None) -> Tensor:
        """Which returns (B, N) are neither dropped by chance nor of a laser that the scanner lacks."""
        ring = columns.ring
        total = ring.amax(dim=1) + 1 if ring.shape[1] else ring.new_ones(len(ring))
        luck = torch.rand(len(ring), generator=generator).to(ring.device)
        fewest = total.clamp(max=self.min_lines)
        lines = total * (fewest / total) ** (difficulty * luck)
        drawn = torch.rand(ring.shape, generator=generator).to(ring.device) >= difficulty * self.drop_share
        return drawn & keep_lines(ring, total, lines, generator) & (columns.range_m > 0)

    def _disturb(
        self, columns: LidarColumns, range_m: Tensor, difficulty: float, generator: torch.Generator | None
    ) -> Tensor:
        """Ranges (B, N) with the lasers' offsets, noise and outliers."""
        bias = torch.randn(len(range_m), _MOST_LINES, generator=generator).to(range_m.device)
        noise = torch.randn(range_m.shape, generator=generator).to(range_m.device)
        strays, where = torch.rand(2, *range_m.shape, generator=generator).to(range_m.device)
        error_m = self.range_bias_m * bias.gather(1, columns.ring.long()) + self.range_noise_m * noise
        stray_m = _NEAREST_M + where * (range_m - _NEAREST_M).clamp(min=0)
        return torch.where(strays < difficulty * self.outlier_share, stray_m, range_m + difficulty * error_m)
