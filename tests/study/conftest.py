"""Run functions that worker processes can import, and folders that fill up."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def out(tmp_path):
    """The folder of a study."""
    return tmp_path / "out"
