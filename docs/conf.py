"""Configuration of the documentation: `python -m sphinx -W docs docs/_build/html`."""

import hashlib
import os
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS.parent), str(DOCS / "_ext")]
# notebooks run in processes of their own: with this package and its command
os.environ["PYTHONPATH"] = os.pathsep.join([str(DOCS.parent), os.environ.get("PYTHONPATH", "")])
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])

import reference  # noqa: E402

import meshskin  # noqa: E402

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
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_type_aliases = {"Array": "Array", "ArrayLike": "ArrayLike"}


def package_hash() -> str:
    """Hash of the sources that the outputs of notebooks depend on."""
    files = sorted(p for d in ("meshskin", "bodies") for p in (DOCS.parent / d).rglob("*"))
    digest = hashlib.sha256()
    for file in files:
        if file.is_file() and file.suffix != ".pyc":
            digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:16]


nb_execution_mode = "cache"
nb_execution_cache_path = str(DOCS / "_build" / ".notebooks" / package_hash())
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
    reference.write(DOCS / "reference" / "generated", DOCS / "_build" / ".effects" / package_hash())
