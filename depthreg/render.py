"""`depthreg render`: frames of a world as files, to look at or to use elsewhere."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track

from depthreg.config import require_counts, run_application
from depthreg.data import io
from depthreg.data.sample import Frame
from depthreg.errors import InputError
from depthreg.rendering import Camera, Embree, Renderer, ScanPattern
from depthreg.sensors.lidar import rasterize
from depthreg.viz import depth_limits_m, depth_with_bar, overlay_points, panel
from depthreg.worlds.scene import Scene

DEPTH_SCALE = 256  # stored value per metre, as KITTI has it
_OVERVIEW_WIDTH_PX = 480  # of one frame


def main(argv: Sequence[str]) -> int:
    """Run `depthreg render OVERRIDES`."""
    return run_application("render", run, argv, check)


def check(config: DictConfig) -> None:
    """Refuse what can't be meant, before any work.

    Raises:
        InputError: In one sentence.
    """
    require_counts(config, ["count", "camera.width", "camera.height"])
    require_counts(config, ["seed"], at_least=0)
    focal_px = config.camera.focal_px
    if not isinstance(focal_px, int | float) or not focal_px > 0:
        raise InputError(f"camera.focal_px={focal_px}: expected a positive number of pixels")
    io.check_new_folder(Path(config.out))


def run(config: DictConfig) -> None:
    """Render the frames and say where they are."""
    world, camera, scan, renderer = (instantiate(config[key]) for key in ("world", "camera", "scan", "rendering"))
    out = Path(HydraConfig.get().runtime.output_dir)
    folders = render_gallery(world, camera, scan, config.seed, config.count, out, renderer)
    Console().print(f"{len(folders)} frames in {out}\nall of them {out / 'overview.png'}", soft_wrap=True)


def render_gallery(
    world: Callable[[int, int], Scene],
    camera: Camera,
    scan: ScanPattern | None,
    seed: int,
    count: int,
    out_dir: Path,
    renderer: Renderer | None = None,
) -> list[Path]:
    """Render the frames 0 to count - 1 of a world into files.

    Args:
        world: Builds the scene of (seed, index).
        camera: What to look with; a margin is rendered but not written.
        scan: The LiDAR's beams; none leaves `lidar.png` empty.
        seed: First number of every scene.
        count: How many frames.
        out_dir: A new or an empty folder; it appears whole or not at all.
        renderer: Renders the frames; Embree where not given.

    Returns:
        One folder for each frame, with what `write_frame` writes; `out_dir` also gets `overview.png`.

    Raises:
        InputError: `count` isn't positive, or `out_dir` holds something already.
    """
    if count <= 0:
        raise InputError(f"count={count} asks for no frame: a positive number was expected")
    names = [f"{index:06d}" for index in range(count)]
    with io.atomic_folder(out_dir) as folder:
        overview, renderer = [], renderer or Embree()
        for index, name in track(list(enumerate(names)), "Rendering", console=Console(stderr=True), transient=True):
            frame = renderer(world(seed, index), camera, scan)
            write_frame(folder / name, frame)
            height = round(_OVERVIEW_WIDTH_PX * camera.height / camera.width)
            small = cv2.resize(inner_rgb(frame), (_OVERVIEW_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
            overview.append((f"seed {seed}, index {index}", small))
        io.write_png(folder / "overview.png", panel(overview, columns=min(count, 4)))
    return [out_dir / name for name in names]


def write_frame(folder: Path, frame: Frame) -> None:
    """Write one frame into a new folder.

    The files are `rgb.png` and `rgb_right.png`; `depth.png` and `lidar.png`, 16 bits, metres times 256,
    0 = none; `intrinsics.txt` with the 9 numbers of K; and `panel.png`, everything side by side.
    """
    folder.mkdir()
    io.write_png(folder / "rgb.png", inner_rgb(frame))
    io.write_png(folder / "rgb_right.png", frame.rgb_right)
    io.write_depth_png(folder / "depth.png", frame.depth_m, DEPTH_SCALE)
    io.write_depth_png(folder / "lidar.png", lidar_image(frame), DEPTH_SCALE)
    with io.atomic_write(folder / "intrinsics.txt") as path:
        np.savetxt(path, frame.intrinsics, fmt="%.6g")
    io.write_png(folder / "panel.png", frame_panel(frame))


def inner_rgb(frame: Frame) -> np.ndarray:
    """The colour image without its margin, on the depth's grid, (H, W, 3) uint8."""
    margin = frame.margin_px
    height, width = frame.depth_m.shape
    return frame.rgb[margin : margin + height, margin : margin + width]


def lidar_image(frame: Frame) -> np.ndarray:
    """The LiDAR's returns as sparse depth, (H, W) metres, 0 = none; the nearest return of a pixel wins."""
    uv_px, depth_m = torch.from_numpy(frame.lidar.uv_px), torch.from_numpy(frame.lidar.depth_m)
    return rasterize(uv_px[None], depth_m[None], frame.depth_m.shape)[0, 0].numpy()


def frame_panel(frame: Frame) -> np.ndarray:
    """Everything that a frame holds, in one picture."""
    limits = depth_limits_m(frame.depth_m)
    height, width = frame.depth_m.shape
    tiles = [
        ("colour, LiDAR returns", overlay_points(inner_rgb(frame), lidar_image(frame))),
        ("right camera", frame.rgb_right),
        ("depth", depth_with_bar(frame.depth_m, *limits)),
        ("normals", _picture_of_normals(frame)),
        ("objects", _picture_of_objects(frame)),
    ]
    return panel(tiles, columns=1 if width > 2 * height else 2)


def _picture_of_normals(frame: Frame) -> np.ndarray:
    """Red = right, green = up, blue = towards the camera; grey sky."""
    return np.rint(127.5 + 127.5 * frame.normal * [1, -1, -1]).astype(np.uint8)


def _picture_of_objects(frame: Frame) -> np.ndarray:
    """A colour for each object, black sky."""
    colors = np.random.default_rng(0).integers(60, 256, (frame.object_id.max() + 2, 3), dtype=np.uint8)
    colors[-1] = 0  # object -1
    return colors[frame.object_id]
