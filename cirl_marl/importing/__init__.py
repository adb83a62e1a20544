"""From tables of measured flows to a definition file: reading, balances, reconciliation, writing."""

from cirl_marl.importing.assembly import Imported, imported

__all__ = ["Imported", "imported"]
