"""Every simulated episode is a plan of the program: mean flows and stocks at the ends of intervals go together there.

An episode that the rows leave out may be above the bound of some aim. What moments within an interval are is left to
the program, so that networks of every kind can be tried, whatever their lifetimes, contents and orders.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog
from test_orders import certain, environment, possible
from test_program_rows import certifiable

from cirl_marl import Arc, Control, ControlKind, Episode, Law, MultiAgentVectorEnv, Network, Node, Role
from cirl_marl.network.elements import Lifetime
from cirl_marl.optimum import NoCertificate
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.program import Program, Programs

Floats = NDArray[np.float64]
ROUND_OFF = 1e-7
"""Part of the mass of an episode that programs may be away from it; errors that were planted came to 1e-4 and more."""
LARGE = 3000
"""Variables beyond which a program is left out: the simplex method takes seconds for it."""


def episode(env: MultiAgentVectorEnv, seed: int) -> tuple[Floats, Floats, Floats]:
    """Return stocks at the start, mean flows and stocks at the ends of intervals; half of the actions are extreme."""
    rng, network = np.random.default_rng(seed), env.network
    env.reset(seed=0)
    start, flows, ends = env.physical.stock[env.rows.nodes, 0].copy(), [], []
    for _ in range(network.episode.horizon):
        actions = rng.uniform(-1, 1, (len(env.actuators.control_rows), 1))
        outcome = env.advance(np.where(rng.random(actions.shape) < 0.5, actions, np.sign(actions)))
        flows.append(outcome.flow[:, 0])
        ends.append(env.rows.stocks(env.physical.stock)[: len(network.stores), 0])
    return start, np.array(flows), np.array(ends)


def distance(programs: Programs, start: Floats, flows: Floats, ends: Floats) -> float:
    """Return how far a plan has to be from an episode, in part of its mass, to satisfy all rows and boxes."""
    problem, layout, lifetimes = programs.program(start), programs.layout, programs.admissible.lifetimes
    steps, plan_network, interval = len(flows), lifetimes.plan_network, lifetimes.network.episode.control_interval
    arcs, stores, shape = len(plan_network.arcs), len(plan_network.stores), layout.size
    mean = sum(sparse.eye_array(arcs, shape, k=first) for first in layout.flow.tolist()) * (1 / len(layout.moments))
    end = sparse.eye_array(stores, shape, k=layout.last.start)
    each = sparse.vstack([lifetimes.arc_sums @ mean * interval, lifetimes.totals @ end])
    mass = float(start.sum() + flows.sum() * interval) or 1.0
    subjects = np.concatenate([flows * interval, ends], axis=1).ravel() / mass
    return _least_distance(problem, sparse.kron(sparse.eye_array(steps), each) / mass, subjects)


def _least_distance(problem: Program, measures: sparse.sparray, values: Floats) -> float:
    size = np.maximum(np.maximum(np.abs(problem.low), np.abs(problem.high)), 1e-200)
    scale, apart = sparse.diags_array(size), np.ones((len(values), 1))

    def in_units(matrix: sparse.sparray, limits: Floats) -> tuple[sparse.sparray, Floats]:
        rows = sparse.csr_array(matrix @ scale)
        largest = abs(rows).max(axis=1).toarray().ravel()
        unit = 1.0 / np.where(largest > 0, largest, 1.0)
        return sparse.hstack([sparse.diags_array(unit) @ rows, sparse.csr_array((len(limits), 1))]), limits * unit

    equal, equal_to = in_units(problem.equal, problem.equal_to)
    under, under_to = in_units(problem.under, problem.under_to)
    measures = measures @ scale
    near = [sparse.hstack([sign * measures, -apart]) for sign in (1.0, -1.0)]
    result = linprog(
        np.append(np.zeros(len(size)), 1.0),
        A_ub=sparse.vstack([under, *near], format="csr"),
        b_ub=np.concatenate([under_to + 1e-9, values, -values]),
        A_eq=equal.tocsr(),
        b_eq=equal_to,
        bounds=np.stack([np.append(problem.low / size, 0.0), np.append(problem.high / size, 2.0)], axis=1),
        options={"primal_feasibility_tolerance": 1e-9},
    )
    return float(result.fun) if result.status == 0 else np.inf


def assert_is_plan(env: MultiAgentVectorEnv, seed: int, degree: int, merged: bool, steady_parts: bool) -> None:
    """An episode is one, but for rounding."""
    admissible = Admissible.of(env.network, env.agents)
    programs = Programs(admissible, degree, None, merge_pieces=merged, steady_parts=steady_parts)
    if programs.layout.size * env.network.episode.horizon <= LARGE:
        assert distance(programs, *episode(env, seed)) <= ROUND_OFF


ways = {"degree": st.integers(1, 2), "merged": st.booleans(), "steady_parts": st.booleans()}


@pytest.mark.slow
@given(network=st.from_type(Network), interval=st.floats(0.02, 3.0), seed=st.integers(0, 1000), **ways)
def test_random_networks(
    network: Network, interval: float, seed: int, degree: int, merged: bool, steady_parts: bool
) -> None:
    """With lifetimes, contents, shares, valves, series and capacities."""
    env = MultiAgentVectorEnv(certifiable(network, interval, pulls=False), num_envs=1)
    try:
        assert_is_plan(env, seed, degree, merged, steady_parts)
    except NoCertificate:
        assume(False)


@pytest.mark.slow
@given(market=st.integers(0, 2**31), beside=st.booleans(), seed=st.integers(0, 1000), **ways)
def test_markets(market: int, beside: bool, seed: int, degree: int, merged: bool, steady_parts: bool) -> None:
    """With orders that are cut, and supplies beside them."""
    assert_is_plan(environment(certain(possible(market, beside)), 1), seed, degree, merged, steady_parts)


@pytest.mark.sample(4)
@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize(("mean", "deviation"), [(10.0, 10.0), (4.0, 6.0), (2.0, 0.6)])
@pytest.mark.parametrize("is_stretched", [False, True])
def test_what_enters_a_life_may_fall_at_once(mean: float, deviation: float, is_stretched: bool, merged: bool) -> None:
    """And so may what leaves it at once, of which a share is to stay the same; however a life is stretched."""
    share = Control(kind=ControlKind.SHARE, low=0.1, neutral=0.5, high=0.9)
    stretch = Control(kind=ControlKind.STRETCH, low=0.8, neutral=1.0, high=1.5)
    life = Lifetime(mean=mean, deviation=deviation, distribution="normal")
    nodes = (
        Node(id="store", initial=(100.0, 100.0), rate=5.0),
        Node(id="use", initial=(5.0, 5.0), lifetime=life, control=stretch if is_stretched else None),
        Node(id="sorting", stores=False),
        Node(id="scrap", initial=(0.0, 0.0)),
        Node(id="tip", role=Role.LANDFILL),
    )
    arcs = (
        Arc(id="sale", donor="store", recipient="use", law=Law.SHARE),
        Arc(id="old", donor="use", recipient="sorting", law=Law.SHARE),
        Arc(id="recovery", donor="sorting", recipient="scrap", law=Law.SHARE, control=share),
        Arc(id="rest", donor="sorting", recipient="tip", law=Law.SHARE),
    )
    network = Network(name="yard", nodes=nodes, arcs=arcs, time_unit="year", episode=Episode(horizon=3))
    for seed in range(2):
        for steady_parts in (False, True):
            assert_is_plan(MultiAgentVectorEnv(network, num_envs=1), seed, 2, merged, steady_parts)
