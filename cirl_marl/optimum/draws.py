"""What episodes of an uncertain network draw, and the program of one draw under a penalty on foresight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np

from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.innovations import innovations
from cirl_marl.network.substances import CONTENT
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.aims import NO_AIMS, Aims, account_rows
from cirl_marl.optimum.certificate import Certificate, verify
from cirl_marl.optimum.options import by_stage
from cirl_marl.optimum.program import Program, Programs
from cirl_marl.optimum.solver import Basis, Infeasible, SolverFailure, solve
from cirl_marl.optimum.stock_values import stock_values
from cirl_marl.optimum.vintages import LOOSE

LARGE_DRAW = 10_000
"""Variables of a draw's program beyond which substeps are merged: it is solved under many prices, each of many draws.

In copper_world and carbo_net HiGHS then needs 0.5 and 5 s, not 6 and 22, for bounds 0.2 % tighter and 0.6 % looser.
"""
MEMORIES = (0.7, 0.95)
"""Shares of means of the past that are left after an interval."""


@positional_record
class Draw:
    """One future: all that an episode draws."""

    network: Annotated[Network, "what is certain then: its own rates, shares, demands and lifetimes"]
    initial: Annotated[Floats, "stocks at the start, those with a lifetime by stage, mass"]
    features: Annotated[Floats, "functions φ(s_t) of the states of the disturbances, shape (steps, functions)"]
    new: Annotated[Floats, "φ(s_{t+1}) less its mean given F_t, shape (steps − 1, functions)"]


def draws_of(env: MultiAgentVectorEnv, initial: Floats | None = None) -> list[Draw]:
    """Return what the episodes in the copies of an environment draw; with ``initial`` all start from there.

    Where contents are drawn, ``initial`` says the mass of each stock alone.
    """
    state, last = env.physical, env.network.episode.horizon
    processes = env.network.processes
    parts = innovations(processes, state.processes[:last] if processes.names else np.empty((last, 0, env.num_envs)))
    starts = state.stock[env.rows.nodes].T.copy()
    networks = [env.certain_network(i) for i in range(env.num_envs)]
    if initial is not None:
        starts[:] = initial
    if initial is not None and any(f".{CONTENT}" in path for path in env.network.uncertain):
        masses = env.rows.stocks(initial[:, None])[:, 0]
        starts = np.array([by_stage(network, env.rows, masses) for network in networks])
    return [
        Draw(network, start, parts.features[..., i], parts.new[..., i])
        for i, (network, start) in enumerate(zip(networks, starts, strict=True))
    ]


@positional_record
class Prices:
    """What takes the use out of foresight: prices on stocks by what is new, and on the services.

    The price on what a stock differs from what was to be expected of it at the start of interval t + 1 is Σ_f
    θ_tf·(φ_f(s_{t+1}) − E[φ_f(s_{t+1}) | F_t]), with θ linear in t between knots. As what was to be expected follows
    from F_t, it changes no mean; it spares the means of draws their noise.
    """

    stock: Annotated[Floats, "θ at the knots, shape (knots, stores, functions), objective/mass"]
    reference: Annotated[Floats, "what is expected of stocks but for disturbances, shape (steps − 1, stores), mass"]
    response: Annotated[Floats, "what past disturbances add to it, of ``past_of`` them, shape (functions', stores)"]
    service: Annotated[
        Floats,
        "μ ≥ 0 of the mean level of each service, and of minus what is booked of each budget, in parts of it, shape "
        "(services + budgets,)",
    ]
    demand: Annotated[Floats, "what is expected of each at least, likewise"]
    shocks: Annotated[Floats, "κ, what is new adds to a draw, at start and end, shape (2, functions), objective"]

    def weights(self, new: Floats) -> Floats:
        """Return the price on each stock at the start of intervals 1, 2, …, shape (steps − 1, stores).

        Args:
            new: what is new in a draw, shape (steps − 1, functions).
        """
        at_knots = np.einsum("knf,tf->tkn", self.stock, new)
        return np.asarray(np.einsum("tk,tkn->tn", knot_weights(len(new), len(self.stock)), at_knots))

    def expected_stocks(self, features: Floats) -> Floats:
        """Return what is expected of stocks at the start of intervals 1, 2, …, shape (steps − 1, stores), mass."""
        return np.asarray(self.reference + past_of(features) @ self.response)

    def luck(self, new: Floats) -> float:
        """Return Σ_t κ_t·(what is new in t + 1), κ linear in t: of mean 0, it follows what a draw by itself is worth.

        Taken off what is proved of draws it narrows the interval of their mean (a control variate).

        References: Glasserman 2004, Monte Carlo Methods in Financial Engineering, section 4.1.
        """
        return float((shocks(new) * self.shocks).sum())

    def service_value(self, levels: Floats) -> Floats:
        """Return Σ_s μ_s (level_s − demand_s) of mean levels, those of budgets included, (..., services + budgets)."""
        return np.asarray((levels - self.demand) @ self.service)


def past_of(features: Floats) -> Floats:
    """Return what is known of disturbances in t, for t = 0 … steps − 2: φ(s_t), and means of it that forget.

    Args:
        features: φ(s_t), shape (steps, functions).

    Returns:
        Shape (steps − 1, 3·functions).
    """
    latest, means = features[:-1], [features[:-1]]
    for memory in MEMORIES:
        mean = np.zeros_like(latest)
        for t, now in enumerate(latest):
            mean[t] = now if t == 0 else memory * mean[t - 1] + (1 - memory) * now
        means.append(mean)
    return np.concatenate(means, axis=1)


def shocks(new: Floats) -> Floats:
    """Return the sums over time of what is new, weighted with 1 falling to 0, and the opposite, (2, functions)."""
    return np.asarray(knot_weights(len(new), 2).T @ new)


def knot_weights(steps: int, knots: int) -> Floats:
    """Return how much each of some evenly spaced knots counts in each step, shape (steps, knots)."""
    place = np.linspace(0.0, knots - 1.0, steps) if knots > 1 else np.zeros(steps)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(knots)))


@positional_record
class DrawProof:
    """What is proved of a draw."""

    value: Annotated[float, "what no actions exceed there, penalty included"]
    certificate: Certificate
    plan: Annotated[Floats | None, "the variables of the program; None if nothing solved it"]
    basis: Annotated[Basis | None, "from which the program under other prices may be solved"]


class DrawProgram:
    """The program of a draw: its own rows, boxes and kernels; prices change its costs alone."""

    def __init__(
        self,
        draw: Draw,
        agents: Sequence[str] | None,
        degree: int,
        service_weight: float | None = None,
        *,
        aims: Aims = NO_AIMS,
    ) -> None:
        """Write the rows down; of ``aims`` the budgets count, which are no rows but have prices.

        Raises:
            NoCertificate: for a network whose flows are not linear laws.
        """
        admissible = Admissible.of(draw.network, agents)
        self.draw, self.aims, lifetimes = draw, aims, admissible.lifetimes
        self._totals = lifetimes.totals
        self._programs = Programs(
            admissible, degree, service_weight, constant_shares=False, large=LARGE_DRAW, loose=LOOSE
        )
        self.problem = self._programs.program(draw.initial)
        self.layout = self.problem.layout
        self.bookings = account_rows(lifetimes, self.layout, draw.initial, aims.rates(lifetimes.network))

    def with_prices(self, prices: Prices) -> Program:
        """Return the program under ``prices``."""
        weights = prices.weights(self.draw.new)
        return self.with_weights(weights, float((weights * prices.expected_stocks(self.draw.features)).sum()), prices)

    def with_weights(self, weights: Floats, constant: float, prices: Prices) -> Program:
        """Return the program with ``weights`` on stocks at the start of intervals 1, 2, …, shape (steps − 1, stores).

        ``constant`` is what the objective has more, beside what the demand on services costs.
        """
        problem, layout = self.problem, self.layout
        cost = problem.cost.reshape(-1, layout.size).copy()
        cost[:-1, layout.last] += weights @ self._totals
        services = layout.imbalance - layout.level
        cost[:, layout.level : layout.imbalance] -= prices.service[:services] / len(cost)
        constant = problem.constant + constant - float(prices.service @ prices.demand)
        (rows, beside), by_amount = self.bookings, prices.service[services:] / self.aims.sizes
        return replace(problem, cost=cost.ravel() + by_amount @ rows, constant=constant - float(by_amount @ beside))

    def prove(self, problem: Program, basis: Basis | None = None, substitutes: Sequence[Certificate] = ()) -> DrawProof:
        """Solve the program under some prices, and return what its multipliers prove.

        Where the solver fails, the best of what ``substitutes`` prove here, or no multipliers at all, takes the place.
        ``basis`` may be that of another draw, if its program has as many rows.
        """
        if basis is not None and (len(basis.columns), len(basis.rows)) != self._size:
            basis = None
        try:
            solution = solve(problem, basis, label="the program of a draw", same_rows=basis is not None)
        except (SolverFailure, Infeasible):
            certificates = [self.no_multipliers, *(item for item in substitutes if self._fits(item))]
            proofs = [verify(problem, certificate, np.zeros(len(problem.cost))).bound for certificate in certificates]
            best = int(np.argmin(proofs))
            return DrawProof(proofs[best], certificates[best], None, None)
        value = verify(problem, solution.certificate, solution.plan).bound
        return DrawProof(value, solution.certificate, solution.plan, solution.basis)

    @property
    def _size(self) -> tuple[int, int]:
        """Variables and rows."""
        return len(self.problem.cost), len(self.problem.equal_to) + len(self.problem.under_to)

    @property
    def no_multipliers(self) -> Certificate:
        """Multipliers 0 of all rows, which prove what the boxes allow."""
        return Certificate(equal=np.zeros(len(self.problem.equal_to)), under=np.zeros(len(self.problem.under_to)))

    def _fits(self, certificate: Certificate) -> bool:
        sizes = len(self.problem.equal_to), len(self.problem.under_to)
        return (len(certificate.equal), len(certificate.under)) == sizes

    def stocks(self, plan: Floats) -> Floats:
        """Return the stocks at the start of intervals 1, 2, … under a plan, shape (steps − 1, stores), mass."""
        ends = plan.reshape(-1, self.layout.size)[:-1, self.layout.last]
        return np.asarray(ends @ self._totals.T)

    def levels(self, plan: Floats) -> Floats:
        """Return mean levels under a plan, as ``Prices.service`` has them, shape (services + budgets,)."""
        layout, (rows, beside) = self.layout, self.bookings
        levels = plan.reshape(-1, layout.size)[:, layout.level : layout.imbalance].mean(axis=0)
        return np.append(levels, -(rows @ plan + beside) / self.aims.sizes)

    def stock_values(self, certificate: Certificate) -> Floats:
        """Return what a mass more in a stock at the start of intervals 1, 2, … is worth, shape (steps − 1, stores)."""
        return stock_values(self._programs, self.problem, certificate)[1:]
