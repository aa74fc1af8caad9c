"""Studies are scripts: tests load them as modules."""

import importlib.util
import sys
from pathlib import Path

import pytest

STUDIES = Path(__file__).parents[2] / "studies"
sys.path += [str(STUDIES), str(STUDIES / "speed")]  # where a script finds the modules beside it


@pytest.fixture(scope="session")
def script():
    """A study's script, by its file's stem, as a module."""

    def load(name):
        spec = importlib.util.spec_from_file_location(f"{name}_study", STUDIES / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
        return module

    return load
