"""The examples of the gallery: commands that the build runs, and what they need."""

from __future__ import annotations

import ast
import os
from dataclasses import dataclass
from pathlib import Path

from meshskin.core.config import read_toml
from meshskin.scene import shipped_scenes

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("MESHSKIN_DATA", ROOT / "data"))
"""Folder of published recordings and meshes, which are not part of the project."""


@dataclass(frozen=True)
class Example:
    """A page of the gallery: a command and its pictures."""

    name: str
    """Name of the page."""
    title: str
    command: str
    """The command; OUT stands for the folder of results, DATA for that of the data."""
    source: Path
    """The scene or script, shown on the page."""
    text: str
    pictures: tuple[str, ...]
    """Pictures below OUT, the first of them on the card."""
    full: str = ""
    """Command of the whole study, where `command` has reduced arguments."""
    data: str = ""
    """Folder below DATA that is needed."""
    report: bool = False
    """Whether the command writes OUT/report.html."""

    @property
    def missing(self) -> str:
        """What is needed and absent; "" where nothing is."""
        absent = self.data and not (DATA / self.data).is_dir()
        return f"the folder `{self.data}` in `MESHSKIN_DATA`" if absent else ""


def examples() -> list[Example]:
    """Every shipped scene, and the studies."""
    return [*map(_scene, shipped_scenes.scenes()), *(_study(*row) for row in _STUDIES)]


def _scene(name: str) -> Example:
    source = shipped_scenes.scenes()[name]
    figures = ("fig5_estimates", "errors", "coverage", "uncertainty", "fig4_force")
    return Example(
        name=name,
        title=f"Scene: {name}",
        command=f"meshskin run {name} --out OUT",
        source=source,
        text=str(read_toml(source)["description"]),
        pictures=tuple(f"figures/{figure}.png" for figure in figures),
        report=True,
    )


def _study(
    script: str, title: str, arguments: str, full: str, pictures: tuple[str, ...], needs: str
) -> Example:
    source = ROOT / "studies" / f"{script}.py"
    doc = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""
    return Example(
        name=script,
        title=title,
        command=f"python studies/{script}.py {arguments} --out OUT",
        source=source,
        text=doc,
        pictures=pictures,
        full=f"python studies/{script}.py {full}".strip() if full else "",
        data=needs,
    )


_STUDIES: tuple[tuple[str, str, str, str, tuple[str, ...], str], ...] = (
    (
        "paper_figures", "The paper's figures", "--seeds 2", "--out figures/ --full",
        ("fig9.png", "fig4.png", "fig5.png", "fig6.png", "fig7.png", "fig8.png"), "",
    ),
    (
        "estimators", "Estimators and noise", "--seeds 1 --only noise", "--out figures/ --full",
        ("estimators.png",), "",
    ),
    (
        "effects", "Effects and the joint estimate",
        "--seeds 1 --effects friction hysteresis body_pose",
        "--out figures/ --full", ("effects.png",), "",
    ),
    (
        "skin_design", "Design of a skin", "--seeds 1 --only spacing_mm thickness_mm",
        "--out figures/ --full", ("skin_design.png",), "",
    ),
    (
        "accuracy_cost", "Work and precision", "--scenes sphere_noisy --asked --knobs rate method",
        "--out figures/ --full", ("accuracy_cost.png",), "",
    ),
    (
        "tuning", "Gains by optimal control", "--scenes sphere --quasi-static --points 2",
        "--out figures/ --full",
        ("fig4_tuned_sphere.png", "tuning_trade.png"), "",
    ),
    (
        "foreign_worlds", "Learned response", "--seeds 1 --worlds bell",
        "--out figures/ --full", ("foreign_worlds.png",), "",
    ),
    (
        "real_bodies", "Bodies of real robots",
        "DATA --only 'UR3e forearm'",
        "DATA --out figures/ --full", ("real_bodies.png",), "icub_body",
    ),
    (
        "coactivation", "Layout from co-activation", "--data DATA --scenes",
        "--data DATA --out figures/", ("coactivation_torso.png",), "icub_torso_touches",
    ),
    (
        "self_touch", "Skins that touch each other",
        "--data DATA --splits 1 --pairs leftArm_torso", "--data DATA --out figures/",
        ("self_touch.png",), "nao_selftouch",
    ),
)  # fmt: skip
"""Studies: script, title, arguments here, arguments of the whole study, pictures, and the folder of
the data that is needed."""
