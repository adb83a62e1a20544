"""From tables of measured numbers to definitions: flows and balances, and processes of disturbances."""

from cirl_marl.importing.assembly import ImportReport, import_flows
from cirl_marl.importing.disturbance_fits import DisturbanceFits, fit_disturbances

__all__ = ["DisturbanceFits", "ImportReport", "fit_disturbances", "import_flows"]
