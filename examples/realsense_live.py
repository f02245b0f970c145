"""A RealSense camera, live: completed depth and a coloured cloud in Rerun's viewer, until Ctrl-C.

python realsense_live.py                  # the camera that is plugged in
python realsense_live.py recording.bag    # or what its own viewer has recorded

Needs pip install pyrealsense2 rerun-sdk. Colour isn't aligned to depth by the SDK: that is what the network does.
"""

import sys

import numpy as np
import pyrealsense2 as rs
import rerun as rr

import depthreg

WIDTH, HEIGHT = 640, 480


def main() -> None:
    """Complete frame after frame; what the camera takes meanwhile is left out."""
    model, pipeline, config = depthreg.load(), rs.pipeline(), rs.config()
    if len(sys.argv) > 1:
        config.enable_device_from_file(sys.argv[1], repeat_playback=False)
    config.enable_stream(rs.stream.depth, WIDTH, HEIGHT, rs.format.z16)
    config.enable_stream(rs.stream.color, WIDTH, HEIGHT, rs.format.rgb8)
    rr.init("depthreg", spawn=True)
    rr.log("cloud", rr.ViewCoordinates.RDF, static=True)
    profile = pipeline.start(config)
    metres = profile.get_device().first_depth_sensor().get_depth_scale()
    lens = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
    k = np.array([[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1]], np.float32)
    try:
        while True:
            arrived, frames = pipeline.try_wait_for_frames(5000)
            if not arrived:  # the recording's end
                break
            rgb = np.asanyarray(frames.get_color_frame().get_data())
            depth_m = np.asanyarray(frames.get_depth_frame().get_data()).astype(np.float32) * metres
            result = model(rgb, depth_m, K=k)
            cloud = result.point_cloud(min_confidence=0.5)
            rr.set_time("camera", duration=frames.get_timestamp() / 1000)
            rr.log("colour/measured", rr.Image(rgb))
            rr.log("colour/aligned", rr.Image(result.rgb_aligned))
            rr.log("depth/measured", rr.DepthImage(depth_m, meter=1.0))
            rr.log("depth/completed", rr.DepthImage(result.depth_m, meter=1.0))
            rr.log("cloud", rr.Points3D(cloud.points_m, colors=cloud.rgb))
    except KeyboardInterrupt:
        pass
    finally:
        pipeline.stop()


if __name__ == "__main__":
    main()
