"""`meshskin scenes`: list the shipped scenes."""

from __future__ import annotations

import argparse


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""


def command(options: argparse.Namespace) -> int:
    """Print every scene's name and description."""
    from ..core.config import read_toml
    from ..scene import shipped_scenes

    for name, path in shipped_scenes.scenes().items():
        print(f"{name:16} {read_toml(path).get('description', '')}")
    return 0
