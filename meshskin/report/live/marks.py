"""What the live page draws of an estimate, as numbers: colours, ellipsoids, markers, the legend."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arrays import Array
from .. import theme
from ..plane import MM

SIGMA_MM = (0.01, 10.0)
"""Ends of the colour scale, mm: below what printed skins are made to, and about the size of a
module. One scale for every recording, so that pages can be compared."""
UNSEEN = (255, 255, 255)
"""Colour of a taxel that is not determined: the middle of the scale is grey."""
PATCH, NEXT, TRUTH, SIGMA = (213, 94, 0), (204, 51, 120), (95, 107, 122), (0, 158, 115)
"""Colours of the contact patch, of the next touch, of true taxels and of the ellipsoids."""
DISC_HEIGHT = 0.1
"""Height of a disc above its middle, relative to its radius."""
MAGNIFIED = 50.0
"""Factor of the drawn ellipsoids: at 0.02 mm, a usual result, they are half as wide as the disc of
a taxel of 2 mm radius."""
MAX_AXIS = 4e-3
"""Largest drawn semi-axis, m: about a taxel's distance from its neighbour, so that the skin remains
to be seen while nothing is certain."""
MIN_AXIS = 2e-4
"""Least drawn semi-axis, m: across the surface an estimate has no uncertainty, and a flat ellipsoid
would flicker with the taxel's disc."""

Colors = NDArray[np.uint8]


def sigma_colors(sigma: ArrayLike) -> Colors:
    """Colours (n, 3) of standard deviations (n,), m, on the scale SIGMA_MM; UNSEEN if infinite."""
    from matplotlib import colormaps

    s = np.asarray(sigma, dtype=float)
    known = np.asarray(np.isfinite(s))
    low, high = np.log(SIGMA_MM)
    part = (np.log(np.maximum(np.where(known, s, 1.0) * MM, 1e-12)) - low) / (high - low)
    colors = 255 * np.asarray(colormaps[theme.SEQUENTIAL](np.clip(part, 0, 1)))[..., :3]
    return np.where(known[..., None], colors, UNSEEN).astype(np.uint8)


def linear(colors: ArrayLike) -> Colors:
    """Colours (..., 3) as viser wants those of batched meshes: intensities of light, 0 to 255.

    Its browser side (1.1) takes all other colors as sRGB, of which this is the inverse (IEC
    61966-2-1).
    """
    c = np.asarray(colors, dtype=float) / 255
    light = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.round(255 * light).astype(np.uint8)


def position_sigma(covariances: Array) -> Array:
    """Standard deviations (n,), m, in space (root of the trace) of covariances (n, 3, 3), m^2; inf
    where one is not finite.
    """
    trace = np.trace(covariances, axis1=1, axis2=2)
    return np.sqrt(np.where(np.isfinite(trace), np.maximum(trace, 0.0), np.inf))


def ellipsoids(covariances: Array, magnified: float = MAGNIFIED) -> tuple[Array, Array]:
    """Drawn semi-axes (n, 3), m, of 1-sigma ellipsoids, and their rotations (n, 3, 3).

    covariances (n, 3, 3), m^2. Semi-axes lie between MIN_AXIS and MAX_AXIS; those of a covariance
    that is not finite are zero.
    """
    known = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], covariances, np.eye(3)))
    vectors[:, :, 0] *= np.sign(np.linalg.det(vectors))[:, None]
    axes = np.clip(magnified * np.sqrt(np.maximum(values, 0.0)), MIN_AXIS, MAX_AXIS)
    return np.where(known[:, None], axes, 0.0), vectors


def disc(sides: int = 24) -> tuple[Array, NDArray[np.intp]]:
    """Vertices and faces of a flat disc of radius 1 and height 0.2, z its normal."""
    from trimesh.creation import cylinder

    made = cylinder(radius=1.0, height=2 * DISC_HEIGHT, sections=sides)
    return np.asarray(made.vertices), np.asarray(made.faces)


def ring() -> tuple[Array, NDArray[np.intp]]:
    """Vertices and faces of a ring of outer radius 1, z its normal."""
    from trimesh.creation import annulus

    made = annulus(r_min=0.88, r_max=1.0, height=0.1, sections=32)
    return np.asarray(made.vertices), np.asarray(made.faces)


def arrow(length: float) -> tuple[Array, NDArray[np.intp]]:
    """Vertices and faces of an arrow, m, whose tip is the origin and points along -z."""
    from trimesh import creation, util

    head = creation.cone(radius=0.22 * length, height=0.45 * length, sections=24)
    head.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
    head.apply_translation([0.0, 0.0, 0.45 * length])
    shaft = creation.cylinder(radius=0.08 * length, height=0.55 * length, sections=24)
    shaft.apply_translation([0.0, 0.0, 0.725 * length])
    made = util.concatenate([head, shaft])
    return np.asarray(made.vertices), np.asarray(made.faces)


def legend(truth: bool) -> str:
    """The colour scale, with its ends and decades in mm, and the other marks, as HTML; truth:
    whether true taxels are drawn.
    """
    sigma = np.geomspace(*SIGMA_MM, 24) / MM
    stops = ", ".join(f"rgb({r},{g},{b})" for r, g, b in sigma_colors(sigma).tolist())
    decades = np.arange(np.log10(SIGMA_MM[0]), np.log10(SIGMA_MM[1]) + 0.5)
    ticks = "".join(f"<span>{theme.compact(10.0**k)}</span>" for k in decades)
    spread = "display:flex;justify-content:space-between"
    marks = [("&#9679;", UNSEEN, "not determined"), ("&#9679;", PATCH, "contact patch"),
             ("&#9679;", SIGMA, "1 sigma"), ("&#9660;", NEXT, "next touch")]  # fmt: skip
    marks += [("&#9675;", TRUTH, "true taxel")] if truth else []
    outline = f"-webkit-text-stroke:0.5px {theme.MUTED}"
    names = "".join(
        f'<span style="white-space:nowrap"><span style="color:rgb{color};{outline}">{sign}</span> '
        f"{name}</span>"
        for sign, color, name in marks
    )
    return (
        f'<div style="height:12px;border-radius:3px;background:linear-gradient(90deg,{stops})">'
        f'</div><div style="{spread}">{ticks}</div>'
        "<div>standard deviation of a taxel's position (mm)</div>"
        f'<div style="display:flex;flex-wrap:wrap;column-gap:1.1em">{names}</div>'
    )
