"""What is wrong with the accounts of a network, and with what is booked on them."""

from __future__ import annotations

from collections.abc import Iterator

from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.network.declarations import bound_problems
from cirl_marl.network.elements import CIRCULARITY, Arc, Node
from cirl_marl.network.piecewise import PiecewiseRate
from cirl_marl.network.specification import Specification
from cirl_marl.network.units import factor

RESERVED = (CIRCULARITY, "service_level")
"""Ids that no account may have."""


def account_problems(network: Specification) -> Iterator[str]:
    """Yield every mistake in the accounts of ``network``."""
    services = [service.id for service in network.services]
    for account in network.accounts:
        subject = f"account '{account.id}'"
        yield from bound_problems(account, f"{subject}: ")
        if account.id in RESERVED:
            yield f"{subject}: the id names a figure of every episode; choose another"
        if account.id in services:
            yield f"{subject}: a service has the same id, and aims and costs by name would be of either; choose another"
        try:
            factor(account.unit, account.unit)
        except CirlError as error:
            yield f"{subject}: {error}"
    accounts, paths = [account.id for account in network.accounts], network.disturbed.items()
    summands = {path for path, disturbed in paths if disturbed.adds}
    for part in (*network.nodes, *network.arcs):
        holding = part.holding if isinstance(part, Node) else ()
        if not (part.accounts or part.effort or holding):
            continue  # by far the most usual
        subject = f"{type(part).__name__.lower()} '{part.id}'"
        for name, rates in (("accounts", part.accounts), ("effort", part.effort), ("holding", holding)):
            for id_, rate in dict(rates).items():
                if id_ not in accounts:
                    yield f"{subject}: {name}: {unknown_name('account', id_, accounts)}"
                if isinstance(rate, PiecewiseRate):
                    path = f"{type(part).__name__.lower()}s.{part.id}.{name}.{id_}"
                    faults = [*_pieces_problems(rate, is_effort=name == "effort", has_summand=path in summands)]
                    yield from (f"{subject}: {name}.{id_}: {fault}" for fault in faults)
        if isinstance(part, Node) and holding and not part.stores:
            yield f"{subject}: holding: it stores nothing; charge what enters it, under accounts"
        if part.effort and part.control is None:
            yield f"{subject}: effort: it has no control, which could be away from its neutral value"
        if part.effort and isinstance(part, Arc) and part.makes_up_for:
            fault = f"what it supplies to make up for '{part.makes_up_for}' is neutral, however much"
            yield f"{subject}: effort: {fault}; charge what flows, under accounts"


def _pieces_problems(rate: PiecewiseRate, *, is_effort: bool, has_summand: bool) -> Iterator[str]:
    """Yield what is wrong with a rate in pieces."""
    yield from rate.problems()
    if is_effort and rate.rates and rate.rates[0] < 0:
        yield f"rates {rate.rates[0]:g} must be finite and not negative"
    if has_summand:
        yield "a disturbance is a factor on rates in pieces; it is added only to a single rate"
