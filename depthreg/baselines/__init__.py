"""What a user would do without depthreg."""

from depthreg.baselines.completion import COMPLETION_BASELINES, ip_basic, linear, nearest
from depthreg.baselines.registration import ecc, identity, mattes_mi, registration_baselines

__all__ = [
    "COMPLETION_BASELINES",
    "ecc",
    "identity",
    "ip_basic",
    "linear",
    "mattes_mi",
    "nearest",
    "registration_baselines",
]
