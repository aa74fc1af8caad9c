"""The wheel and the source distribution: what they hold, and that the wheel works by itself."""

import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

import meshskin

ROOT = Path(__file__).parents[1]
DATA = {".c", ".h", ".csv", ".html", ".css", ".js", ".pyi", ".typed"}
"""Suffixes of the package's files that are no Python modules."""


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder with both distributions, the wheel built from the source distribution."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "build", "--outdir", folder, ROOT], check=True)
    return folder


def sources():
    """Files of the package, relative to the root of the project."""
    files = {p for p in (ROOT / "meshskin").rglob("*") if p.suffix in {".py", *DATA}}
    return {str(p.relative_to(ROOT)) for p in files}


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_the_shipped_scenes_and_nothing_else(built):
    with zipfile.ZipFile(next(built.glob("*.whl"))) as wheel:
        names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    bodies = {f"meshskin/bodies/{p.name}" for p in (ROOT / "bodies").iterdir()}
    assert names == sources() | bodies


@pytest.mark.slow
def test_the_source_distribution_holds_what_the_tests_need(built):
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    kept = {
        str(p.relative_to(ROOT)) for d in ("tests", "studies") for p in (ROOT / d).rglob("*.py")
    }
    assert sources() | kept | {"README.md", "LICENSE", "CHANGELOG.md", "pyproject.toml"} <= names
    assert f"meshskin-{meshskin.__version__}" in next(built.glob("*.tar.gz")).name


@pytest.mark.slow
def test_the_wheel_works_in_an_empty_environment_and_an_empty_folder(built, tmp_path):
    place, folder = tmp_path / "venv", tmp_path / "empty"
    venv.create(place, with_pip=True)
    folder.mkdir()
    binary = place / ("Scripts" if sys.platform == "win32" else "bin")

    def run(name: str, *arguments: str) -> None:
        subprocess.run([binary / name, *arguments], cwd=folder, env=environment, check=True)

    environment = {"PATH": f"{binary}:/usr/bin:/bin", "HOME": str(tmp_path)}
    run("pip", "install", "--quiet", str(next(built.glob("*.whl"))))
    run("meshskin", "run", "sphere", "--out", "out", "--quiet")
    assert (folder / "out" / "report.html").stat().st_size > 1e5
    (folder / "two.toml").write_text(
        'base = "sphere"\nseeds = 1\n[grid]\nmaterial.young_kpa = [200, 300]\n'
    )
    run("meshskin", "study", "two.toml", "--out", "study", "--quiet")
    assert (folder / "study" / "table.parquet").is_file()
