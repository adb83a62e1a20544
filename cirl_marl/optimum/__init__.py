"""The best achievable circularity: a proven upper bound, its certificate, and the plan it suggests."""

from cirl_marl.optimum.admissible import NoCertificate
from cirl_marl.optimum.bound import Bound, bound
from cirl_marl.optimum.certificate import Certificate, Verification
from cirl_marl.optimum.improve import improved
from cirl_marl.optimum.plan import Plan, achieved

__all__ = ["Bound", "Certificate", "NoCertificate", "Plan", "Verification", "achieved", "bound", "improved"]
