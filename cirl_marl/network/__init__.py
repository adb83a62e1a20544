"""What a material network is: compartments, roles, flows, their circularity, and what can be wrong with them."""

from cirl_marl.network.network import Network
from cirl_marl.network.rowsum import Floats, Integers, RowSum, disposable

__all__ = ["Floats", "Integers", "Network", "RowSum", "disposable"]
