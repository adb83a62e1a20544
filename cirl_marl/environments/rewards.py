"""Rewards: levels of services and local rewards, and who is paid what for the circularity of a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cirl_marl.dynamics.integrator import Dynamics, Transition
from cirl_marl.dynamics.supply import Supply
from cirl_marl.dynamics.uncertain_factors import RowFactors
from cirl_marl.environments.observations import ObservationLayout
from cirl_marl.environments.state import State
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Service
from cirl_marl.network.rowsum import NEGLIGIBLE, RowSum
from cirl_marl.network.series import Series
from cirl_marl.network.uncertainty import numbers_of

CIRCULARITY_REWARDS = ("mixed", "mixed_difference", "team")
"""Rewards in which λ has a weight, and so services a price."""

CELLS = 4_000_000
"""Largest number of stocks and inner states that difference rewards re-simulate at once."""


class Scoring:
    """Scores stocks and mean flows.

    The local reward of compartment c with quantity q (stock or throughput of a node, mean flow of an arc) is::

        r_c = −((q − set_point)/scale)² − Σ_s weight_s · shortfall_s,    s over the services that c owes

    plus the reward of its model, if it has one. Here shortfall = 1 − level, and the level of a service with band
    [low, high] is min(1, q/low, high/q), without q/low if low = 0. Of a service with a substance q is the content of
    what it measures, and the level is 1 where there is nothing.

    Args of all methods are compartment-major, shape (rows, B).

    Attributes:
        service_factors: by which weights are multiplied in rewards, shape (services,).
    """

    def __init__(self, dynamics: Dynamics, layout: ObservationLayout, agents: Sequence[str], batch: int) -> None:
        """Compile the scores of ``agents`` and of the network as a whole, for arrays of ``batch`` columns."""
        network, ranges = dynamics.network, dynamics.factors.ranges
        compartments = list(network.compartments.values())
        position = {c.id: i for i, c in enumerate(compartments)}
        tracked_ids = network.objective.tracked or [c.id for c in compartments if c.set_point is not None]
        with_set_point = [position[c] for c in tracked_ids]
        set_point = np.array([c.set_point or 0.0 for c in compartments])
        inverse_scale = 1.0 / np.array([c.scale for c in compartments])
        self._set_point = np.repeat(set_point[:, None], batch, axis=1)  # equal shapes are faster than a broadcast
        self._inverse_scale = np.repeat(inverse_scale[:, None], batch, axis=1)
        services = network.services
        self.service_factors: Floats = np.ones(len(services))
        self._masses = _measurement(network, services, layout)
        self._contents = np.flatnonzero([bool(service.substance) for service in services])
        wholes = [replace(services[s], substance="") for s in self._contents.tolist()]
        self._wholes = _measurement(network, wholes, layout)
        self._vary_in_time = any(isinstance(band, Series) for s in services for band in (s.low, s.high))
        width = network.episode.horizon if self._vary_in_time else 1
        bands = [[network.interval_means(getattr(s, end))[:width] for s in services] for end in ("low", "high")]
        self._low, self._high = (np.array(band).reshape(len(services), width) for band in bands)
        self._factors = [
            RowFactors({row: numbers[s.id] for row, s in enumerate(services) if s.id in numbers})
            for numbers in (numbers_of(ranges, "services", end) for end in ("low", "high"))
        ]
        self._has_high = bool(np.isfinite(self._high).any())
        with_model = [position[c.id] for c in compartments if c.model is not None]
        count = len(compartments)
        terms = count + len(services) + len(with_model)
        debts = [(position[d], count + i, s.weight) for i, s in enumerate(services) for d in s.debtors]
        inner = range(count + len(services), terms)
        owners = np.array([*with_set_point, *(owner for owner, _, _ in debts), *with_model], dtype=np.intp)
        columns = np.array([*with_set_point, *(term for _, term, _ in debts), *inner], dtype=np.intp)
        own, models = [1.0] * len(with_set_point), [-1.0] * len(with_model)
        weights = np.array([*own, *(weight for _, _, weight in debts), *models])
        self._by_compartment = RowSum(owners, columns, -weights, (len(compartments), terms))
        self._by_agent = self._by_compartment.select_rows([position[agent] for agent in agents])
        sums = self._by_compartment.column_sums()
        nonzero = np.flatnonzero(sums)
        self._total = RowSum(np.zeros(len(nonzero), dtype=np.intp), nonzero, sums[nonzero], (1, terms))
        rows, shape = range(len(services)), (1, len(services))
        self._weighted_shortfall = RowSum([0] * len(services), rows, [s.weight for s in services], shape)
        self._sum_of_levels = RowSum([0] * len(services), rows, 1.0, shape)

    def lack(self, quantities: Floats, step: Integers, factors: Floats | None = None) -> Floats:
        """Return what each service lacks of its lower end, relative to that, shape (services, B); negative: a surplus.

        It is 0 without a lower end; see ``levels``.
        """
        quantity, (low, _) = self._measure(quantities), self._bands(step, factors)
        ratio: Floats = np.divide(quantity, low, out=np.ones_like(quantity), where=low > 0)
        return 1.0 - ratio

    def levels(self, quantities: Floats, step: Integers, factors: Floats | None = None) -> Floats:
        """Return the level of each service in [0, 1], shape (services, B), in the interval ``step`` of each copy.

        ``factors`` are those on the numbers that are not certain, in that interval, shape (numbers, B), if any.
        """
        quantity, (low, high) = self._measure(quantities), self._bands(step, factors)
        level: Floats = np.divide(quantity, low, out=np.ones_like(quantity), where=low > 0)
        if len(self._contents):
            level[self._contents] = np.where(self._wholes(quantities) > NEGLIGIBLE, level[self._contents], 1.0)
        if self._has_high:
            np.divide(high, quantity, out=level, where=quantity > high)
        np.minimum(level, 1.0, out=level)
        return np.maximum(level, 0.0, out=level)

    def pull_back(
        self,
        quantities: Floats,
        step: Integers,
        factors: Floats | None,
        adjoint: Floats,
        factor_adjoint: Floats | None = None,
    ) -> Floats:
        """Return derivatives by the quantities, shape (quantities, B), of those by the ``levels``, (services, B).

        What they bring by the factors on bands is added to ``factor_adjoint``. At the end of a band the derivative is
        that from within, 0.
        """
        quantity, (low, high) = self._measure(quantities), self._bands(step, factors)
        is_above, is_below = quantity > high, (quantity < low) & (quantity >= 0)
        per_low = np.divide(adjoint, low, out=np.zeros_like(quantity), where=is_below)
        per_quantity = np.divide(adjoint, quantity, out=np.zeros_like(quantity), where=is_above)
        over = np.where(is_above, high / np.where(is_above, quantity, 1.0), 0.0)
        if factors is not None and factor_adjoint is not None:
            tables = (band.take(step, axis=1) if self._vary_in_time else band for band in (self._low, self._high))
            parts = np.divide(-per_low * quantity, low, out=np.zeros_like(quantity), where=is_below), per_quantity
            for scale, table, part in zip(self._factors, tables, parts, strict=True):
                scale.pull_back(np.where(np.isfinite(table), table, 0.0), part, factor_adjoint)
        by_measure = per_low - per_quantity * over
        if not len(self._contents):
            return self._masses.transpose()(by_measure)
        whole = self._wholes(quantities)
        by_part = np.divide(by_measure[self._contents], whole, out=np.zeros_like(whole), where=whole > NEGLIGIBLE)
        by_whole = -by_part * quantity[self._contents]
        by_measure[self._contents] = by_part
        by_quantity = self._masses.transpose()(by_measure)
        return self._wholes.transpose().add_to(by_quantity, by_whole)

    def _measure(self, quantities: Floats) -> Floats:
        """Return what each service measures, shape (services, B); a content is 0 where there is nothing."""
        quantity = self._masses(quantities)
        if len(self._contents):
            part, whole = quantity[self._contents], self._wholes(quantities)
            quantity[self._contents] = np.divide(part, whole, out=np.zeros_like(part), where=whole > NEGLIGIBLE)
        return quantity

    def _bands(self, step: Integers, factors: Floats | None) -> tuple[Floats, Floats]:
        low, high = self._low, self._high
        if self._vary_in_time:
            low, high = low.take(step, axis=1), high.take(step, axis=1)
        low, high = (scale(band, factors) for scale, band in zip(self._factors, (low, high), strict=True))
        return low, high

    def terms(self, quantities: Floats, levels: Floats, inner: Floats) -> Floats:
        """Return every squared scaled distance, service shortfall and model's reward, shape (terms, B)."""
        count, services = len(self._set_point), len(levels)
        terms = np.empty((count + services + len(inner), quantities.shape[1]))
        distance = terms[:count]
        np.subtract(quantities[:count], self._set_point, out=distance)
        distance *= self._inverse_scale
        distance *= distance
        np.multiply(1.0 - levels, self.service_factors[:, None], out=terms[count : count + services])
        terms[count + services :] = inner
        return terms

    def local(self, terms: Floats) -> Floats:
        """Return the local reward of each agent, shape (agents, B)."""
        return self._by_agent(terms)

    def local_of_all(self, terms: Floats) -> Floats:
        """Return the local reward of each compartment, nodes first, shape (nodes + arcs, B)."""
        return self._by_compartment(terms)

    def local_sum(self, terms: Floats) -> Floats:
        """Return the sum of the local rewards of all compartments, shape (B,)."""
        total: Floats = self._total(terms)[0]
        return total

    def shortfall(self, levels: Floats) -> Floats:
        """Return Σ_s factor_s · weight_s · (1 − level_s), shape (B,)."""
        total: Floats = self._weighted_shortfall((1.0 - levels) * self.service_factors[:, None])[0]
        return total

    def service_level(self, levels: Floats) -> Floats:
        """Return the mean level over the services, shape (B,); 1 for a network that owes none."""
        if len(levels) == 0:
            return np.ones(levels.shape[1])
        total: Floats = self._sum_of_levels(levels)[0]
        total /= len(levels)
        return total


