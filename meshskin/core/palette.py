"""Colours of lines and of methods, which all figures share: those of Okabe and Ito, safe for
colour-blind readers, and others that can be told from them.
"""

INK = "#1f2328"
"""Text."""
MUTED = "#6b7280"
"""What is less important than others."""
FAINT = "#d5d9de"
"""Lines of a grid."""
ESTIMATE = "#0072b2"
"""What was estimated."""
TRUTH = "#5f6b7a"
"""The truth of a simulation."""
BOUND = "#cc79a7"
"""The Cramér-Rao bound."""
WARNING = "#d55e00"
"""What is wrong, or left out."""
SEQUENTIAL = "cividis"
"""Color map of values in an order."""
PALETTE = ("#0072b2", "#009e73", "#e69f00", "#56b4e9", "#cc79a7", "#7b4fa3", "#b59f00", "#8c4a2f")
"""Lines in turn."""
METHOD_COLOURS = {
    "joint": "#0072b2",
    "trilateration": "#009e73",
    "three_circles": "#e69f00",
    "eq15": "#56b4e9",
    "posegraph": "#cc79a7",
    "posegraph_isotropic": "#7b4fa3",
    "posegraph_paper": "#b59f00",
    "centroid": "#8c4a2f",
    "coactivation": "#e34a9b",
    "hertz": "#7fb800",
    "hertz_gain": "#3d5a00",
    "learned": "#c1121f",
}
"""The colour of each method, and of the joint estimate's variants, in every figure."""


def method_colour(method: str) -> str:
    """The colour of a method; that of what is less important for others."""
    return METHOD_COLOURS.get(method, MUTED)
