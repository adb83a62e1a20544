"""What fits food_bank alone: the best that can be done by who sees all of the present, and MPC with a safety stock.

The best is found by dynamic programming. What is in store decays by a factor δ in an interval, and what comes can be
served from the next one on. So the state is what can be served, y = δ·stock/κ with κ the part of a steady inflow that
is left at its end, what is on the way, the regime of the surplus, and the latent value z of the guests. Where r = y −
served + on the way + collected there are κ·r in store at the end, and δ·r to serve in the next interval. What spoils
is what came in less what was served and what is left. Interpolation between points of a grid is the only
approximation: tests/test_food_bank.py holds what is expected against episodes of the simulator.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from cirl_marl import MultiAgentVectorEnv, Network
from cirl_marl.controllers import Controller
from cirl_marl.controllers.basic import Arrays
from cirl_marl.network import Floats, Integers
from cirl_marl.network.disturbances import Gaussian, Markov
from cirl_marl.optimum.mpc import MPC

STEP, MOST = 0.5, 130.0
"""Distance between points of a mass, and the last of them, t."""
LATENT = np.linspace(-4.0, 4.0, 33)
"""Points of z."""
NODES = 15
"""Of the Gauss–Hermite rule for the noise of z."""
SHARES = np.linspace(0.0, 1.0, 11)
"""Parts of the surplus of which the best is collected."""
PRICE, NORMAL = 70.0, 0.75
"""Of a level of service of 1, t, and standard deviations in reserve, both at a margin of 1."""


class BestOrders(Controller):
    """Orders, collects and serves what makes λ̄ + price·level largest in expectation."""

    def __init__(self, network: Network, margin: float = 1.0) -> None:
        """Solve the program for ``food_bank`` in its scenario; the margin is that on the price."""
        arcs = {arc.id: arc for arc in network.arcs}
        (surplus, guests), control = network.processes.disturbances, arcs["ordering"].control
        assert isinstance(surplus, Markov) and isinstance(guests, Gaussian) and control is not None
        numbers = (arcs["spoilt"].rate, control.high, network.services[0].low, arcs["set_aside"].flow)
        rate, high, wanted, flow = (float(network.interval_means(number)[0]) for number in numbers)
        self.price, self._steps, self._matrix = margin * PRICE, network.episode.horizon, np.array(surplus.matrix)
        self._kept = math.exp(-rate)
        self._part = (1.0 - self._kept) / rate
        self._masses = np.arange(0.0, MOST + STEP, STEP)
        self._amounts = np.arange(0.0, high + STEP, STEP)
        latent = np.stack([np.zeros(len(LATENT)), LATENT])
        self._usual = wanted
        self._wanted = wanted * network.processes.values(latent, 0)[1]
        self._surplus = flow * np.array(surplus.values)
        self._moves = _moves(*guests.memory)
        self._stores = [node.id for node in network.stores]
        self._left, self._remaining, self._orders = self._solved()

    def _solved(self) -> tuple[list[Floats], list[Floats], list[Floats]]:
        """Return for every interval the value of y − served + on the way, that of r, and what is ordered at r.

        Each has shape (regimes, latent values, masses).
        """
        left, remaining, orders = list[Floats](), list[Floats](), list[Floats]()
        value = np.tile(self._part * self._masses, (len(self._surplus), len(LATENT), 1))  # spoils after the end
        amount = np.zeros(value.shape)
        for _ in range(self._steps):
            if left:
                gain = self._expected(left[0]) - 2.0 * self._amounts  # as it is bought, and as it comes in
                value, amount = gain.max(axis=3), self._amounts[gain.argmax(axis=3)]
            collected = SHARES[:, None] * self._surplus
            sums = [
                (_at(value[regime], self._masses + row[:, None]) - row[:, None]).max(axis=1)
                for regime, row in enumerate(collected.T)
            ]
            left.insert(0, np.stack(sums))
            remaining.insert(0, value)
            orders.insert(0, amount)
        return left, remaining, orders

    def _expected(self, left: Floats) -> Floats:
        """Return what is expected of the next interval, shape (regimes, latent values, r, orders)."""
        ready = self._kept * self._masses
        value = np.empty((*left.shape, len(self._amounts)))
        for n, wanted in enumerate(self._wanted):
            served = np.minimum(ready, wanted)
            gain = served * (1.0 + self.price / wanted)
            value[:, n] = _at(left[:, n], (ready - served)[:, None] + self._amounts) + gain[:, None]
        value = np.tensordot(self._matrix, value, axes=1)
        return np.asarray(np.moveaxis(np.tensordot(self._moves, value, axes=(1, 1)), 0, 1))

    def expected(self, env: MultiAgentVectorEnv) -> Floats:
        """Return what is expected of λ̄ + price·level in the episodes that begin in ``env``, shape (B,)."""
        store, coming, regime, place, wanted = self._state(env)
        ready = self._kept / self._part * store
        served = np.minimum(ready, wanted)
        rest = _looked_up(self._left[0], regime, place, ready - served + coming)
        return (served * (1.0 + self.price / wanted) + rest - store - coming) / self._steps

    def _state(self, env: MultiAgentVectorEnv) -> tuple[Floats, Floats, Integers, Floats, Floats]:
        """Return what is in store and on the way, the regime, the place of z among its points, and what is wanted."""
        step = int(env.physical.step[0])
        states = env.physical.processes[step]
        stocks = env.rows.stocks(env.physical.stock)
        place = np.interp(states[1], LATENT, np.arange(len(LATENT)))
        wanted = self._usual * env.network.processes.values(states, step)[1]
        store, coming = (stocks[self._stores.index(id_)] for id_ in ("store", "on_the_way"))
        return store, coming, states[0].astype(np.intp), place, wanted

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Take the environment; nothing is random."""
        self._env = env

    def act(self, observations: Arrays) -> Arrays:
        """Return what is best in the present state."""
        store, coming, regime, place, wanted = self._state(self._env)
        step, ready = int(self._env.physical.step[0]), self._kept / self._part * store
        served = np.minimum(ready, wanted)
        collected = SHARES[:, None] * self._surplus[regime]
        left = ready - served + coming + collected
        values = np.stack([_looked_up(self._remaining[step], regime, place, row) for row in left]) - collected
        best = values.argmax(axis=0)
        order = _looked_up(self._orders[step], regime, place, left[best, np.arange(len(best))])
        amounts = {"ordering": order, "collecting": SHARES[best], "serving": served}
        return {agent: self._env.normalise(agent, amount[None]) for agent, amount in amounts.items()}