def _measurement(network: Network, services: Sequence[Service], layout: ObservationLayout) -> RowSum:
    """Matrix that reads services off the quantities, with a substance its mass, shape (services, quantities)."""
    rows, columns, signals = [], [], layout.signals
    substances = {substance.id: part for substance, part in zip(network.substances, signals.contents, strict=True)}
    for row, service in enumerate(services):
        if service.quantity == "outflow":
            quantities = [signals.flows.start + int(k) for k in network.service_arcs(service)]
        else:
            quantities = [layout.row(c, service.quantity, service.measure) for c in service.providers]
        if service.substance:
            quantities = [substances[service.substance][place] for place in quantities]
        rows += [row] * len(quantities)
        columns += quantities
    return RowSum(rows, columns, 1.0, (len(services), signals.quantities))


class Credit:
    """Pays the agents by one of these rewards.

    With w the circularity weight and c the circularity scale of the network::

        circularity       λ
        difference        D = λ − λ had the agent been neutral, re-simulated from the same state
        local             r, the local reward
        mixed             w·λ/c + (1 − w)·r
        mixed_difference  w·D/c + (1 − w)·r
        team              w·λ/c − (1 − w)·Σ_s weight_s·shortfall_s over all services
        local_sum         the sum of the local rewards of all compartments, acting or not

    λ is that at the ``end`` of the interval or its ``mean`` over it, less T·Σ_a c_a·(what the interval books on account
    a, discounted), with the ``charges`` c and T intervals: so that their mean is λ̄ − Σ_a c_a·(total of a).

    Attributes:
        charges: c, mass per unit of the account, shape (accounts,), or (accounts, horizon) if they change in time.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        supply: Supply,
        scoring: Scoring,
        agents: Sequence[str],
        mode: str,
        measure: str,
    ) -> None:
        """Pay ``agents`` by ``mode``; ``measure`` is ``end`` or ``mean``."""
        self.mode, self._measure, self._supply = mode, measure, supply
        self._dynamics, self._scoring, self._agents = dynamics, scoring, tuple(agents)
        self.charges: Floats = np.zeros(len(dynamics.network.accounts))
        self.weigh(dynamics.network.objective.circularity_weight)

    def weigh(self, weight: float) -> None:
        """Pay by this weight of λ from now on."""
        self.weight, self._rest = weight, 1.0 - weight
        self._per_mass = weight / self._dynamics.network.objective.circularity_scale

    def circularity(self, state: State, transition: Transition, flow: Floats) -> tuple[Floats, Floats, Floats]:
        """Return λ at the end of the interval, its mean over the interval, and m_fb, shape (B,) each, mass.

        Batches that leave at the start of the interval count in its mean, those of its end do not.
        """
        network = self._dynamics.network
        if transition.batch_mass is None:
            return network.circularity(transition.flow), network.circularity(flow), state.batched
        at_start = state.batched + transition.batch_mass[0]
        at_end = at_start + transition.batch_mass[1]
        return network.circularity(transition.flow, at_end), network.circularity(flow, at_start), at_end

    def pay(
        self,
        end: Floats,
        mean: Floats,
        local: Floats,
        terms: Floats,
        levels: Floats,
        state: State,
        controls: Floats,
        amounts: Floats,
    ) -> Floats:
        """Return the reward of each agent, shape (agents, B).

        It may follow from λ at the ``end`` of the interval and its ``mean`` over it, what ``Scoring`` gives (``local``,
        ``terms``, ``levels``), the ``state`` at the start, the ``controls`` since, and the ``amounts`` on
        accounts, discounted, shape (accounts, B).

        Raises:
            CirlError: if the solver cannot follow what would have been, had an agent been neutral; names the agent.
        """
        if self.mode == "local":
            return local.copy()
        if self.mode == "local_sum":
            return self._same_for_all(self._scoring.local_sum(terms))
        credit = end if self._measure == "end" else mean
        if self.mode in ("difference", "mixed_difference"):
            credit = credit - self._counterfactuals(state, controls)
        if self.charges.any():
            charges = self.charges[:, None] if self.charges.ndim == 1 else self.charges.take(state.step, axis=1)
            credit = credit - self._dynamics.network.episode.horizon * (charges * amounts).sum(axis=0)
        if self.mode in ("mixed", "mixed_difference"):
            reward: Floats = local * self._rest
            reward += credit * self._per_mass
            return reward
        if self.mode == "team":
            credit = credit * self._per_mass - self._rest * self._scoring.shortfall(levels)
        return credit if self.mode == "difference" else self._same_for_all(credit)

    def _same_for_all(self, reward: Floats) -> Floats:
        return np.repeat(reward[None], len(self._agents), axis=0)

    def _counterfactuals(self, state: State, controls: Floats) -> Floats:
        """λ had each agent in turn been neutral, re-simulated from the same state, shape (agents, B)."""
        chunk = max(1, CELLS // max(state.stock.size + state.inner.size, state.flow.size))
        starts = range(0, len(self._agents), chunk)
        results = [self._with_neutral(self._agents[start : start + chunk], state, controls) for start in starts]
        return np.concatenate(results) if results else np.empty((0, controls.shape[1]))

    def _with_neutral(self, agents: Sequence[str], state: State, controls: Floats) -> Floats:
        """λ had each of ``agents`` in turn been neutral, all in one batch, shape (agents, B); errors name the agent."""
        try:
            return self._simulate_neutral(agents, state, controls)
        except CirlError as error:
            if len(agents) == 1:
                raise CirlError(f"with agent '{agents[0]}' neutral, for difference rewards: {error}") from error
        return np.concatenate([self._with_neutral([agent], state, controls) for agent in agents])

    def _simulate_neutral(self, agents: Sequence[str], state: State, controls: Floats) -> Floats:
        # column i·B + b is copy b in which agent i is neutral
        dynamics, count, batch = self._dynamics, len(agents), controls.shape[1]
        factors = dynamics.factors(state.factors, state.disturbances, state.step)
        counterfactual, neutral = np.tile(controls, (1, count)), dynamics.neutral_in(state.step, factors)
        idle = np.repeat(self._supply.idle(self._agents), count * batch, axis=1)
        for i, agent in enumerate(agents):
            rows, columns = dynamics.network.control_rows[agent], slice(i * batch, (i + 1) * batch)
            counterfactual[rows, columns] = neutral[rows]
            idle[[arc == agent for arc in self._supply.arcs], columns] = True
        stock, inner, step = np.tile(state.stock, count), np.tile(state.inner, count), np.tile(state.step, count)
        factors = None if factors is None else np.tile(factors, count)
        _, transition = self._supply.advance(stock, inner, counterfactual, step, idle, factors)
        flow = transition.moved_mass / dynamics.network.episode.control_interval
        end, mean, _ = self.circularity(replace(state, batched=np.tile(state.batched, count)), transition, flow)
        return (end if self._measure == "end" else mean).reshape(count, batch)
