"""Networks in plain PyTorch: no Lightning, no configuration objects."""

from depthreg.networks.completion import TinyUNet
from depthreg.networks.half_resolution import HalfResolutionNetwork
from depthreg.networks.joint import JointNetwork
from depthreg.networks.output import JointOutput
from depthreg.networks.registration import LocalMatches

Network = JointNetwork | HalfResolutionNetwork

__all__ = ["HalfResolutionNetwork", "JointNetwork", "JointOutput", "LocalMatches", "Network", "TinyUNet"]
