"""From tables of measured flows to a definition file: reading, balances, reconciliation, writing."""
