"""The documentation: it builds without warnings, its examples run, its internal links lead."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

pytestmark = pytest.mark.docs


def sphinx(builder: str, out: Path) -> subprocess.CompletedProcess:
    """Run a builder of Sphinx, warnings as errors."""
    pytest.importorskip("sphinx", reason="pip install meshskin[docs]")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-b", builder]
    return subprocess.run(
        [*command, "docs", out / builder],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize("builder", ["html", "doctest"])
def test_the_documentation_builds_and_its_examples_run(builder, tmp_path):
    done = sphinx(builder, tmp_path)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
