"""Better actions for the plan of a window in which contents count, by linear programs around what comes of them.

The program of a window lets what is no substance and each substance go separate ways within the ranges of contents, so
that its plan may be far too impure. It is where ``climb`` begins, as it does with the plan of a bound.
"""

from __future__ import annotations

from dataclasses import replace
from operator import attrgetter
from typing import Annotated

import numpy as np

from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.aims import Aims
from cirl_marl.optimum.improve import Trials, climb
from cirl_marl.optimum.linearised import Span
from cirl_marl.optimum.slopes import MOST_SLOPES, slopes_of
from cirl_marl.optimum.window_planner import Future
from cirl_marl.optimum.windows import WindowTask

ROUNDS = 20
"""Most linear programs for a window."""


@positional_record
class WindowActions:
    """Actions of some intervals, as ``climb`` improves them."""

    network: Annotated[Network, "the network"]
    agents: Annotated[tuple[str, ...], "who acts"]
    initial: Annotated[Floats, "stocks at the start, by stage, shape (rows,), mass"]
    actions: Annotated[Floats, "normalised, shape (intervals, entries)"]
    service_weight: Annotated[float | None, "of λ̄/scale + w·service"]
    aims: Annotated[Aims, "objective, as the part of the episode that these intervals are, and what is left of budgets"]


@positional_record
class WindowEpisode:
    """What came of them; see ``EpisodeRecord``."""

    value: Annotated[float, "objective reached, less what is left to later intervals"]
    levels: Annotated[Floats, "shape (1, services, intervals)"]
    stock: Annotated[Floats, "shape (intervals, stores), mass"]
    flow: Annotated[Floats, "shape (intervals, arcs), mass/time"]
    accounts: Annotated[Floats, "of these intervals, discounted, shape (1, accounts)"]
    bookings: Annotated[Floats, "not discounted, in the intervals of the episode, shape (1, accounts, horizon)"]

    @property
    def episode_levels(self) -> Floats:
        """Mean level of each service, shape (1, services)."""
        return np.asarray(self.levels.mean(axis=2))


def climb_window(
    future: Future, task: WindowTask, actions: Floats, service_weight: float | None, free: int | None = None
) -> tuple[Floats, Floats]:
    """Return better actions of a window, shape (intervals, entries), and the price that they needed, as of the task.

    Args:
        future: that is planned for.
        task: what is planned.
        actions: to begin with.
        service_weight: of the objective; None if services are demanded.
        free: how many of the first intervals may change; None: all.
    """
    share, aims = len(task.intervals) / future.horizon, future.aims_of(task)
    plan = WindowActions(future.network, future.admissible.agents, task.stock, actions, service_weight, aims)
    if slopes_of(actions.shape, future.dynamics) > MOST_SLOPES:
        return actions, task.price

    def simulate(trial: WindowActions) -> WindowEpisode:
        outcome = future.carry_out(task, trial.actions)
        levels = outcome.level.T[None]
        bookings = np.zeros((1, len(outcome.amounts), future.horizon))
        bookings[0, :, task.intervals.start : task.intervals.stop] = outcome.amounts
        accounts = outcome.accounts[None]
        return WindowEpisode(outcome.value / share, levels, outcome.stock, outcome.flow, accounts, bookings)

    demand = np.zeros(len(future.network.services)) if task.demand is None else task.demand
    later = future.later(task)
    if later is not None:
        later = replace(later, cost=later.cost / share, level_cost=later.level_cost / share)
    span = Span(future.places(task.intervals).start, later, future.account_rates(task), free)
    trials = Trials(simulate, attrgetter("value"), demand, aims, span)
    budgets = len(task.limits)
    services = np.zeros(len(demand)) if task.demand is None else task.price[budgets:]
    price = np.concatenate([services, task.price[:budgets] / (share * future.aims.sizes[:budgets])])
    better, price = climb(plan, trials, price, ROUNDS, demand_first=task.has_to_serve)
    budget_price = price[len(demand) :] * share * future.aims.sizes[:budgets]
    return better.actions, np.append(budget_price, price[: len(task.price) - budgets])
