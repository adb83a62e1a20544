"""Validation during a training: episodes of their own choose the checkpoint that counts and move the multiplier.

The last policies of a run are seldom the best ones. Validation episodes, the same each time and unlike those of
training and of reports, decide which checkpoint acts; multipliers make the service that a recipe demands, and the
budgets of accounts, constraints.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.rollout import rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RunError
from cirl_marl.learners.policies import Policies
from cirl_marl.network import Floats
from cirl_marl.network.declarations import KeptRecord, positional_record
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum.aims import NO_AIMS, Aims, aims_of
from cirl_marl.records.files import read_record, write_json

FIRST_SEED = 2**40
"""First seed of the episodes that choose; those of training and of reports are below it."""

QUANTILE_95 = 1.645
"""Standard errors by which a service must exceed what is demanded, so that it does so in 95 of 100 evaluations."""


Rank = tuple[bool, float]
"""Whether all that is demanded is kept, then how good it is."""


@positional_record
class Score(KeptRecord):
    """Figures of a validation."""

    NAMES_IN_FILES: ClassVar = {"service_bound": "assured", "episode_return": "paid"}

    circularity: Annotated[float, "mean λ̄ of the episodes; mass"]
    service: Annotated[float, "mean level of the service that lacks most; 1 without services"]
    service_bound: Annotated[float, "lower confidence bound of that level, one-sided at 95 %"]
    episode_return: Annotated[float, "mean return of an episode, summed over the agents"]
    levels: Annotated[Mapping[str, float], "such a bound for each service, by id"] = field(default_factory=dict)
    accounts: Annotated[
        Mapping[str, float], "upper confidence bound of the total of each account, by id, and of each budget, by name"
    ] = field(default_factory=dict)

    def rank(self, min_service: float | None, at_most: Mapping[str, float] = MappingProxyType({})) -> Rank:
        """Return the key by which scores are compared, the higher the better.

        If a level of service is demanded: whether its bound reaches that level, and all budgets are kept, then λ̄ if so
        and what lacks most if not, of a budget in parts of it. Otherwise: the return. Budgets come by name.
        """
        if min_service is None:
            return True, self.episode_return
        shares = [1.0 + (most - self.accounts[account]) / (abs(most) or 1.0) for account, most in at_most.items()]
        least = min([self.service_bound, *(min_service * share for share in shares)])
        is_served = least >= min_service
        return is_served, self.circularity if is_served else least


def validation_score(env: MultiAgentVectorEnv, policies: Policies, aims: Aims = NO_AIMS) -> Score:
    """Play the episodes that choose, the same ones each time; ``env`` has a copy for each and is nobody else's.

    Of the ``aims`` budgets count.
    """
    run = rollout(env, policies, seed=FIRST_SEED)
    levels = run.episode_levels
    lower_bounds, upper_bounds = _confidence_bound(levels, -1.0), _confidence_bound(run.accounts, 1.0)
    budgets = zip(aims.budgets, _confidence_bound(aims.bookings(run), 1.0).tolist(), strict=True)
    ids = [service.id for service in env.network.services]
    return Score(
        circularity=float(run.episode_circularity.mean()),
        service=float(levels.mean(axis=0).min(initial=1.0)),
        service_bound=float(lower_bounds.min(initial=1.0)),
        episode_return=float(run.returns.sum(axis=0).mean()),
        levels=dict(zip(ids, lower_bounds.tolist(), strict=True)),
        accounts=dict(zip(env.ledger.accounts, upper_bounds.tolist(), strict=True))
        | {budget.name: amount for budget, amount in budgets},
    )


def _confidence_bound(values: Floats, side: float) -> Floats:
    """Return the lower (−1) or upper (1) one-sided bound at 95 % of the mean of episodes, (episodes, n), shape (n,)."""
    spread = values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1])
    bound: Floats = values.mean(axis=0) + side * QUANTILE_95 * spread / math.sqrt(len(values))
    return bound


LARGEST_MULTIPLIER = 1e3
"""Largest value of the multiplier."""


def price_step(
    integral: ArrayLike, service: ArrayLike, min_service: float, rate: float, damping_gain: float, least: ArrayLike
) -> tuple[Floats, Floats]:
    """Return q and p after levels ``service``.

    The shortfall counts at most as what may lack at all::

        e = clip((s* − s)/(1 − s*), −1, 1),    q ← q · exp(rate · e),    p = q · exp(damping · e)

    The logarithms move, so that steps are the same whatever a unit of service is worth; q and p stay above ``least``.
    """
    room = max(1.0 - min_service, 1.0 / LARGEST_MULTIPLIER)
    error = np.clip((min_service - np.asarray(service)) / room, -1.0, 1.0)
    integral = np.clip(integral * np.exp(rate * error), least, LARGEST_MULTIPLIER)
    return integral, np.clip(integral * np.exp(damping_gain * error), least, LARGEST_MULTIPLIER)


LEAST_BUDGET_PRICE, FIRST_BUDGET_PRICE = 1e-4, 0.1
"""Price below which that of a budget does not fall, and with which it begins, per circularity scale and its parts."""


def first_prices(aims: Aims, horizon: int) -> Floats:
    """Return the prices with which budgets begin, those of a year with its part of an episode, shape (budgets,)."""
    lengths = [horizon if budget.year is None else budget.year.stop - budget.year.start for budget in aims.budgets]
    return FIRST_BUDGET_PRICE * np.array(lengths, dtype=np.float64) / horizon


def budget_levels(aims: Aims, amounts: Floats, min_service: float) -> Floats:
    """Return what is booked of budgets as levels of services: min_service where it is just the budget.

    Args:
        aims: that have the budgets.
        amounts: booked of each, shape (episodes, budgets).
        min_service: level that is demanded of services.

    Returns:
        Shape (budgets, episodes).
    """
    excess = (amounts - aims.limits) / aims.sizes
    return np.asarray(min_service - excess.T, dtype=np.float64)


def charges_of(env: MultiAgentVectorEnv, aims: Aims, prices: Floats) -> Floats:
    """Return what a unit of each account, discounted, costs at the ``prices`` of budgets, mass.

    The shape is (accounts, 1), with budgets of years (accounts, horizon).
    """
    ledger, scale = env.ledger, env.network.objective.circularity_scale
    charges = np.zeros(ledger.discount.shape)
    for budget, price, size, count in zip(aims.budgets, prices, aims.sizes, aims.counts(ledger), strict=True):
        charges[budget.account] += price * scale / size * (count / ledger.discount[budget.account])
    return charges if aims.has_years else charges[:, :1]


class Multipliers:
    """The Lagrange multipliers p_s of the demanded services: what a shortfall costs in units of circularity.

    The reward is w·λ/c − (1 − w)·Σ_s φ_s·weight_s·shortfall_s, so that p_s = φ_s·(1 − w)/w; the factor φ_s of the
    dearest service is 1. The demanded level s* is a constraint and p_s its multiplier (Altman 1999, Constrained Markov
    Decision Processes), moved by a controller with an integral and a proportional part (Stooke et al. 2020, arXiv
    2007.03964): ``price_step`` after a validation, with the lower bound of each service. Neither q nor p falls below
    what p was at first, where learners that serve more than is demanded would give up at once what takes them long to
    learn. Where one more unit costs about the same over a wide range, they drift through it at any other price, and
    only the damping, which is at once, stops them.

    A budget B of an account has a multiplier p_b as well, per circularity scale c and part of the budget, so that a
    unit of the account is charged for with p_b·c/|B|; its shortfall is (total − B)/|B|, against the same room. A budget
    per year is one for each year, with a multiplier that charges for what is booked in it.
    """

    def __init__(
        self,
        env: MultiAgentVectorEnv,
        min_service: float,
        rate: float,
        damping_gain: float,
        at_most: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        """Begin with the weight that ``env`` has; ``at_most`` are the budgets of accounts, as ``bound`` takes them."""
        self._env, self._min_service, self._rate, self._damping_gain = env, min_service, rate, damping_gain
        self._aims = aims_of(env.network, CIRCULARITY, at_most)
        self._budget_integrals: Floats = first_prices(self._aims, env.network.episode.horizon)
        self._base_charges: Floats = np.array(env.account_charges)
        self._charge(self._budget_integrals)
        weight = max(env.circularity_weight, 1.0 / (1.0 + LARGEST_MULTIPLIER))
        self._least = (1.0 - weight) / weight
        self._integrals: Floats = np.full(len(env.network.services), self._least)

    def update(self, levels: ArrayLike, accounts: Mapping[str, float] = MappingProxyType({})) -> None:
        """Move the multipliers after a validation.

        It assures ``levels``, shape (services,), and at most so much on ``accounts``, as ``Score`` has them.
        """
        self._integrals, prices = price_step(
            self._integrals, levels, self._min_service, self._rate, self._damping_gain, least=self._least
        )
        if len(prices):
            highest = float(prices.max())
            self._env.circularity_weight = 1.0 / (1.0 + highest)
            self._env.service_factors = prices / highest if highest else np.ones_like(prices)
        if self._aims.budgets:
            amounts = np.array([[accounts[budget.name] for budget in self._aims.budgets]], dtype=np.float64)
            levels_of_budgets = budget_levels(self._aims, amounts, self._min_service)[:, 0]
            options = (self._min_service, self._rate, self._damping_gain, LEAST_BUDGET_PRICE)
            self._budget_integrals, budget_prices = price_step(self._budget_integrals, levels_of_budgets, *options)
            self._charge(budget_prices)

    def _charge(self, budget_prices: Floats) -> None:
        """Charge for accounts at the prices of budgets, beside what the environment charges for anyhow."""
        if self._aims.budgets:
            charges = self._base_charges[:, None] + charges_of(self._env, self._aims, budget_prices)
            self._env.account_charges = charges if self._aims.has_years else charges[:, 0]

    def save(self, folder: Path) -> None:
        """Write the weight, the factors and the integral parts to a checkpoint."""
        state = {
            "circularity_weight": self._env.circularity_weight,
            "service_factors": self._env.service_factors.tolist(),
            "lasting_price": self._integrals.tolist(),
        }
        if self._aims.budgets:
            state["account_charges"] = self._env.account_charges.tolist()
            state["lasting_budget_price"] = self._budget_integrals.tolist()
        write_json(folder / "price.json", state)

    def load(self, folder: Path) -> None:
        """Load what ``save`` wrote, or one price of all services; a ``RunError`` if they are missing or none."""
        path, count = folder / "price.json", len(self._integrals)
        try:
            state = read_record(path)
            weight, factors = float(state["circularity_weight"]), state.get("service_factors", [1.0] * count)
            integrals = np.broadcast_to(np.array(state["lasting_price"], dtype=np.float64), count).copy()
            if not (0.0 <= weight <= 1.0 and (np.isfinite(integrals) & (integrals >= 0.0)).all()):
                raise ValueError(f"a weight of {weight} and prices of {integrals.tolist()}")
            if np.max(factors, initial=0.0) > 1.0:
                raise ValueError(f"factors of {factors}, of which the dearest is 1")
            self._env.service_factors = factors
            if budgets := len(self._aims.budgets):
                charges = np.array(state["account_charges"], dtype=np.float64)
                highest = charges_of(self._env, self._aims, np.full(budgets, LARGEST_MULTIPLIER))
                if (np.abs(charges.T - self._base_charges) > highest.T * (1 + 1e-9)).any():
                    raise ValueError(f"charges of {charges.tolist()}, of which none is beyond {highest.tolist()}")
                self._env.account_charges = charges
                integrals_of_budgets = np.array(state["lasting_budget_price"], dtype=np.float64)
                self._budget_integrals = np.broadcast_to(integrals_of_budgets, budgets).copy()
        except (CirlError, KeyError, TypeError, ValueError) as error:
            raise RunError(f"{path}: cannot be read: {error!r}; it holds the price of service") from error
        self._env.circularity_weight, self._integrals = weight, integrals
