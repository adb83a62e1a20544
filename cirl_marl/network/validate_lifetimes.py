"""What is wrong with the lifetimes of a network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cirl_marl.network.ages import age_problems
from cirl_marl.network.declared import bound_problems
from cirl_marl.network.elements import FIXED, MAX_STEPS, Arc, ControlKind, Law, Lifetime, Node
from cirl_marl.network.parts import Parts
from cirl_marl.network.series import extremes
from cirl_marl.network.validate_settings import is_whole

NARROWEST, WIDEST = 0.02, 3.0
"""Deviations of a lifetime, relative to its mean, that stages follow at all."""


def lifetime_problems(network: Parts, node: Node, arcs: Sequence[Arc]) -> Iterator[str]:
    """Yield what does not go with a lifetime that a node has or has not; ``arcs`` are those that enter or leave it."""
    where, kind = f"node '{node.id}': ", node.control.kind if node.control else None
    if node.lifetime is None:
        told = {"stretch": node.stretch != 1.0, "history": node.history is not None, "growth": node.growth is not None}
        for name in (name for name, given in told.items() if given):
            yield f"{where}{name}: it has no lifetime; give it one, or leave this out"
        if kind is ControlKind.STRETCH:
            yield f"{where}control.kind 'stretch' needs a lifetime; a valve is of kind 'rate'"
        return
    if not node.stores:
        return  # told with all else that such a node has not
    for name, given in (("model", node.model is not None), ("rate", extremes(node.rate)[1] > 0)):
        if given:
            yield f"{where}lifetime: it says when what enters leaves, so that there is no {name}"
    if kind not in (None, ControlKind.STRETCH):
        yield f"{where}control.kind '{kind}': a node with a lifetime is controlled by kind 'stretch'"
    yield from _arc_problems(node, arcs)
    mistakes = [*bound_problems(node.lifetime, f"{where}lifetime.")]
    mistakes = mistakes or [f"{where}lifetime.{each}" for each in _spread_problems(network, node.lifetime)]
    if node.lifetime.distribution == FIXED and (kind is ControlKind.STRETCH or node.stretch != 1.0):
        mistakes.append(f"{where}stretch: a fixed lifetime has none; give it a distribution and a small deviation")
    yield from mistakes
    if not mistakes and not [*bound_problems(node)]:
        yield from (f"{where}{each}" for each in age_problems(node, network.episode.control_interval))


def _arc_problems(node: Node, arcs: Sequence[Arc]) -> Iterator[str]:
    if not any(arc.donor == node.id for arc in arcs):
        yield f"node '{node.id}': lifetime: no arc leaves it, so that what has lived has nowhere to go"
    for arc in arcs:
        law = f"arc '{arc.id}': law '{arc.law}'"
        if arc.donor == node.id and arc.law is not Law.SHARE:
            yield f"{law}: its donor '{node.id}' has a lifetime, so that only law 'share' can leave it"
        if arc.recipient == node.id and arc.law in (Law.BATCH, Law.RECIPIENT):
            yield f"{law}: it cannot enter '{node.id}', which has a lifetime"


def _spread_problems(network: Parts, lifetime: Lifetime) -> Iterator[str]:
    """Yield why a lifetime cannot be followed."""
    mean, deviation, interval = lifetime.mean, lifetime.deviation, network.episode.control_interval
    if lifetime.distribution == FIXED:
        if deviation is not None:
            yield f"deviation {deviation:g}: a fixed lifetime has none"
        if not is_whole(mean / interval) or not 1 <= round(mean / interval) <= MAX_STEPS:
            whole = f"a whole number, from 1 to {MAX_STEPS:,}, of control intervals of {interval:g}"
            yield f"mean {mean:g} {network.time_unit}: a fixed lifetime is {whole}"
    elif lifetime.distribution == "exponential":
        if deviation not in (None, mean):
            yield f"deviation {deviation:g}: that of an exponential lifetime is its mean; leave it out"
    elif deviation is None:
        yield f"deviation: missing; a {lifetime.distribution} lifetime needs one"
    elif not NARROWEST <= deviation / mean <= WIDEST:
        remedy = "take distribution = 'fixed'" if deviation < mean else "is it in the unit of the mean?"
        known = f"{deviation / mean:.3g} of the mean; from {NARROWEST:g} to {WIDEST:g} can be followed"
        yield f"deviation {deviation:g} is {known}: {remedy}"
