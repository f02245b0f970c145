"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real sensor frames, whose licences forbid committing them."""
    default = Path(__file__).resolve().parents[2] / "shared" / "real"
    folder = Path(os.environ.get("DEPTHREG_REAL_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"real sensor frames are not at {folder}: set DEPTHREG_REAL_DATA to their folder")
    return folder
