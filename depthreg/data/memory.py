"""Files that were fetched from elsewhere, with as much of a `Path` as reading a frame needs."""

import errno
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class MemoryFile:
    """One file."""

    name: str  # for messages
    content: bytes | None  # None where there is none

    def __str__(self) -> str:
        return self.name

    @property
    def suffix(self) -> str:
        """With its dot."""
        return Path(self.name).suffix

    def exists(self) -> bool:
        """Whether it is there."""
        return self.content is not None

    def read_bytes(self) -> bytes:
        """Its content."""
        if self.content is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), self.name)
        return self.content

    def read_text(self, encoding: str) -> str:
        """Its content as text."""
        return self.read_bytes().decode(encoding)


@dataclass(frozen=True)
class MemoryFolder:
    """Files of one folder, by their names in it."""

    name: str
    files: Mapping[str, bytes]

    def __truediv__(self, name: str) -> MemoryFile:
        return MemoryFile(f"{self.name}/{name}", self.files.get(name))
