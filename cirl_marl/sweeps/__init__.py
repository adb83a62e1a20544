"""Sweeps: the product of networks, scenarios, recipes, options and seeds, each cell trained and held to the bound."""

from cirl_marl.sweeps.cells import Cell
from cirl_marl.sweeps.reading import SweepFile, load_sweep
from cirl_marl.sweeps.running import CellStatus, SweepOutcome, sweep

__all__ = ["Cell", "CellStatus", "SweepFile", "SweepOutcome", "load_sweep", "sweep"]
