"""What real instruments report: misalignment and depth sensors, as pure functions composed by the simulator."""

from depthreg.sensors.clean import Clean
from depthreg.sensors.color import ColorCamera
from depthreg.sensors.holes import Holes
from depthreg.sensors.lidar import Lidar
from depthreg.sensors.matching import CameraPair, SemiGlobal, StereoMatcher
from depthreg.sensors.projector import Projector
from depthreg.sensors.simulator import SensorSimulator
from depthreg.sensors.stereo import Stereo
from depthreg.sensors.weather import Weather

__all__ = [
    "CameraPair",
    "Clean",
    "ColorCamera",
    "Holes",
    "Lidar",
    "Projector",
    "SemiGlobal",
    "SensorSimulator",
    "Stereo",
    "StereoMatcher",
    "Weather",
]