class SafetyStock(Controller):
    """MPC whose reserve for the days to come is so many standard deviations of what is wanted less what is set aside.

    The deviation is that of the next interval, and follows the regime.
    """

    def __init__(self, network: Network, options: Mapping[str, Any], margin: float = 1.0) -> None:
        """Take the network, options of ``MPC``, and the number of deviations in parts of NORMAL."""
        surplus, guests = network.processes.disturbances
        assert isinstance(surplus, Markov) and isinstance(guests, Gaussian)
        numbers = (network.arcs[network.arc_index["set_aside"]].flow, network.services[0].low)
        flow, wanted = (float(network.interval_means(number)[0]) for number in numbers)
        matrix, values = np.array(surplus.matrix), np.array(surplus.values)
        variance = matrix @ values**2 - (matrix @ values) ** 2
        deviations = np.hypot(flow / wanted * np.sqrt(variance), guests.deviation * guests.memory[1])
        kinds, self._kind = np.unique(deviations.round(9), return_inverse=True)
        self._planners = [MPC(reserve=1.0 + NORMAL * margin * kind, **options) for kind in kinds]

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Start a planner for every deviation."""
        self._env = env
        for planner in self._planners:
            planner.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return in each copy what the planner for its regime does."""
        regimes = self._env.physical.processes[int(self._env.physical.step[0])][0].astype(np.intp)
        plans = [planner.act(observations) for planner in self._planners]
        copies = np.arange(len(regimes))
        return {agent: np.stack([plan[agent] for plan in plans])[self._kind[regimes], copies] for agent in plans[0]}


def _moves(memory: float, noise: float) -> Floats:
    """Return the probabilities of z's points in the next interval, by those in this one."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    places = np.interp(memory * LATENT[:, None] + noise * nodes, LATENT, np.arange(len(LATENT)))
    moves, lower = np.zeros((len(LATENT), len(LATENT))), np.minimum(places.astype(np.intp), len(LATENT) - 2)
    rows = np.broadcast_to(np.arange(len(LATENT))[:, None], places.shape)
    weights = np.broadcast_to(weights / weights.sum(), places.shape)
    np.add.at(moves, (rows, lower), weights * (1.0 - (places - lower)))
    np.add.at(moves, (rows, lower + 1), weights * (places - lower))
    return moves


def _at(values: Floats, masses: Floats) -> Floats:
    """Return values between the points of their last axis, shape (..., *masses.shape)."""
    place = np.minimum(masses, MOST) / STEP
    lower = np.minimum(place.astype(np.intp), values.shape[-1] - 2)
    upper = place - lower
    return np.asarray(values[..., lower] * (1.0 - upper) + values[..., lower + 1] * upper)


def _looked_up(values: Floats, regime: Integers, place: Floats, masses: Floats) -> Floats:
    """Return the value of each copy, shape (B,), in a table of regimes, latent values and masses."""
    lower, copies = np.minimum(place.astype(np.intp), len(LATENT) - 2), np.arange(len(place))
    upper = (place - lower)[:, None]
    rows = values[regime, lower] * (1.0 - upper) + values[regime, lower + 1] * upper
    return np.asarray(_at(rows, masses)[copies, copies])
