"""ROS 2: colour and sparse depth of one size in, dense depth and a coloured cloud out.

python ros2_node.py --ros-args -r rgb:=/camera/color/image_raw -r depth:=/camera/depth/image_rect_raw \
    -r camera_info:=/camera/depth/camera_info

Needs a sourced ROS 2 (rclpy, message_filters, cv_bridge, sensor_msgs_py) and depthreg in the same Python.
"""

import message_filters
import numpy as np
import rclpy
from cv_bridge import CvBridge
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from sensor_msgs_py.point_cloud2 import create_cloud

import depthreg

FIELDS = [
    PointField(name=n, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, n in enumerate(["x", "y", "z", "rgb"])
]


class CompletionNode(Node):
    """Completes each pair of images that were taken within 50 ms of each other; late ones are dropped."""

    def __init__(self) -> None:
        super().__init__("depthreg")
        self.model, self.bridge = depthreg.load(), CvBridge()
        self.depth = self.create_publisher(Image, "depth_completed", 1)
        self.cloud = self.create_publisher(PointCloud2, "points", 1)
        topics = ((Image, "rgb"), (Image, "depth"), (CameraInfo, "camera_info"))
        self.inputs = [
            message_filters.Subscriber(self, *topic, qos_profile=qos_profile_sensor_data) for topic in topics
        ]
        self.pairs = message_filters.ApproximateTimeSynchronizer(self.inputs, queue_size=2, slop=0.05)
        self.pairs.registerCallback(self.complete)

    def complete(self, rgb: Image, depth: Image, camera: CameraInfo) -> None:
        """Publish what the network makes of one pair, on the depth image's grid and clock."""
        colour, stored = self.bridge.imgmsg_to_cv2(rgb, "rgb8"), self.bridge.imgmsg_to_cv2(depth, "passthrough")
        per_metre = 1000 if stored.dtype == np.uint16 else 1  # REP 118: millimetres or metres
        depth_m = stored.astype(np.float32) / per_metre
        result = self.model(colour, depth_m, K=np.array(camera.k, np.float32).reshape(3, 3))
        self.depth.publish(self.bridge.cv2_to_imgmsg(result.depth_m, "32FC1", header=depth.header))
        points_m, colours = result.point_cloud(min_confidence=0.5)
        packed = colours.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)  # as RViz has it: 0x00RRGGBB
        points = np.column_stack([points_m, packed.view(np.float32)])
        self.cloud.publish(create_cloud(depth.header, FIELDS, points))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(CompletionNode())
