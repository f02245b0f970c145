"""Networks in plain PyTorch: no Lightning, no configuration objects."""

from depthreg.networks.completion import TinyUNet
from depthreg.networks.joint import JointNetwork, JointOutput
from depthreg.networks.registration import LocalMatches

__all__ = ["JointNetwork", "JointOutput", "LocalMatches", "TinyUNet"]
