"""The best achievable circularity: a proven upper bound, its certificate, its plan, and the best plan found."""

from cirl_marl.optimum.admissible import NoCertificate
from cirl_marl.optimum.bounds import Bound, Envelope, bound, envelope, gap
from cirl_marl.optimum.certificate import Certificate, Verification
from cirl_marl.optimum.closing import GapClosure, close_gap
from cirl_marl.optimum.cross_entropy import Incumbent, search, search_each, standard_candidates
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.improve import improve_plan
from cirl_marl.optimum.planned_episodes import Plan, simulate_plan
from cirl_marl.optimum.smooth import smooth_plan
from cirl_marl.optimum.uncertain_bound import UncertainBound

__all__ = [
    "Bound",
    "Certificate",
    "Envelope",
    "GapClosure",
    "Incumbent",
    "NoCertificate",
    "Plan",
    "Sampling",
    "UncertainBound",
    "Verification",
    "bound",
    "close_gap",
    "envelope",
    "gap",
    "improve_plan",
    "search",
    "search_each",
    "simulate_plan",
    "smooth_plan",
    "standard_candidates",
]
