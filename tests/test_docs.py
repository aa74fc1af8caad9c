"""The documentation: it builds without warnings, its examples run, its internal links lead.

`python -m sphinx -b linkcheck docs docs/_build/linkcheck` checks the links to other sites, too.
"""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote, urlsplit

import pytest

import meshskin as ms
from meshskin import cli, effects
from meshskin.scene import shipped_scenes

ROOT = Path(__file__).parents[1]

pytestmark = pytest.mark.docs


def sphinx(builder: str, out: Path) -> subprocess.CompletedProcess:
    """Run a builder of Sphinx, warnings as errors, notebooks two at a time; builders with one
    `out` share what they read."""
    pytest.importorskip("sphinx", reason="pip install meshskin[docs]")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-j", "2", "-b", builder]
    return subprocess.run(
        [*command, "-d", out / "doctrees", "docs", out / builder],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site."""
    out = tmp_path_factory.mktemp("site")
    done = sphinx("html", out)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return out / "html"


class Page(HTMLParser):
    """The targets on a page, and where its links and pictures lead."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets, self.links = {""}, set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        for key, value in attrs:
            if key == "id":
                self.targets.add(value)
            elif key in ("href", "src") and value:
                self.links.add(value)


def test_every_internal_link_leads_to_a_page_and_a_place_on_it(site):
    pages = {p: Page(p.read_text(encoding="utf-8")) for p in site.rglob("*.html")}
    pages = {p: page for p, page in pages.items() if "_downloads" not in p.parts}
    lost = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            known = pages[target].targets if target in pages else {unquote(parts.fragment)}
            if not target.is_file() or unquote(parts.fragment) not in known:
                lost.append(f"{path.relative_to(site)}: {link}")
    assert len(pages) > len(ms.__all__)
    assert not lost


def test_no_page_shows_a_folder_of_the_machine_that_built_it(site, tmp_path_factory):
    folders = str(tmp_path_factory.getbasetemp()), str(ROOT), "ipykernel_"
    pages = {p: p.read_text(encoding="utf-8") for p in site.rglob("*.html")}
    assert [p for p, text in pages.items() if any(f in text for f in folders)] == []


def test_the_reference_has_every_public_name_effect_and_command(site):
    from sphinx.util.inventory import InventoryFile

    found = InventoryFile.load((site / "objects.inv").open("rb"), "", lambda base, name: name)
    described = {name for kind, names in found.items() if kind.startswith("py:") for name in names}
    assert {f"meshskin.{name}" for name in ms.__all__} <= described
    pages = set(found["std:doc"])
    assert {f"reference/generated/effects/{name}" for name in effects.NAMES} <= pages
    assert {f"gallery/generated/{name}" for name in shipped_scenes.scenes()} <= pages
    commands = (site / "reference/generated/command_line.html").read_text(encoding="utf-8")
    for name in cli.COMMANDS:
        assert f"meshskin {name}<" in commands


def test_the_examples_of_the_documentation_run(site):
    done = sphinx("doctest", site.parent)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    assert int(re.search(r"(\d+) tests\n", done.stdout)[1]) > 0


def test_an_example_that_takes_too_long_is_named(tmp_path, monkeypatch):
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    import gallery

    monkeypatch.setattr(gallery, "TIMEOUT", 0.1)
    example = SimpleNamespace(name="slow", command="python -c 'import time; time.sleep(9)'")
    with pytest.raises(gallery.ExtensionError, match=r"sleep\(9\)': did not end within 0.1 s; "):
        gallery.run(example, tmp_path)
