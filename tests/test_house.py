"""The order of the wings, import circles, the public names, what an import loads, module sizes."""

import ast
import csv
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import meshskin

PACKAGE = Path(meshskin.__file__).parent
WINGS = [
    "core", "geometry", "skin", "contact", "effects", "robot", "scene", "exploration", "recording",
    "simulation", "estimation", "tuning", "study", "report", "pipeline", "cli",
]  # fmt: skip
"""The wings in order: a module imports only from its own wing and from those before it."""
EXEMPT = {
    ("estimation.calibration", "report.page"),
    ("estimation.calibration", "estimation.cross_validation"),
}
"""Imports against the order: methods of a calibration that draw its report and calibrate again."""
ONE_A_FILE = ("cli.", "effects.", "simulation.integrators.")
"""Wings of one kind a file, however short."""
FILES = {
    ".".join(file.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): file
    for file in sorted(PACKAGE.rglob("*.py"))
    if file != PACKAGE / "__init__.py"
}


def imports(module: str) -> set[str]:
    """Modules of the package that a module imports, also within functions, type checking apart."""
    file = FILES[module]
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            node.body = []
    package = ["meshskin", *module.split(".")]
    if file.name != "__init__.py":
        package.pop()
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{source}.{alias.name}" for alias in node.names} | {source}
    names = {name.removeprefix("meshskin.") for name in found if name.startswith("meshskin.")}
    modules = {name if name in FILES else name.rpartition(".")[0] for name in names}
    return {name for name in modules if name in FILES and name != module} - {
        name.rpartition(".")[0]
        for name in modules  # of a package, the module that is named
    }


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    """The imports of every module."""
    return {module: imports(module) for module in FILES}


def rank(module: str) -> int:
    """Place of a module's wing in the order."""
    return WINGS.index(module.split(".")[0])


def test_modules_import_only_from_wings_before_their_own(graph):
    pairs = {(m, n) for m, names in graph.items() if m != "__main__" for n in names}
    assert {(m, n) for m, n in pairs if rank(n) > rank(m)} - EXEMPT == set()


def test_there_are_no_import_circles(graph):
    graph = {m: {n for n in names if (m, n) not in EXEMPT} for m, names in graph.items()}
    while leaves := {module for module, names in graph.items() if not names}:
        graph = {m: names - leaves for m, names in graph.items() if m not in leaves}
    assert not graph


def test_the_root_holds_the_pipeline_alone():
    modules = {file.stem for file in PACKAGE.glob("*.py")}
    assert modules == {"__init__", "__main__", "pipeline"}


def test_modules_are_neither_too_long_nor_too_short():
    lines = {m: len(f.read_text(encoding="utf-8").splitlines()) for m, f in FILES.items()}
    assert {m: n for m, n in lines.items() if n > 350} == {}
    nouns = [m for m in FILES if FILES[m].name not in ("__init__.py", "__main__.py")]
    assert [m for m in nouns if lines[m] < 40 and not m.startswith(ONE_A_FILE)] == []


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


def test_the_text_of_each_mutant_occurs_once():
    """tests/mutation.py replaces it; see there."""
    table = tomllib.loads(Path(__file__).with_name("mutants.toml").read_text(encoding="utf-8"))
    for mutant in table["mutant"]:
        text = (PACKAGE.parent / mutant["file"]).read_text(encoding="utf-8")
        assert text.count(mutant["old"]) == 1, mutant


def test_each_mutant_has_a_recorded_outcome():
    """tests/mutation.py records it; see there."""
    table = tomllib.loads(Path(__file__).with_name("mutants.toml").read_text(encoding="utf-8"))
    with Path(__file__).with_name("mutation.csv").open(newline="", encoding="utf-8") as file:
        recorded = [(row["file"], row["old"], row["new"]) for row in csv.DictReader(file)]
    assert recorded == [(m["file"], m["old"], m["new"]) for m in table["mutant"]]
