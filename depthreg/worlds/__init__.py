"""What exists: worlds draw a scene of meshes, materials and lights from two numbers."""

from depthreg.worlds.blocks import BlocksWorld
from depthreg.worlds.driving import DrivingWorld
from depthreg.worlds.household import HouseholdWorld
from depthreg.worlds.mixed import MixedWorld
from depthreg.worlds.own import OwnWorld

__all__ = ["BlocksWorld", "DrivingWorld", "HouseholdWorld", "MixedWorld", "OwnWorld"]
