"""From tables of measured flows to a definition file: reading, balances, reconciliation, writing."""

from cirl_marl.importing.assembly import ImportReport, import_flows

__all__ = ["ImportReport", "import_flows"]
