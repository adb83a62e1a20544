"""What circular steel costs Japan and what it emits, for ``docs/japan.md``: the front, and each lever alone.

A lever is pulled for the least emissions. Rates are those of the definition, their ranges those of the scenario
``factor_ranges``; what a measure itself costs is booked only for the levers in ``BOOKED``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cirl_marl import MultiAgentVectorEnv, bound, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.network import Floats, Network
from cirl_marl.optimum import improve_plan, simulate_plan
from cirl_marl.optimum.bounds import Bound

BOOKED = ("scrap_exports", "scrap_to_bof")
"""Levers of which every cost is booked: the price of scrap, and what furnaces need."""
ABROAD = ("semis_exports", "long_exports", "flat_exports", "goods_exports")
"""Levers whose revenue is not booked, so that no cost is told."""
BUDGETS = 2
"""Budgets of costs between those of the cheapest and of the most circular plan."""
COST, EMISSIONS = 1, 0
"""Places of the accounts."""


def front(name: str) -> Iterator[str]:
    """Yield cost, emissions and λ̄ of plans, from as usual to the most circular, and what more circularity costs.

    Steel is exported as usual, in all of them.
    """
    network = load_network(name)
    agents = [agent for agent in network.agents if agent not in ABROAD]
    aims = ("emissions", "cost", "circularity")
    cleanest, cheapest, best = (bound(network, aim=aim, min_service=1, agents=agents) for aim in aims)
    budgets = np.linspace(cheapest.accounts[COST], best.accounts[COST], BUDGETS + 2)[1:-1].tolist()
    yield "| 2025–2050 | cost, GUSD of 2019 | CO2, Mt | λ̄, Mt/a | one more t of iron, USD |"
    yield "|-|-|-|-|-|"
    yield _row("as usual", as_usual(network))
    yield _row("least CO2", _played(cleanest))
    yield _row("least cost", _played(cheapest))
    for budget in budgets:
        plan = bound(network, min_service=1, agents=agents, at_most={"cost": budget})
        iron = plan.budget_prices["cost"] * network.episode.horizon  # kt in the episode for a million USD
        yield _row(f"most circular at {budget / 1e3:.0f} GUSD", _played(plan), f"{1e3 / iron:.0f}")
    yield _row("most circular", _played(best))


def as_usual(network: Network) -> Rollout:
    """Return the episode in which nobody acts."""
    return rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral())


def _played(solution: Bound) -> Rollout:
    return simulate_plan(improve_plan(solution))


def _row(label: str, run: Rollout, price: str = "") -> str:
    emissions, cost = run.accounts[0, EMISSIONS], run.accounts[0, COST] / 1e3
    return f"| {label} | {cost:.0f} | {emissions:.0f} | {run.episode_circularity[0] / 1e3:.1f} | {price} |"


def abatement(name: str) -> Iterator[str]:
    """Yield what each lever alone saves of emissions, and what a tonne of them costs or what the measure may cost."""
    network, ranges = load_network(name), load_network(name, scenario="factor_ranges")
    usual = as_usual(network)
    yield "| lever, alone | less CO2, Mt | costs, USD/t CO2 | may cost, USD/t CO2 |"
    yield "|-|-|-|-|"
    for agent in [*BOOKED, *(agent for agent in network.agents if agent not in (*BOOKED, *ABROAD))]:
        run = _played(bound(network, aim="emissions", min_service=1, agents=[agent]))
        avoided = float(usual.accounts[0, EMISSIONS] - run.accounts[0, EMISSIONS])
        cost = float(run.accounts[0, COST] - usual.accounts[0, COST])
        low, high = amount_range(ranges, run.flow.sum(axis=0) - usual.flow.sum(axis=0))
        ends = [(cost + change) / avoided for change in (low, high)]
        if agent in BOOKED:
            cells = f"{cost / avoided:.0f}, {ends[0]:.0f} to {ends[1]:.0f} |"
        else:
            cells = f"| {-cost / avoided:.0f}, {-ends[1]:.0f} to {-ends[0]:.0f}"
        yield f"| {network.compartments[agent].label} | {avoided:.0f} | {cells} |"


def amount_range(network: Network, mass: Floats, account: str = "cost") -> tuple[float, float]:
    """Return by how much what is booked differs at most as rates are uncertain, lowest and highest.

    Args:
        network: one with uncertain rates of the account.
        mass: what flows, or flows more, along each arc, in an episode, shape (arcs,), mass.
        account: its id.
    """
    low = high = 0.0
    for path, spread in network.uncertain.items():
        if path.endswith(f".accounts.{account}"):
            id_ = path.split(".")[1]
            is_node = path.startswith("nodes.")
            charged = network.recipients == network.node_index[id_] if is_node else network.arc_index[id_]
            booked = dict(network.compartments[id_].accounts)[account] * np.sum(mass[charged])
            ends = [booked * (end - 1.0) for end in spread.ends]
            low, high = low + min(ends), high + max(ends)
    return low, high
