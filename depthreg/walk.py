"""The order in which a run walks through its stages."""

from collections import Counter
from typing import NamedTuple

from omegaconf import DictConfig, OmegaConf

from depthreg.errors import InputError


class Entry(NamedTuple):
    """One step of the curriculum."""

    label: str  # its folder, its seed and its name in the log: `joint`, and `joint_2` when it comes again
    stage: str  # key in `stages`


def walk(config: DictConfig) -> list[Entry]:
    """The curriculum's steps in their order.

    Raises:
        InputError: There is none, or one isn't among `stages`.
    """
    names = list(config.curriculum) if OmegaConf.is_list(config.curriculum) else [config.curriculum]
    unknown = [name for name in names if name not in config.stages]
    if unknown or not names:
        raise InputError(f"curriculum={list(names)}: expected some of {', '.join(config.stages)}, as [joint,full]")
    seen = Counter[str]()
    entries = []
    for name in names:
        seen[name] += 1
        entries.append(Entry(name if seen[name] == 1 else f"{name}_{seen[name]}", name))
    return entries
