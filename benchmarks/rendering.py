"""How many frames a second some processes render, and how many Cycles does with as many cores; and what costs how much.

python benchmarks/rendering.py --json rendering.json

A frame is a street drawn and built, its colour, depth, normals, ids, albedo and gloss, the scan of 64 beams and the
right view. Cycles (16 samples, denoised) renders both colours of the same frames in the same size, and takes the rest
from the ray-caster. It needs an environment with Blender's bpy; without one there is no ratio.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import trimesh
from rich.console import Console
from rich.table import Table
from trimesh.ray.ray_pyembree import RayMeshIntersector

from depthreg.errors import InputError
from depthreg.rendering import Camera, Embree, Renderer, hdl64, render_frame
from depthreg.rendering.cycles import Cycles
from depthreg.rendering.scan import scan_scene
from depthreg.rendering.surfaces import merge
from depthreg.worlds import DrivingWorld
from depthreg.worlds.driving import STYLES

# KITTI's camera on whole streets, and a small picture of shorter ones, as quick training draws them.
SETTINGS = {
    "1242x375": (Camera(1242, 375, 721.5, margin_px=32), DrivingWorld()),
    "384x128": (Camera(384, 128, 223.0, margin_px=12), DrivingWorld(ahead_m=120.0, coarse_leaves=True)),
}


def cpu_ms(action: Callable[[], object], repeats: int) -> float:
    """The least CPU time of some runs, in milliseconds: other processes disturb it least."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return 1000 * min(times)


def street(number: int) -> DrivingWorld:
    """Whose streets frame `number` shows: each style in turn."""
    return DrivingWorld(styles=(list(STYLES)[number % len(STYLES)],))


def make_frame(number: int, renderer: Renderer | None = None) -> None:
    """Draw and render KITTI-sized frame `number`."""
    cv2.setNumThreads(1)
    (renderer or Embree())(street(number)(0, number), SETTINGS["1242x375"][0], hdl64())


def frames_per_s(workers: int, count: int) -> float:
    """Frames that some processes make in a second of the clock."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        list(pool.map(make_frame, range(8 * workers)))  # imports, textures
        start = time.perf_counter()
        list(pool.map(make_frame, range(count)))
        return count / (time.perf_counter() - start)


def cycles_frames_per_s(workers: int, count: int) -> float | None:
    """The same for Blender's path tracer with as many threads, a frame at a time; None where it isn't there."""
    try:
        renderer = Cycles(samples=16, denoise=True, threads=workers)
        make_frame(0, renderer)  # Blender starts
    except InputError as error:
        print(f"No comparison with Cycles: {error}")
        return None
    start = time.perf_counter()
    for number in range(count):
        make_frame(number, renderer)
    return count / (time.perf_counter() - start)


def measure_frame(world: DrivingWorld, camera: Camera, repeats: int) -> dict[str, float]:
    """Milliseconds of each part of a frame of one street."""
    scan, scene = hdl64(), world(0, 1)
    pose = np.linalg.inv(scene.camera_from_world)
    surfaces = merge(scene, pose[:3, 3])
    left = cpu_ms(lambda: render_frame(scene, camera, None, right=False), repeats)
    both = cpu_ms(lambda: render_frame(scene, camera, None), repeats)
    whole = cpu_ms(lambda: render_frame(scene, camera, scan), repeats)
    build, tree = cpu_ms(lambda: world(0, 1), repeats), cpu_ms(lambda: merge(scene, pose[:3, 3]), repeats)
    return {
        "faces": sum(len(o.mesh.faces) for o in scene.objects),
        "scene": build,
        "ray tree": tree,
        "left view": left - tree,
        "right view": both - left,
        "LiDAR": cpu_ms(lambda: scan_scene(scene, surfaces, camera, scan, pose), repeats),
        "render": whole,
        "all": build + whole,
        "frames/s": 1000 / (build + whole),
    }


def measure_rival(world: DrivingWorld, camera: Camera, repeats: int) -> dict[str, float]:
    """Milliseconds for the first hits (point, face) of all camera rays: ours and trimesh's interface to Embree."""
    scene = world(0, 1)
    pose = np.linalg.inv(scene.camera_from_world)
    rays = camera.rays(camera.margin_px).reshape(-1, 3) @ pose[:3, :3].T.astype(np.float32)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    surfaces = merge(scene, pose[:3, 3])
    origins = np.broadcast_to(pose[:3, 3], rays.shape)
    rival = RayMeshIntersector(trimesh.util.concatenate([o.mesh for o in scene.objects]))
    rival.intersects_location(origins[:1], rays[:1], multiple_hits=False)  # builds its tree
    ours = cpu_ms(lambda: surfaces.cast(np.zeros(3), rays), repeats)
    theirs = cpu_ms(lambda: rival.intersects_location(origins, rays, multiple_hits=False), repeats)
    return {"rays": len(rays), "depthreg": ours, "trimesh": theirs, "ratio": theirs / ours}


def print_table(title: str, rows: dict[str, dict[str, float]]) -> None:
    """Print one row a key."""
    table = Table("", *next(iter(rows.values())), title=title)
    for name, row in rows.items():
        table.add_row(name, *(f"{value:.1f}" if value < 1000 else f"{value:.0f}" for value in row.values()))
    Console(width=110).print(table)


def main() -> None:
    """Measure, print, and write what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="file for the numbers")
    parser.add_argument("--repeats", type=int, default=5, help="runs of each part; the quickest counts")
    parser.add_argument("--workers", type=int, default=2, help="processes that render; Cycles gets as many threads")
    parser.add_argument("--frames", type=int, default=64, help="how many they render")
    parser.add_argument("--cycles-frames", type=int, default=4, help="how many Cycles renders; 0 leaves it out")
    arguments = parser.parse_args()
    speed = frames_per_s(arguments.workers, arguments.frames)
    rival = cycles_frames_per_s(arguments.workers, arguments.cycles_frames) if arguments.cycles_frames else None
    results: dict[str, object] = {
        "frames_per_s": speed,
        "workers": arguments.workers,
        "cycles_frames_per_s": rival,
        "ratio_to_cycles": speed / rival if rival else None,
    }
    print(f"{arguments.workers} processes make {speed:.2f} frames of 1242x375 a second.")
    if rival:
        print(f"Cycles with {arguments.workers} threads makes {rival:.4f}, 1/{speed / rival:.0f} of that.")
    cv2.setNumThreads(1)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    for size, (camera, world) in SETTINGS.items():
        worlds = {style: replace(world, styles=(style,)) for style in STYLES}
        frames = {style: measure_frame(worlds[style], camera, arguments.repeats) for style in STYLES}
        frames["mean"] = {key: float(np.mean([row[key] for row in frames.values()])) for key in frames["city"]}
        rivals = {style: measure_rival(worlds[style], camera, arguments.repeats) for style in STYLES}
        print_table(f"One {size} frame with a margin of {camera.margin_px} px, CPU ms on one core", frames)
        print_table(f"First hits of all its camera rays, CPU ms on one core, {size}", rivals)
        results[size] = {"frames": frames, "first_hits": rivals}
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
