"""Policies and controllers side by side: the same episodes, the same figures, and the distance to what is possible."""

from cirl_marl.evaluation.comparison import Comparison, Entry, Row, compare
from cirl_marl.evaluation.yardsticks import Yardstick, yardstick

__all__ = ["Comparison", "Entry", "Row", "Yardstick", "compare", "yardstick"]
