"""A recording's completed depth fused into one coloured mesh with Open3D, beside the mesh of what was measured alone.

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

Fusion = o3d.pipelines.integration.ScalableTSDFVolume


def volume(voxel_m: float) -> Fusion:
    """An empty truncated signed distance field."""
    kind = o3d.pipelines.integration.TSDFVolumeColorType.RGB8
    return Fusion(voxel_length=voxel_m, sdf_trunc=4 * voxel_m, color_type=kind)


def fuse(
    field: Fusion, rgb: np.ndarray, depth_m: np.ndarray, k: np.ndarray, world_from_camera: np.ndarray, far_m: float
) -> None:
    """Add a frame; depth beyond `far_m` is left out."""
    image = o3d.geometry.RGBDImage.create_from_color_and_depth(
        o3d.geometry.Image(np.ascontiguousarray(rgb)),
        o3d.geometry.Image(np.ascontiguousarray(depth_m)),
        depth_scale=1.0,
        depth_trunc=far_m,
        convert_rgb_to_intensity=False,
    )
    height, width = depth_m.shape
    lens = o3d.camera.PinholeCameraIntrinsic(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    field.integrate(image, lens, np.linalg.inv(world_from_camera))


def main() -> None:
    """Complete and fuse every frame that has a pose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("image", "depth", "poses", "intrinsics"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--depth-scale", type=float, required=True, help="stored value per metre")
    parser.add_argument(
        "--out", type=Path, required=True, help=".ply of the completed depth; .measured.ply goes beside it"
    )
    parser.add_argument("--checkpoint", type=Path, help="weights; by default the released ones")
    parser.add_argument("--voxel", type=float, default=0.1, metavar="M", help="default: 0.1 m")
    parser.add_argument("--far", type=float, default=30.0, metavar="M", help="leave out what is farther; default: 30 m")
    parser.add_argument("--confidence", type=float, default=0.5, help="leave out what is believed less; default: 0.5")
    options = parser.parse_args()
    model, k = depthreg.load(options.checkpoint), read_intrinsics(options.intrinsics)
    poses = np.loadtxt(options.poses, ndmin=2).reshape(-1, 3, 4)
    completed, measured = volume(options.voxel), volume(options.voxel)
    for path in sorted(options.image.iterdir()):
        depth_m = read_depth_m(options.depth / f"{path.stem}.png", options.depth_scale)
        result = model(read_rgb(path), depth_m, K=k)
        believed_m = np.where(result.confidence < options.confidence, 0, result.depth_m)  # NaN: can't tell, so all
        pose = np.vstack([poses[int(path.stem)], [0, 0, 0, 1]])
        fuse(completed, result.rgb_aligned, believed_m, k, pose, options.far)
        fuse(measured, result.rgb_aligned, depth_m, k, pose, options.far)
        print(f"{path.name}: {result}")
    for field, out in ((completed, options.out), (measured, options.out.with_suffix(".measured.ply"))):
        mesh = field.extract_triangle_mesh()
        o3d.io.write_triangle_mesh(str(out), mesh)
        print(f"{out}: {len(mesh.vertices)} vertices, {len(mesh.triangles)} triangles")


if __name__ == "__main__":
    main()
