"""What real instruments report: misalignment and depth sensors, as pure functions composed by the simulator."""

from depthreg.sensors.clean import Clean
from depthreg.sensors.color import ColorCamera
from depthreg.sensors.holes import Holes
from depthreg.sensors.lidar import Lidar
from depthreg.sensors.matching import CameraPair, SemiGlobal, StereoMatcher
from depthreg.sensors.mix import Chain, Mix
from depthreg.sensors.points import FeaturePoints, RandomPoints
from depthreg.sensors.projector import Projector
from depthreg.sensors.simulator import SensorSimulator
from depthreg.sensors.stereo import Stereo
from depthreg.sensors.structured_light import StructuredLight
from depthreg.sensors.tof import Tof
from depthreg.sensors.weather import Weather

__all__ = [
    "CameraPair",
    "Chain",
    "Clean",
    "ColorCamera",
    "FeaturePoints",
    "Holes",
    "Lidar",
    "Mix",
    "Projector",
    "RandomPoints",
    "SemiGlobal",
    "SensorSimulator",
    "Stereo",
    "StereoMatcher",
    "StructuredLight",
    "Tof",
    "Weather",
]
