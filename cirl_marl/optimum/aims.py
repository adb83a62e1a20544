"""What is aimed at: λ̄, totals of accounts and levels of services, weighed, and budgets; their rows of a program."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import field, replace
from itertools import groupby
from typing import Annotated, Protocol

import numpy as np
from scipy import sparse

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import years
from cirl_marl.network.compartment_model import Bools
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.network.units import factor
from cirl_marl.optimum.matrices import Layout
from cirl_marl.optimum.vintages import Lifetimes

Aim = str | Mapping[str, float]
"""``circularity``, an account that is kept low, or the weights of λ̄ and of minus the totals of accounts, by name.

Bounds and plans take services as well, whose levels are kept high.
"""
PER_YEAR = "/year"
"""What follows the id of an account of which there is a budget per year."""
RateTables = tuple[Floats, Floats, Floats]
"""What totals have of mean flows, of mean stocks and of convex parts in some intervals; see ``Ledger.rates``."""


class EpisodeRecord(Protocol):
    """What is read off an episode of the simulator, or some intervals of one; see ``Rollout``."""

    @property
    def levels(self) -> Floats:
        """Level of each service, shape (B, services, steps)."""

    @property
    def episode_levels(self) -> Floats:
        """Mean level of each service, shape (B, services)."""

    @property
    def stock(self) -> Floats:
        """Stocks after each interval in the first copy, shape (steps, stores), mass."""

    @property
    def flow(self) -> Floats:
        """Mean flows in the first copy, shape (steps, arcs), mass/time."""

    @property
    def accounts(self) -> Floats:
        """Amount on each account, discounted, shape (B, accounts)."""

    @property
    def bookings(self) -> Floats:
        """Amount on each account, not discounted, shape (B, accounts, steps)."""


@positional_record
class Budget:
    """The most that may be booked on an account, in an episode or in a year of it."""

    account: Annotated[int, "position of the account"]
    most: Annotated[float, "what it bounds: the total of the episode, or the amount of the year, not discounted"]
    name: Annotated[str, "id of the account, with the year"]
    year: Annotated[slice | None, "intervals of the year; None: it is of the episode"] = None

    def text(self, network: Network) -> str:
        """Say it."""
        return f"{self.name} at most {self.most:.6g} {network.accounts[self.account].unit}"


@positional_record
class Aims:
    """The objective, w·λ̄ − Σ c_i·(total of account i) + Σ v_s·(mean level of service s), and the budgets."""

    circularity: Annotated[float, "w, not negative"] = 1.0
    charges: Annotated[Mapping[int, float], "c by the position of the account"] = field(default_factory=dict)
    budgets: Annotated[tuple[Budget, ...], "what may be booked at most"] = ()
    levels: Annotated[Mapping[int, float], "v, not negative, by the position of the service"] = field(
        default_factory=dict
    )

    @property
    def is_circular(self) -> bool:
        """Whether the objective is λ̄."""
        return self.circularity == 1.0 and not self.charges and not self.levels

    @property
    def account(self) -> int | None:
        """Position of the account that alone is kept low; None if there are other aims."""
        is_alone = not self.circularity and not self.levels
        return next(iter(self.charges)) if is_alone and [*self.charges.values()] == [1.0] else None

    def objective(self, circularity: Floats | float, accounts: Floats) -> Floats:
        """Return the objective but for levels, shape (...), of λ̄ and totals of the accounts, shape (accounts, ...)."""
        result: Floats = np.asarray(self.circularity * circularity, dtype=np.float64)
        for account, charge in self.charges.items():
            result = result - charge * accounts[account]
        return result

    def value(self, run: Rollout) -> float:
        """Return what the first episode of a rollout has of the objective."""
        levels = sum(weight * float(run.episode_levels[0, service]) for service, weight in self.levels.items())
        return float(self.objective(run.episode_circularity[0], run.accounts[0])) + levels

    def size(self, network: Network, accounts: Floats) -> float:
        """Return how large the objective is, given totals of the accounts, shape (accounts,)."""
        account_sizes = sum(abs(charge * accounts[account]) for account, charge in self.charges.items())
        levels = sum(self.levels.values())
        return self.circularity * network.objective.circularity_scale + float(account_sizes) + levels

    def totals(self, run: EpisodeRecord) -> Floats:
        """Return what the first episode of a rollout books of each budget, shape (budgets,)."""
        totals: Floats = self.bookings(run)[0]
        return totals

    def bookings(self, run: EpisodeRecord) -> Floats:
        """Return what each episode of a rollout books of each budget, shape (episodes, budgets)."""
        return self.amounts(run.accounts, run.bookings)

    def amounts(self, totals: Floats, bookings: Floats) -> Floats:
        """Return what is booked of each budget, shape (episodes, budgets).

        Args:
            totals: of accounts, discounted, shape (episodes, accounts).
            bookings: of intervals, not discounted, shape (episodes, accounts, steps).
        """
        amounts = np.empty((len(totals), len(self.budgets)))
        for column, budget in zip(amounts.T, self.budgets, strict=True):
            if budget.year is None:
                column[:] = totals[:, budget.account]
            else:
                column[:] = bookings[:, budget.account, budget.year].sum(axis=1)
        return amounts

    def counts(self, ledger: Ledger) -> Floats:
        """Return by which amounts of each interval count in each budget, shape (budgets, horizon)."""
        table = np.zeros((len(self.budgets), ledger.discount.shape[1]))
        for count, budget in zip(table, self.budgets, strict=True):
            if budget.year is None:
                count[:] = ledger.discount[budget.account]
            else:
                count[budget.year] = 1.0
        return table

    def rates(self, network: Network) -> RateTables:
        """Return what is booked of each budget by mean flows, mean stocks and convex parts of each interval.

        Shapes are those of ``Ledger.rates``, with budgets in place of accounts.
        """
        ledger, accounts = Ledger(network), [budget.account for budget in self.budgets]
        counts = self.counts(ledger)[:, :, None]
        by_flow, by_stock, by_part = (rates[accounts] * counts for rates in ledger.rates(with_discount=False))
        return by_flow, by_stock, by_part

    @property
    def by_year(self) -> Bools:
        """Whether each budget is of a year, shape (budgets,)."""
        return np.array([budget.year is not None for budget in self.budgets], dtype=bool)

    @property
    def has_years(self) -> bool:
        """Whether some budget is of a year."""
        return bool(self.by_year.any())

    @property
    def limits(self) -> Floats:
        """The budgets, shape (budgets,)."""
        return np.array([budget.most for budget in self.budgets], dtype=np.float64)

    @property
    def sizes(self) -> Floats:
        """What budgets are measured by: their sizes, or 1 where they are 0, shape (budgets,)."""
        return np.abs(np.where(self.limits == 0.0, 1.0, self.limits))

    def with_lower_budgets(self, excess: Floats) -> Aims:
        """Return the aims with budgets that are lower by ``excess``, shape (budgets,)."""
        pairs = zip(self.budgets, excess.tolist(), strict=True)
        return replace(self, budgets=tuple(replace(budget, most=budget.most - more) for budget, more in pairs))

    def excess(self, run: EpisodeRecord) -> Floats:
        """Return by how much budgets are exceeded, shape (budgets,)."""
        return np.maximum(self.totals(run) - self.limits, 0.0)

    def unit(self, network: Network) -> str:
        """Return the unit of the objective; empty if several units are weighed."""
        if self.is_circular:
            return f"{network.mass_unit} of λ̄"
        return "" if self.account is None else network.accounts[self.account].unit

    def statement(self, network: Network, limit: float, digits: int) -> str:
        """Say that no episode has more of the objective than a ``limit``."""
        if self.is_circular:
            return f"λ̄ ≤ {limit:.{digits}g} {network.mass_unit}"
        if self.account is not None:
            account = network.accounts[self.account]
            return f"{account.id} ≥ {-limit:.{digits}g} {account.unit}"
        terms = [f"{self.circularity:g}·λ̄"] if self.circularity else []
        terms += [f"{-charge:+g}·{network.accounts[account].id}" for account, charge in self.charges.items()]
        terms += [f"{weight:+g}·level of {network.services[s].id}" for s, weight in self.levels.items()]
        return f"{' '.join(terms).removeprefix('+1·')} ≤ {limit:.{digits}g}"


NO_AIMS = Aims()
"""λ̄ is kept high, and there are no budgets."""


def budget_texts(network: Network, aims: Aims) -> list[tuple[str, list[str]]]:
    """Say the budgets, those of an account per year at once, each with the names of the budgets that it is about."""
    texts = []
    for _, group in groupby(aims.budgets, lambda budget: (budget.account, budget.year is None)):
        budgets = [*group]
        text = budgets[0].text(network)
        if budgets[0].year is not None:
            text = f"{replace(budgets[0], name=network.accounts[budgets[0].account].id).text(network)} a year"
        texts.append((text, [budget.name for budget in budgets]))
    return texts


def aims_of(network: Network, aim: Aim, at_most: Mapping[str, float] | None, *, with_services: bool = False) -> Aims:
    """Return the aims that options of ``bound`` ask for, among them, with ``with_services``, levels of services.

    Raises:
        CirlError: for an unknown account or service, a weight or budget that is no finite number, a negative weight of
            λ̄ or a service, weights that are all 0, or a budget of the account that alone is kept low.
    """
    accounts = [account.id for account in network.accounts]
    services = [service.id for service in network.services if with_services]
    names = [CIRCULARITY, *accounts, *services]
    if not isinstance(aim, str | Mapping):
        raise CirlError(f"aim: give '{CIRCULARITY}', an account, or {{name: weight}}, got {aim!r}")
    if not isinstance(at_most, Mapping | None):
        raise CirlError(f"at_most: give {{account: total}}, got {at_most!r}")
    weights = {aim: 1.0} if isinstance(aim, str) else dict(aim)
    for name, weight in weights.items():
        if name not in names:
            kind = "account or service" if services else "account"
            raise CirlError(f"network '{network.name}': aim: {unknown_name(kind, name, names)}")
        _check_number(f"aim: the weight of '{name}'", weight)
        if name not in accounts and weight < 0:
            raise CirlError(f"aim: the weight of '{name}' must not be negative, got {weight:g}")
    if not any(weights.values()):
        raise CirlError(f"aim: give '{CIRCULARITY}', an account, or weights of these that are not all 0, got {aim!r}")
    budgets: list[Budget] = []
    for name, most in (at_most or {}).items():
        account, _, period = str(name).partition("/")
        if not account:
            raise CirlError(f"at_most: '{name}' names no account; write one before it, as in 'NAME{PER_YEAR}'")
        if account not in accounts:
            raise CirlError(f"network '{network.name}': at_most: {unknown_name('account', account, accounts)}")
        if name not in (account, account + PER_YEAR):
            raise CirlError(f"at_most: '{name}': a budget is of an episode, '{account}', or '{account}{PER_YEAR}'")
        _check_number(f"at_most: the budget of '{name}'", most)
        if name in weights and not any(weight for other, weight in weights.items() if other != name):
            raise CirlError(f"at_most: '{account}' is kept as low as can be already; leave out its budget, or the aim")
        budget = Budget(accounts.index(account), float(most), account)
        budgets += _by_year(network, budget) if period else [budget]
    charges = {accounts.index(name): float(w) for name, w in weights.items() if name in accounts and w}
    places = {service.id: s for s, service in enumerate(network.services) if service.id in services}
    levels = {places[name]: float(w) for name, w in weights.items() if name in services and w}
    return Aims(float(weights.get(CIRCULARITY, 0.0)), charges, tuple(budgets), levels)


def _by_year(network: Network, budget: Budget) -> Iterator[Budget]:
    """Yield a budget for each calendar year, or each year from the start on; an interval is of the year of its middle.

    Raises:
        CirlError: if intervals are longer than a year.
    """
    episode, length = network.episode, factor(network.time_unit, "year")
    if episode.control_interval * length > 1 + 1e-9:
        interval = f"{episode.control_interval:g} {network.time_unit}"
        raise CirlError(
            f"network '{network.name}': at_most: '{budget.name}{PER_YEAR}': an interval, {interval}, is longer than a "
            f"year; give the total of the episode, '{budget.name}'"
        )
    middle = (np.arange(episode.horizon) + 0.5) * episode.control_interval
    of_interval = np.floor(middle * length + 1 if episode.start is None else years(network, middle)).astype(int)
    for year in range(int(of_interval[0]), int(of_interval[-1]) + 1):
        begin, end = np.searchsorted(of_interval, [year, year + 1]).tolist()
        name = f"{budget.name} in {'year ' if episode.start is None else ''}{year}"
        yield replace(budget, name=name, year=slice(begin, end))


def _check_number(subject: str, number: float) -> None:
    if isinstance(number, bool) or not isinstance(number, int | float | np.number) or not math.isfinite(number):
        raise CirlError(f"{subject} must be a finite number, got {number!r}")


def over(rates: RateTables, intervals: range) -> RateTables:
    """Return rates of an episode over some of its intervals."""
    (by_flow, by_stock, by_part), period = rates, slice(intervals.start, intervals.stop)
    return by_flow[:, period], by_stock[:, period], by_part[:, period]


def _by_parts(rates: Floats, sums: sparse.csr_array) -> Floats:
    """Return rates, shape (accounts, steps, …), of the parts that add up to what they are of."""
    accounts, steps, places = rates.shape
    parts: Floats = rates.reshape(accounts * steps, places) @ sums
    return parts.reshape(accounts, steps, sums.shape[1])


def account_rows(
    lifetimes: Lifetimes, layout: Layout, initial: Floats, rates: RateTables
) -> tuple[sparse.csr_array, Floats]:
    """Return what totals are of the variables of a program, exactly but for convex parts, and what they have beside.

    Args:
        lifetimes: of the network.
        layout: of the variables of an interval.
        initial: stocks at the start as the simulator has them, mass.
        rates: over the intervals of the program.

    Returns:
        Rows, shape (accounts, variables), and constants, shape (accounts,).
    """
    (by_flow, by_stock, by_part), steps = rates, rates[0].shape[1]
    # of stocks and flows some are parts of those of the network
    by_stock, by_flow = _by_parts(by_stock, lifetimes.totals), _by_parts(by_flow, lifetimes.arc_sums)
    table = np.zeros((len(by_flow), steps, layout.size))
    for first in layout.flow.tolist():
        table[:, :, first : first + by_flow.shape[2]] = by_flow / len(layout.moments)
    table[:, :, layout.last] += by_stock / 2
    table[:, :-1, layout.last] += by_stock[:, 1:] / 2
    network = lifetimes.network
    controls = [network.control_rows[agent].start for agent in layout.charged_controls]
    table[:, :, layout.effort : layout.excess] = by_part[:, :, controls]
    table[:, :, layout.excess :] = by_part[:, :, by_part.shape[2] - (layout.size - layout.excess) :]
    start = by_stock[:, 0] @ (lifetimes.start_planned @ initial) / 2
    return sparse.csr_array(table.reshape(len(table), steps * layout.size)), start
