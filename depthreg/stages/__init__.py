"""The stages of the curriculum, as LightningModules that share one network."""

from depthreg.stages.base import Stage
from depthreg.stages.completion import CompletionStage
from depthreg.stages.full import FullStage
from depthreg.stages.joint import JointStage

__all__ = ["CompletionStage", "FullStage", "JointStage", "Stage"]
