"""`meshskin scenes`: list the shipped scenes, or show the file of one.

With --show, the TOML file of the scene is printed, to start one's own from; a scene that extends
another one holds only what differs from it.
"""

from __future__ import annotations

import argparse

from .options import option


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "--show NAME", "print the file of this scene")


def command(options: argparse.Namespace) -> int:
    """Print every scene's name and description, or the file of one."""
    from ..core.config import read_toml
    from ..scene import shipped_scenes

    if options.show is not None:
        path = shipped_scenes.find_scene(options.show)
        print(f"# {path}\n{path.read_text(encoding='utf-8').rstrip()}")
        return 0
    for name, path in shipped_scenes.scenes().items():
        print(f"{name:16} {read_toml(path).get('description', '')}")
    return 0
