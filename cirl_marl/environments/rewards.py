"""Who is paid what for the circularity of a step: the team's reward, local rewards, and each agent's difference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cirl_marl.dynamics.integrator import Dynamics, Transition
from cirl_marl.dynamics.supply import Supply
from cirl_marl.environments.scoring import Scoring
from cirl_marl.environments.state import State
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats

CIRCULARITY_REWARDS = ("mixed", "mixed_difference", "team")
"""Rewards in which λ has a weight, and so services a price."""

CELLS = 4_000_000
"""Largest number of stocks and inner states that difference rewards re-simulate at once."""


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

    λ is that at the ``end`` of the interval or its ``mean`` over it.
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
        self, end: Floats, mean: Floats, local: Floats, terms: Floats, levels: Floats, state: State, controls: Floats
    ) -> Floats:
        """Return the reward of each agent, shape (agents, B).

        It may follow from λ at the ``end`` of the interval and its ``mean`` over it, what ``Scoring`` gives (``local``,
        ``terms``, ``levels``), the ``state`` at the start and the ``controls`` since.

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
        counterfactual, neutral = np.tile(controls, (1, count)), dynamics.neutral_in(state.step)
        idle = np.repeat(self._supply.idle(self._agents), count * batch, axis=1)
        for i, agent in enumerate(agents):
            rows, columns = dynamics.network.control_rows[agent], slice(i * batch, (i + 1) * batch)
            counterfactual[rows, columns] = neutral[rows]
            idle[[arc == agent for arc in self._supply.arcs], columns] = True
        stock, inner, step = np.tile(state.stock, count), np.tile(state.inner, count), np.tile(state.step, count)
        factors = None if state.factors_if_any is None else np.tile(state.factors, count)
        counterfactual = self._supply(stock, inner, counterfactual, step, idle, factors)
        transition = dynamics.advance(stock, inner, counterfactual, step, factors)
        flow = transition.moved_mass / dynamics.network.episode.control_interval
        end, mean, _ = self.circularity(replace(state, batched=np.tile(state.batched, count)), transition, flow)
        return (end if self._measure == "end" else mean).reshape(count, batch)
