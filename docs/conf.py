"""Configuration of the documentation: `python -m sphinx -W docs docs/_build/html`."""

import hashlib
import os
import shutil
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS.parent), str(DOCS / "_ext")]
# notebooks run in processes of their own: with this package and its command
os.environ["PYTHONPATH"] = os.pathsep.join([str(DOCS.parent), os.environ.get("PYTHONPATH", "")])
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])

import gallery  # noqa: E402
import reference  # noqa: E402

import meshskin  # noqa: E402
from meshskin.core.provenance import versions  # noqa: E402

project = "meshskin"
author = "the authors of meshskin"
release = version = meshskin.__version__

extensions = [
    "mathml",
    "myst_nb",
    "notebook_streams",
    "sphinx.ext.autodoc",
    "sphinx.ext.doctest",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build", "_ext", "jupyter_execute"]
html_theme = "furo"
smartquotes = False  # "--out" is an option, not a dash
html_title = f"meshskin {version}"
html_show_copyright = False
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["custom.css"]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 3
default_role = "code"  # docstrings write code between single backticks
doctest_global_setup = "import meshskin as ms\nimport numpy as np"
toc_object_entries_show_parents = "hide"
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_type_aliases = {"Array": "Array", "ArrayLike": "ArrayLike"}


def content_hash(*folders: str) -> str:
    """Hash of sources that outputs depend on, and of the versions of what computes them."""
    digest = hashlib.sha256(repr(versions()).encode())
    for file in sorted(p for folder in folders for p in (DOCS.parent / folder).rglob("*")):
        if file.is_file() and file.suffix != ".pyc":
            digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:16]


PACKAGE = content_hash("meshskin", "bodies")
KEPT = DOCS / "_build" / ".kept"
"""Outputs that a second build takes as they are, by the hash of what they depend on."""

nb_execution_mode = "cache"
nb_execution_cache_path = str(KEPT / "notebooks" / PACKAGE)
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True


def setup(app: Any) -> None:
    """Write the generated pages before Sphinx reads the sources; docstrings as they are written."""
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-docstring", reference.document)
    app.connect("autodoc-process-signature", reference.sign)


def write_pages(app: Any) -> None:
    """Write the pages; outputs of other sources than the present ones are removed."""
    from jupyter_cache import get_cache

    # before processes that read pages in parallel (-j) would each create it
    get_cache(nb_execution_cache_path).list_cache_records()
    reference.write(DOCS / "reference" / "generated", KEPT / "effects" / PACKAGE)
    studied = content_hash("meshskin", "bodies", "studies")
    for old in KEPT.glob("*/*"):
        if old.name not in (PACKAGE, studied):
            shutil.rmtree(old)
    gallery.write(DOCS / "gallery" / "generated", KEPT / "gallery" / studied)
