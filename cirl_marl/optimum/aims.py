"""What is aimed at beside services: λ̄ or the least of an account, and budgets of others; their rows of a program."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated

import numpy as np
from scipy import sparse

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum.matrices import Layout
from cirl_marl.optimum.vintages import Lifetimes


@positional_record
class Aims:
    """The objective, λ̄ or minus the total of an account, and the accounts whose totals are bounded."""

    account: Annotated[int | None, "position of the account that is kept low; None: λ̄ is kept high"] = None
    budgets: Annotated[Mapping[int, float], "highest total of accounts, by position"] = field(default_factory=dict)

    def value(self, run: Rollout) -> float:
        """Return what the first episode of a rollout has of the objective."""
        return float(run.episode_circularity[0] if self.account is None else -run.accounts[0, self.account])

    def totals(self, run: Rollout) -> Floats:
        """Return the totals of the accounts with budgets, shape (budgets,)."""
        return run.accounts[0, [*self.budgets]]

    @property
    def limits(self) -> Floats:
        """The budgets, shape (budgets,)."""
        return np.array([*self.budgets.values()], dtype=np.float64)

    def with_lower_budgets(self, excess: Floats) -> Aims:
        """Return the aims with budgets that are lower by ``excess``, shape (budgets,)."""
        return Aims(self.account, dict(zip(self.budgets, (self.limits - excess).tolist(), strict=True)))

    def excess(self, run: Rollout) -> Floats:
        """Return by how much budgets are exceeded, shape (budgets,)."""
        return np.maximum(self.totals(run) - self.limits, 0.0)


NO_AIMS = Aims()
"""λ̄ is kept high, and there are no budgets."""


def budget_texts(network: Network, aims: Aims) -> list[str]:
    """Say each budget."""
    accounts = network.accounts
    return [f"{accounts[i].id} at most {most:.6g} {accounts[i].unit}" for i, most in aims.budgets.items()]


def aims_of(network: Network, aim: str, at_most: Mapping[str, float] | None) -> Aims:
    """Return the aims that options of ``bound`` ask for.

    Raises:
        CirlError: for an unknown account, a budget that is no finite number, or one of the account that is kept low.
    """
    accounts = [account.id for account in network.accounts]
    if aim != CIRCULARITY and aim not in accounts:
        raise CirlError(f"network '{network.name}': aim: {unknown_name('account', aim, [CIRCULARITY, *accounts])}")
    budgets = {}
    for account, most in (at_most or {}).items():
        if account not in accounts:
            raise CirlError(f"network '{network.name}': at_most: {unknown_name('account', account, accounts)}")
        if isinstance(most, bool) or not isinstance(most, int | float | np.number) or not math.isfinite(most):
            raise CirlError(f"at_most: the budget of '{account}' must be a finite number, got {most!r}")
        if account == aim:
            raise CirlError(f"at_most: '{account}' is kept as low as can be already; leave out its budget, or the aim")
        budgets[accounts.index(account)] = float(most)
    return Aims(None if aim == CIRCULARITY else accounts.index(aim), budgets)


def account_rows(
    lifetimes: Lifetimes, layout: Layout, initial: Floats, intervals: range
) -> tuple[sparse.csr_array, Floats]:
    """Return what totals are of the variables of a program, exactly, and what they have beside them.

    Args:
        lifetimes: of the network.
        layout: of the variables of an interval.
        initial: stocks at the start as the simulator has them, mass.
        intervals: of the program.

    Returns:
        Rows, shape (accounts, variables), and constants, shape (accounts,).
    """
    network, steps = lifetimes.network, len(intervals)
    by_flow, by_stock = (rates[:, intervals.start : intervals.stop] for rates in Ledger(network).rates())
    planned = by_stock.reshape(-1, by_stock.shape[2]) @ lifetimes.totals  # some are parts of the stock of a node
    by_stock = planned.reshape(*by_stock.shape[:2], planned.shape[1])
    table = np.zeros((len(by_flow), steps, layout.size))
    for first in layout.flow.tolist():
        table[:, :, first : first + by_flow.shape[2]] = by_flow / len(layout.moments)
    table[:, :, layout.last] += by_stock / 2
    table[:, :-1, layout.last] += by_stock[:, 1:] / 2
    start = by_stock[:, 0] @ (lifetimes.start_planned @ initial) / 2
    return sparse.csr_array(table.reshape(len(table), steps * layout.size)), start
