"""The best achievable circularity: a proven upper bound, its certificate, and the plan it suggests."""

from cirl_marl.optimum.admissible import NoCertificate
from cirl_marl.optimum.bound import Bound, Envelope
from cirl_marl.optimum.certificate import Certificate, Verification
from cirl_marl.optimum.improve import improved
from cirl_marl.optimum.maximise import bound, envelope
from cirl_marl.optimum.plan import Plan, achieved

__all__ = [
    "Bound",
    "Certificate",
    "Envelope",
    "NoCertificate",
    "Plan",
    "Verification",
    "achieved",
    "bound",
    "envelope",
    "improved",
]
