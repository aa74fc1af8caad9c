"""Pages of the gallery: each example is run by the build, and shown with what it drew and printed.

Results are kept by the content of the package, the studies and the scenes: a second build runs
nothing.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from textwrap import dedent

from examples import DATA, ROOT, Example, examples
from PIL import Image
from reference import write_changed
from sphinx.errors import ExtensionError

TIMEOUT = 1200
"""Longest time of an example, s: the longest takes 45 s on an idle core, and 300 s on a machine
that eight others use."""
WORKERS = 2
"""Examples that run at once."""


def write(folder: Path, cache: Path) -> None:
    """Write the pages below `folder`; the results of the examples are kept in `cache`."""
    shown = examples()
    with ThreadPoolExecutor(WORKERS) as pool:
        results = list(pool.map(lambda e: None if e.missing else run(e, cache), shown))
    for example, result in zip(shown, results, strict=True):
        pictures = _copied(example, result, folder) if result else []
        write_changed(folder / f"{example.name}.md", page(example, result, pictures))
    write_changed(folder / "cards.txt", cards(shown, folder))
    for stale in set(folder.glob("*.md")) - {folder / f"{e.name}.md" for e in shown}:
        stale.unlink()


def run(example: Example, cache: Path) -> Path:
    """The folder with the results of an example, which is run unless they are there."""
    kept = cache / example.name
    if (kept / "run.json").is_file():
        return kept
    work = cache / f"{example.name}.running"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    words = shlex.split(example.command.replace("OUT", str(work)).replace("DATA", str(DATA)))
    start = [sys.executable] if words[0] == "python" else [sys.executable, "-m", "meshskin"]
    environment = {"OMP_NUM_THREADS": "1"} | os.environ | {"PYTHONPATH": str(ROOT)}
    with open(work / "stdout.txt", "w") as out, open(work / "stderr.txt", "w") as err:
        process = subprocess.Popen(
            start + words[1:], cwd=ROOT, env=environment, stdout=out, stderr=err
        )
        try:
            process.wait(TIMEOUT)
        except subprocess.TimeoutExpired as error:
            message = f"{example.command}: did not end within {TIMEOUT} s; build on an idle machine"
            raise ExtensionError(message) from error
        finally:
            process.kill()
    if process.returncode != 0:
        tail = (work / "stderr.txt").read_text()[-2000:] + (work / "stdout.txt").read_text()[-2000:]
        raise ExtensionError(f"{example.command}: exit code {process.returncode}\n{tail}")
    (work / "run.json").write_text(json.dumps({"command": example.command}))
    printed = (work / "stdout.txt").read_text().strip("\n")
    printed = printed.replace(str(work), "out").replace(str(DATA), "$MESHSKIN_DATA")
    (work / "stdout.txt").write_text(printed)
    shutil.rmtree(kept, ignore_errors=True)
    work.rename(kept)
    return kept


def _copied(example: Example, result: Path, folder: Path) -> list[Path]:
    """The pictures of an example, beside its page, and its report."""
    place = folder / example.name
    place.mkdir(parents=True, exist_ok=True)
    names = [*example.pictures, *(["report.html"] if example.report else [])]
    for name in names:
        target = place / Path(name).name
        if not target.is_file() or target.read_bytes() != (result / name).read_bytes():
            shutil.copyfile(result / name, target)
    return [place / Path(name).name for name in example.pictures]


def page(example: Example, result: Path | None, pictures: list[Path]) -> str:
    """The page of an example."""
    shown = example.command.replace("OUT", "out/").replace("DATA", "$MESHSKIN_DATA")
    parts = [f"# {example.title}", _summary(example)]
    parts += [_image(picture, example) for picture in pictures]
    if result is None:
        parts.append(f":::{{admonition}} Not built here\nIt needs {example.missing}.\n:::")
    parts.append(f"```sh\n{shown}\n```")
    if example.full:
        full = example.full.replace("DATA", "$MESHSKIN_DATA")
        parts.append(f"This page has reduced arguments; the whole study is `{full}`.")
    if result is not None and example.report:
        parts.append(f"{{download}}`The report of this run <{example.name}/report.html>`.")
    if result is not None and (text := (result / "stdout.txt").read_text()):
        parts.append(f"## Output\n\n```text\n{text}\n```")
    rest = _details(example)
    parts += [f"## About the study\n\n{rest}"] if rest else []
    language = "toml" if example.source.suffix == ".toml" else "python"
    source = os.path.relpath(example.source, ROOT / "docs" / "gallery" / "generated")
    parts.append(
        f"::::{{dropdown}} {example.source.relative_to(ROOT)}\n"
        f":::{{literalinclude}} {source}\n:language: {language}\n:::\n::::"
    )
    return "\n\n".join(parts) + "\n"


def _image(picture: Path, example: Example) -> str:
    with Image.open(picture) as image:
        width = min(round(image.width * 0.64), 760)  # figures have 150 pixels an inch, pages 96
    where = f"{picture.parent.name}/{picture.name}"
    return f"```{{image}} {where}\n:alt: {example.title}, {picture.stem}\n:width: {width}px\n```"


def _summary(example: Example) -> str:
    return example.text.split("\n\n")[0]


def _details(example: Example) -> str:
    """The docstring after its first paragraph, without the command line that it begins with."""
    parts = example.text.split("\n\n")[1:]
    return "\n\n".join(_block(part) for part in parts if not part.lstrip().startswith("python "))


def _block(part: str) -> str:
    """A paragraph; a list that is set by spaces as it stands."""
    lines = part.splitlines()
    hanging = any(line.startswith("        ") for line in lines[1:])
    return f"```text\n{dedent(part)}\n```" if hanging else part


def cards(shown: list[Example], folder: Path) -> str:
    """The cards of all examples, and their table of contents, for the index of the gallery."""
    out = ["::::{grid} 1 1 2 2", ":gutter: 2", ""]
    for example in shown:
        out += [f":::{{grid-item-card}} {example.title}", f":link: generated/{example.name}"]
        out += [":link-type: doc"]
        if not example.missing:
            picture = Path(example.pictures[0]).name
            out.append(f":img-bottom: generated/{example.name}/{picture}")
        words = f"Not built here: needs {example.missing}." if example.missing else ""
        out += ["", words or _summary(example), ":::", ""]
    pages = [f"generated/{example.name}" for example in shown]
    return "\n".join([*out, "::::", "", "```{toctree}", ":hidden:", "", *pages, "```", ""])
