"""The scenes, bodies and arms that come with meshskin (the folder bodies/)."""

from __future__ import annotations

from pathlib import Path

from ..core.arguments import repr_short
from ..core.errors import ConfigError, UnknownNameError


def folder() -> Path:
    """The folder bodies/: inside the installed package, or at the top of a checkout."""
    package = Path(__file__).parents[1]
    inside = package / "bodies"
    return inside if inside.is_dir() else package.parent / "bodies"


def scenes() -> dict[str, Path]:
    """The shipped scenes by name."""
    return {file.stem: file for file in sorted(folder().glob("*.toml"))}


def find_scene(name: str | Path) -> Path:
    """The TOML file of a scene, by shipped name or by path. Raises ConfigError."""
    if not isinstance(name, str | Path):
        raise ConfigError("a scene is loaded by its name or its TOML file", value=repr_short(name))
    path = Path(name)
    if path.suffix == ".toml" and path.is_file():
        return path
    known = scenes()
    if path.is_file() and str(name) not in known:
        raise ConfigError(
            "a scene is a TOML file", value=str(name),
            remedy="give a mesh to it as [body] mesh = ..., units = ...",
        )  # fmt: skip
    if path.suffix == ".toml":
        raise ConfigError("no such scene file", value=str(name))
    if str(name) not in known:
        raise UnknownNameError("scene", str(name), known)
    return known[str(name)]
