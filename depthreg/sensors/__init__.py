"""What real instruments report: misalignment and depth sensors, as pure functions composed by the simulator."""

from depthreg.sensors.clean import Clean
from depthreg.sensors.holes import Holes
from depthreg.sensors.lidar import Lidar
from depthreg.sensors.simulator import SensorSimulator

__all__ = ["Clean", "Holes", "Lidar", "SensorSimulator"]
