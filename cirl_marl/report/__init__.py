"""Pictures of networks and results, by matplotlib without its global state.

This package alone imports matplotlib; import it where a picture is wanted, not at the top of a module.
"""

from cirl_marl.report.curves import save_circularity, save_learning_curves, save_trajectory
from cirl_marl.report.digraph import Canvas, draw_network, save_before_after, save_network

__all__ = [
    "Canvas",
    "draw_network",
    "save_before_after",
    "save_circularity",
    "save_learning_curves",
    "save_network",
    "save_trajectory",
]
