"""The order of the wings, the public names, what an import brings along, and the room sizes."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import meshskin

PACKAGE = Path(meshskin.__file__).parent
WINGS = [
    "errors",
    "se3",
    "atomic",
    "clock",
    "config",
    "arguments",
    "provenance",
    "compiled",
    "library",
    "once",
    "ragged",
    "geometry",
    "physics",
    "motion",
    "belief",
    "scene_parts",
    "scene",
    "scene_tables",
    "scene_file",
    "logs",
    "recording",
    "sensing",
    "exploration",
    "simulation",
    "tuning",
    "presses",
    "touching",
    "estimation",
    "adaptive",
    "study",
    "report",
    "job",
    "cli",
]
FILES = [f for f in sorted(PACKAGE.rglob("*.py")) if f != PACKAGE / "__init__.py"]


def imports(file: Path) -> list[str]:
    """Wings that a module imports when it is loaded or run, type checking apart."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    depth = len(file.relative_to(PACKAGE).parts)
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            if node.level == depth:
                names = [node.module] if node.module else [a.name for a in node.names]
            elif node.level == 0 and (node.module or "").startswith("meshskin"):
                rest = (node.module or "").partition(".")[2]
                names = [rest] if rest else [a.name for a in node.names]
            else:
                continue
            found += [name.split(".")[0] for name in names]
    return found


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(PACKAGE)))
def test_a_module_imports_only_from_wings_before_its_own(file):
    own = file.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if own == "__main__":
        return
    later = (
        {name for name in imports(file) if WINGS.index(name) > WINGS.index(own)}
        - ({"scene_file"} if own == "scene" else set())
        - ({"report"} if own == "estimation" else set())
    )
    assert not later, f"{own} imports {later}, which come after it"


def test_public_names_are_sorted_and_importable():
    assert meshskin.__all__ == sorted(meshskin.__all__)
    for name in meshskin.__all__:
        assert getattr(meshskin, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Bdy'"):
        _ = meshskin.Bdy


def test_import_is_light():
    code = "import meshskin, sys; print(*{m.split('.')[0] for m in sys.modules})"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"casadi", "trimesh", "scipy", "matplotlib", "pyarrow", "adam", "plotly", "embreex"}
    assert not heavy & set(out.stdout.split())


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(PACKAGE)))
def test_a_room_is_no_hall(file):
    assert len(file.read_text(encoding="utf-8").splitlines()) <= 350
