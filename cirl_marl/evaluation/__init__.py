"""Policies and controllers side by side: the same episodes, the same figures, and the distance to what is possible."""

from cirl_marl.evaluation.baselines import Baseline, solve_baseline
from cirl_marl.evaluation.comparison import Comparison, Entry, Row, compare

__all__ = ["Baseline", "Comparison", "Entry", "Row", "compare", "solve_baseline"]
