"""A taxel's frame to look at: spikes, x red, y green, z (the normal) blue and twice as long."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LENGTH = 1.0
"""of the x and y spikes, in radii of the disc"""
WIDTH = 0.12
"""of a spike's base, in radii of the disc"""
COLOURS = np.array([[200, 40, 40, 255], [40, 160, 60, 255], [40, 80, 200, 255]], dtype=np.uint8)


def shape(disc_radius: float) -> tuple[Array, NDArray[np.intp], NDArray[np.uint8]]:
    """Vertices (12, 3) in m, faces (12, 3) and vertex colours (12, 4) of one frame's spikes."""
    angle = 2.0 * np.pi * np.arange(3) / 3.0
    base = WIDTH * np.column_stack([np.zeros(3), np.cos(angle), np.sin(angle)])
    vertices, faces = [], []
    for axis in range(3):
        spike = np.vstack([base, [LENGTH * (2.0 if axis == 2 else 1.0), 0.0, 0.0]])
        vertices.append(np.roll(spike, axis, axis=1))
        faces.append(4 * axis + np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    colours = np.repeat(COLOURS, 4, axis=0)
    return disc_radius * np.concatenate(vertices), np.concatenate(faces), colours
