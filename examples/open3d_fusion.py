"""A recording's completed depth fused into one coloured mesh with Open3D.

python open3d_fusion.py drive/image drive/velodyne_raw poses.txt K.txt --depth-scale 256 --out mesh.ply

Line N of poses.txt is the pose of the depth camera in frame N, counted from 0: 12 numbers of [R | t] to the world, row
by row, as KITTI's odometry has it. A frame's number is its file's name. Needs pip install open3d.
"""

import argparse
from pathlib import Path

import numpy as np
import open3d as o3d

import depthreg
from depthreg.data.io import read_depth_m, read_intrinsics, read_rgb

Fusion = o3d.t.geometry.VoxelBlockGrid
MIN_WEIGHT = 0.0  # of a voxel, in frames that saw it: a drive sees most places in few


def volume(voxel_m: float) -> Fusion:
    """An empty truncated signed distance field, which grows where something is seen."""
    kinds = (o3d.core.float32,) * 3
    return Fusion(("tsdf", "weight", "color"), kinds, ((1,), (1,), (3,)), voxel_m, block_count=20_000)


def fuse(
    field: Fusion, rgb: np.ndarray, depth_m: np.ndarray, k: np.ndarray, world_from_camera: np.ndarray, far_m: float
) -> None:
    """Add a frame; depth beyond `far_m` is left out."""
    depth = o3d.t.geometry.Image(np.ascontiguousarray(depth_m, np.float32))
    colour = o3d.t.geometry.Image(np.ascontiguousarray(rgb, np.float32) / 255)
    lens, camera_from_world = o3d.core.Tensor(k.astype(float)), o3d.core.Tensor(np.linalg.inv(world_from_camera))
    seen = field.compute_unique_block_coordinates(depth, lens, camera_from_world, 1.0, far_m)
    field.integrate(seen, depth, colour, lens, lens, camera_from_world, 1.0, far_m)


def main() -> None:
    """Complete and fuse every frame that has a pose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("image", "depth", "poses", "intrinsics"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--depth-scale", type=float, required=True, help="stored value per metre")
    parser.add_argument("--out", type=Path, required=True, help="new .ply file")
    parser.add_argument("--checkpoint", type=Path, help="weights; by default the released ones")
    parser.add_argument("--voxel", type=float, default=0.1, metavar="M", help="default: 0.1 m")
    parser.add_argument("--far", type=float, default=30.0, metavar="M", help="leave out what is farther; default: 30 m")
    parser.add_argument("--confidence", type=float, default=0.5, help="leave out what is believed less; default: 0.5")
    options = parser.parse_args()
    model, k = depthreg.load(options.checkpoint), read_intrinsics(options.intrinsics)
    poses = np.loadtxt(options.poses, ndmin=2).reshape(-1, 3, 4)
    field = volume(options.voxel)
    for path in sorted(options.image.iterdir()):
        depth_m = read_depth_m(options.depth / f"{path.stem}.png", options.depth_scale)
        result = model(read_rgb(path), depth_m, K=k)
        believed_m = np.where(result.confidence < options.confidence, 0, result.depth_m)  # NaN: can't tell, so all
        pose = np.vstack([poses[int(path.stem)], [0, 0, 0, 1]])
        fuse(field, result.rgb_aligned, believed_m, k, pose, options.far)
        print(f"{path.name}: {result}")
    mesh = field.extract_triangle_mesh(MIN_WEIGHT).to_legacy()
    o3d.io.write_triangle_mesh(str(options.out), mesh)
    print(f"{options.out}: {len(mesh.vertices)} vertices, {len(mesh.triangles)} triangles")


if __name__ == "__main__":
    main()
