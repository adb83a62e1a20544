"""The bound for who does not foresee, against all paths at once, dynamic programs, policies, and planted mistakes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from disturbed_line import line
from numpy.typing import NDArray
from scipy import optimize, sparse
from small_networks import CORRELATION, KINDS
from test_lifetimes import LIVES, town
from test_optimum import certifiable

from cirl_marl import (
    Arc,
    CirlError,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    NetworkError,
    Node,
    Role,
    Service,
    bound,
    load_network,
)
from cirl_marl.controllers import Constant, Controller, Neutral, Random
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.evaluation import compare
from cirl_marl.network.disturbances import BlockBootstrap, DisturbanceEffect, Gaussian, Markov
from cirl_marl.network.elements import Lifetime
from cirl_marl.network.innovations import innovations
from cirl_marl.network.uncertainty import Spread, draw_network, expected_network
from cirl_marl.optimum import NoCertificate, draws, price_fit, uncertain_bound
from cirl_marl.optimum.aims import NO_AIMS, Aims
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.draws import Draw, DrawProgram, DrawProof, Prices
from cirl_marl.optimum.mpc import MPC
from cirl_marl.optimum.price_fit import KNOTS, PriceTrial, Sample, fit_prices, improve
from cirl_marl.optimum.solver import SolverFailure, solve

Floats = NDArray[np.float64]
CHAIN = Markov(values=(1.0, 0.3), matrix=((0.7, 0.3), (0.4, 0.6)))
DEMAND = 0.8


def works(horizon: int, chain: Markov = CHAIN) -> Network:
    """Return a plant that stands still now and then, between a mine and products that are to be kept in use."""

    def valve(low: float, high: float) -> Control:
        return Control(kind=ControlKind.RATE, low=low, neutral=1.0, high=high)

    return Network(
        name="works",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(50.0, 50.0)),
            Node(id="plant", initial=(4.0, 4.0)),
            Node(id="use", initial=(10.0, 10.0)),
            Node(id="scrap", initial=(2.0, 2.0)),
            Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="dig", donor="mine", recipient="plant", rate=0.04, control=valve(0.0, 2.0)),
            Arc(id="make", donor="plant", recipient="use", rate=0.5, control=valve(0.2, 1.2)),
            Arc(id="discard", donor="use", recipient="scrap", rate=0.3),
            Arc(id="melt", donor="scrap", recipient="plant", rate=0.6, control=valve(0.2, 1.0)),
            Arc(id="lose", donor="scrap", recipient="tip", rate=0.2, control=valve(0.5, 1.5)),
        ),
        services=(Service(id="served", provider="use", quantity="stock", low=10.0),),
        episode=Episode(horizon=horizon),
        disturbances={"outage": chain},
        disturbed={f"arcs.{id_}.rate": DisturbanceEffect(by="outage") for id_ in ("make", "melt")},
    )


@dataclass(frozen=True)
class Paths:
    """Every path that the disturbances of a network can take, with its probability and its program."""

    chance: Floats
    regimes: NDArray[np.intp]
    programs: tuple[DrawProgram, ...]

    @classmethod
    def of(cls, network: Network, degree: int = 1, aims: Aims = NO_AIMS) -> Paths:
        """Write them all down; one chain disturbs the network."""
        (chain,) = network.processes.disturbances
        assert isinstance(chain, Markov)
        start = chain.stationary if chain.start is None else np.eye(len(chain.values))[chain.start - 1]
        matrix, start_stocks = chain.transitions, network.initial.mean(axis=0)
        chances, regimes, programs = [], [], []
        for path in product(range(len(chain.values)), repeat=network.episode.horizon):
            chance = start[path[0]] * np.prod([matrix[i, j] for i, j in pairwise(path)])
            if chance > 0:
                states = np.array(path, dtype=float)[:, None, None]
                parts = innovations(network.processes, states)
                certain = draw_network(network, (), np.array(chain.values)[list(path)][:, None])
                draw = Draw(certain, start_stocks, parts.features[..., 0], parts.new[..., 0])
                chances.append(chance)
                regimes.append(path)
                programs.append(DrawProgram(draw, None, degree, aims=aims))
        return cls(np.array(chances), np.array(regimes), tuple(programs))

    def groups(self, until: int) -> Iterator[NDArray[np.intp]]:
        """Yield which paths are the same up to an interval, that one included."""
        _, group = np.unique(self.regimes[:, : until + 1], axis=0, return_inverse=True)
        for k in range(int(group.max()) + 1):
            yield np.flatnonzero(group.ravel() == k)

    def best(self, demand: float, *, states_only: bool = False) -> tuple[float, list[Floats], Floats]:
        """Return the most that anybody reaches on average who does not foresee, the extensive form; and multipliers.

        Every path has variables of its own; all of an interval, or with ``states_only`` the stocks at its end, are the
        same on paths that were the same up to then.

        Returns:
            The optimum, the multipliers of the stocks at the start of intervals 1, 2, … on each path, per probability,
            and those of the demand and of budgets, in parts of these.
        """
        aims, pairs = self.programs[0].aims, [program.bookings for program in self.programs]
        booked = sparse.hstack([p * row for p, (row, _) in zip(self.chance, pairs, strict=True)], format="csr")
        left = aims.limits - self.chance @ np.array([beside for _, beside in pairs])
        problems = [program.problem for program in self.programs]
        layout, count = problems[0].layout, len(problems[0].cost)
        steps, width = count // layout.size, count * len(problems)
        cost = np.concatenate([p * problem.cost for p, problem in zip(self.chance, problems, strict=True)])
        equal = sparse.block_diag([problem.equal for problem in problems], format="csr")
        under = sparse.block_diag([problem.under for problem in problems], format="csr")
        level = np.zeros((len(problems), steps, layout.size))
        level[:, :, layout.level] = -self.chance[:, None] / steps
        rows, keys = [], []
        for t in range(steps - 1 if states_only else steps):
            columns = np.arange(layout.last.start, layout.last.stop) if states_only else np.arange(layout.size)
            for group in self.groups(t):
                for i in group[1:]:
                    for column in columns:
                        row = np.zeros(2), np.array([i * count, group[0] * count]) + t * layout.size + column
                        rows.append(sparse.csr_array((np.array([1.0, -1.0]), row), shape=(1, width)))
                        keys.append((int(i), int(group[0]), t, int(column - columns[0])))
        solution = optimize.linprog(
            cost,
            A_ub=sparse.vstack([under, sparse.csr_array(level.reshape(1, -1)), booked], format="csr"),
            b_ub=np.concatenate([*(problem.under_to for problem in problems), [-demand], left]),
            A_eq=sparse.vstack([equal, *rows], format="csr"),
            b_eq=np.concatenate([*(problem.equal_to for problem in problems), np.zeros(len(rows))]),
            bounds=np.stack([np.concatenate([getattr(p, end) for p in problems]) for end in ("low", "high")], axis=1),
            method="highs",
        )
        assert solution.status == 0, solution.message
        weights = [np.zeros((steps - 1, layout.last.stop - layout.last.start)) for _ in problems]
        if states_only:
            for (i, j, t, n), y in zip(keys, solution.eqlin.marginals[-len(rows) :], strict=True):
                # marginal y of x_i − x_j = 0: the Lagrangian of the costs has −y·(x_i − x_j)
                weights[i][t, n] -= y / self.chance[i]
                weights[j][t, n] += y / self.chance[j]
        return -float(solution.fun), weights, -solution.ineqlin.marginals[under.shape[0] :] * np.append(1.0, aims.sizes)

    def mean(self, prices: Prices) -> float:
        """Return the mean over all paths of what is proved under prices."""
        values = [program.prove(program.with_prices(prices)).value for program in self.programs]
        return float(self.chance @ np.array(values))


def prices_of(network: Network, seed: int, size: float, demand: float, level_price: Floats | float) -> Prices:
    """Return arbitrary prices."""
    rng = np.random.default_rng(seed)
    stores, functions = len(network.stores), innovations(network.processes, np.zeros((1, 1, 1))).features.shape[1]
    return Prices(
        stock=size * rng.standard_normal((KNOTS, stores, functions)),
        reference=rng.uniform(0, 10, (network.episode.horizon - 1, stores)),
        response=rng.uniform(0, 1, (3 * functions, stores)),
        service=np.full(len(network.services), level_price),
        demand=np.full(len(network.services), demand),
        shocks=np.zeros((2, functions)),
    )


@pytest.mark.parametrize(
    ("horizon", "chain"),
    [
        (3, CHAIN),
        (4, replace(CHAIN, start=1)),
        (3, Markov(values=(1.0, 0.6, 0.2), matrix=((0.5, 0.3, 0.2), (0.4, 0.4, 0.2), (0.1, 0.4, 0.5)), start=1)),
        pytest.param(6, CHAIN, marks=pytest.mark.slow),
    ],
)
@pytest.mark.medium
@pytest.mark.sample(1)
def test_the_bound_is_that_of_all_paths_at_once(horizon: int, chain: Markov) -> None:
    """With the multipliers of the extensive form it is its optimum; with others never less, with fitted ones near."""
    network = works(horizon, chain)
    paths = Paths.of(network)
    best, weights, level_price = paths.best(DEMAND, states_only=True)
    if horizon < 6:
        assert paths.best(DEMAND)[0] == pytest.approx(best, abs=1e-7)  # all variables, not the stocks alone
    charged = prices_of(network, 0, 0.0, DEMAND, level_price)
    proofs = [
        program.prove(program.with_weights(weight, 0.0, charged)).value
        for program, weight in zip(paths.programs, weights, strict=True)
    ]
    assert paths.chance @ np.array(proofs) == pytest.approx(best, abs=1e-6)
    informed = paths.mean(charged)
    assert informed > best + 3e-4
    for seed in range(3):
        assert paths.mean(prices_of(network, seed, 0.03, DEMAND, (0.5 + seed) * level_price)) >= best - 1e-8
    drawn = np.random.default_rng(0).choice(len(paths.chance), 24, p=paths.chance)
    _, fitted = fit_prices([paths.programs[i] for i in drawn], np.array([DEMAND]), 1.0)
    assert paths.mean(fitted) >= best - 1e-8
    if chain is CHAIN:
        assert paths.mean(fitted) <= informed - 0.3 * (informed - best)


@pytest.mark.slow
def test_fitted_prices_close_what_foresight_is_worth() -> None:
    """A store is worth the same to who knows the demand to come, whatever it was: prices grow from nothing there."""
    network, demand = stockist(5), 0.95
    paths = Paths.of(network)
    best = paths.best(demand)[0]
    drawn = np.random.default_rng(1).choice(len(paths.chance), 64, p=paths.chance)
    informed, fitted = (
        paths.mean(prices) for prices in fit_prices([paths.programs[i] for i in drawn], np.array([demand]), 1.0)
    )
    assert informed - best > 0.05 * abs(best)
    assert best - 1e-8 <= fitted <= informed - 0.5 * (informed - best)


@pytest.fixture(scope="module")
def works_paths() -> Paths:
    """Return all paths of the works."""
    return Paths.of(works(4))


@pytest.fixture(scope="module")
def works_prices(works_paths: Paths) -> tuple[Prices, Prices]:
    """Return prices of the works of perfect information, and fitted ones."""
    drawn = np.random.default_rng(3).choice(len(works_paths.chance), 32, p=works_paths.chance)
    return fit_prices([works_paths.programs[i] for i in drawn], np.array([DEMAND]), 1.0)


def proofs(paths: Paths, prices: Prices) -> tuple[Floats, Floats]:
    """Return what is proved on each path under prices, and what of it shocks add by themselves."""
    values = np.array([program.prove(program.with_prices(prices)).value for program in paths.programs])
    return values, np.array([prices.luck(program.draw.new) for program in paths.programs])


@pytest.mark.slow
def test_luck_of_draws_narrows_the_interval(works_paths: Paths, works_prices: tuple[Prices, Prices]) -> None:
    """What shocks by themselves add has mean 0 over all paths, and follows what draws are worth."""
    paths, (values, luck) = works_paths, proofs(works_paths, works_prices[0])
    assert paths.chance @ luck == pytest.approx(0.0, abs=1e-12)
    spreads = [paths.chance @ (part - paths.chance @ part) ** 2 for part in (values, values - luck)]
    assert spreads[1] < 0.5 * spreads[0]


def test_improvement_never_rises(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every step of the fit lowers the mean of its draws, and the last is below perfect information and regression."""
    network = stockist(4)
    paths = Paths.of(network)
    steps: list[list[float]] = []

    def recorded(*arguments: Any) -> list[PriceTrial]:
        trials = improve(*arguments)
        steps.append([float(trial.values.mean()) for trial in trials])
        return trials

    monkeypatch.setattr(price_fit, "improve", recorded)
    price_fit.fit_prices(paths.programs, np.array([0.95]), 1.0)
    for values in steps:
        assert len(values) > 1
        assert (np.diff(values) < 0).all()
    assert steps[1][-1] < steps[0][-1] - 1e-3


@pytest.mark.medium
def test_a_wrong_mean_is_not_a_bound(works_paths: Paths) -> None:
    """What a conditional mean that is estimated from draws would prove is beaten by all paths."""
    network, paths = works(4), works_paths
    best, _, level_price = paths.best(DEMAND)
    charged = prices_of(network, 0, 0.0, DEMAND, level_price)
    # regression on the regime before, from few draws: its error has a mean that can be exploited
    drawn = np.random.default_rng(1).choice(len(paths.chance), 8, p=paths.chance)
    before = np.concatenate([paths.regimes[drawn, t] for t in range(3)])
    after = np.concatenate([paths.regimes[drawn, t + 1] for t in range(3)])
    estimated = np.array([after[before == regime].mean() for regime in (0, 1)])
    wrong = [
        replace(program.draw, new=(path[1:] - estimated[path[:-1]])[:, None])
        for program, path in zip(paths.programs, paths.regimes, strict=True)
    ]
    mistaken = Paths(paths.chance, paths.regimes, tuple(DrawProgram(draw, None, 1) for draw in wrong))
    lowest = []
    for version in (mistaken, paths):
        trials = []
        for size in (-0.3, 0.3):
            stock = np.zeros_like(charged.stock)
            stock[:, network.node_index["mine"], 0] = size
            trials.append(version.mean(replace(charged, stock=stock, reference=np.zeros_like(charged.reference))))
        lowest.append(min(trials))
    assert lowest[0] < best - 1e-3
    assert lowest[1] >= best - 1e-8


def test_boxes_of_the_mean_leave_out_what_happens() -> None:
    """A plant that mostly stands still may run from the start on: its draw needs boxes of its own."""
    network = works(2, Markov(values=(1.0, 0.05), lengths=(2.0, 6.0)))
    paths, melt = Paths.of(network), network.arc_index["melt"]
    running, column = paths.programs[0], paths.programs[0].layout.flow[0] + melt
    mean = DrawProgram(replace(running.draw, network=expected_network(network)), None, 1).problem
    most = running.prove(replace(running.problem, cost=-np.eye(len(mean.high))[column])).plan
    assert most is not None
    assert 1.2 * mean.high[column] < most[column] <= running.problem.high[column]


def stockist(horizon: int) -> Network:
    """Return a store that is filled by order and emptied by a demand that nobody foresees."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=1.0, high=2.0)
    return Network(
        name="stockist",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(100.0, 100.0)),
            Node(id="store", initial=(1.0, 1.0)),
            Node(id="use", initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="order", donor="mine", recipient="store", law=Law.CONTROLLED, control=order),
            Arc(id="demand", donor="store", recipient="use", law=Law.EXOGENOUS, flow=1.0),
        ),
        services=(Service(id="served", provider="demand", quantity="flow", low=1.0),),
        episode=Episode(horizon=horizon),
        disturbances={"custom": Markov(values=(0.5, 2.0), matrix=((0.6, 0.4), (0.5, 0.5)), start=1)},
        disturbed={path: DisturbanceEffect(by="custom") for path in ("arcs.demand.flow", "services.served.low")},
    )


def best_stockist(network: Network, price: float) -> float:
    """Return the most that any policy reaches of λ̄ + price·level on average: backward induction on a lattice.

    x' = x + u − min(d, x) and level min(d, x)/d are linear in pieces with kinks at halves, so that halves suffice.
    """
    (chain,) = network.processes.disturbances
    assert isinstance(chain, Markov)
    steps = network.episode.horizon
    stocks, orders = np.arange(0.0, 1.0 + 2.0 * steps + 0.5, 0.5), np.arange(0.0, 2.5, 0.5)
    later = np.zeros((len(chain.values), len(stocks)))
    for _ in range(steps):
        now = np.empty_like(later)
        for regime, demand in enumerate(chain.values):
            ahead = chain.transitions[regime] @ later
            sold = np.minimum(demand, stocks)
            options = [
                (-order + price * sold / demand) / steps + np.interp(stocks + order - sold, stocks, ahead)
                for order in orders
            ]
            now[regime] = np.max(options, axis=0)
        later = now
    return float(np.interp(1.0, stocks, later[0]))


@pytest.mark.medium
def test_no_dynamic_program_beats_it() -> None:
    """The best policy of a store that is ordered for, found exactly, does not exceed the mean over all paths."""
    network, price = stockist(5), 1.7
    paths, best = Paths.of(network), best_stockist(stockist(5), 1.7)
    charged = prices_of(network, 0, 0.0, 0.0, price)
    informed = paths.mean(charged)
    assert informed > best + 0.01
    trials = [paths.mean(prices_of(network, seed, 0.02, 0.0, price)) for seed in range(3)]
    assert min(trials) >= best - 1e-8
    sample = Sample(paths.programs)
    trial = sample(charged)
    assert trial.values @ paths.chance == pytest.approx(informed, abs=1e-9)
    slopes = np.einsum("i,iknf->knf", paths.chance, sample.slopes(trial)[0])
    step = 1e-4 * slopes / np.abs(slopes).max()
    lower = paths.mean(replace(charged, stock=-step))
    assert best - 1e-8 <= lower < informed  # against its subgradient it falls


@pytest.mark.parametrize("name", [name for name in KINDS if KINDS[name].observed is not None])
def test_innovations_have_no_mean(name: str) -> None:
    """Given any state, the mean of what is new is 0 to round-off: quadrature of normals, sums over chains, records."""
    network = line({"arcs.dig.flow": DisturbanceEffect(by=name)})
    kind = network.disturbances[name]
    states: Floats
    if isinstance(kind, Gaussian):
        nodes, weights = np.polynomial.hermite_e.hermegauss(20)
        before, (memory, noise) = np.linspace(-3, 3, 7), kind.memory
        states = np.stack([np.repeat(before, 20), (memory * before[:, None] + noise * nodes).ravel()])[:, None]
        chance = np.tile(weights / weights.sum(), (7, 1))
    else:
        assert isinstance(kind, Markov | BlockBootstrap)
        size = len(kind.values)
        if isinstance(kind, Markov):
            chance = kind.transitions
        else:
            chance = np.full((size, size), 1 / (kind.block * size))
            chance[np.arange(size), (np.arange(size) + 1) % size] += 1 - 1 / kind.block
        states = np.stack([np.repeat(np.arange(size), size), np.tile(np.arange(size), size)])[:, None].astype(float)
    parts = innovations(network.processes, states)
    new = parts.new[0].reshape(-1, *chance.shape)
    np.testing.assert_allclose((new * chance).sum(axis=2), 0.0, atol=1e-12)
    assert np.abs(new).max() > 1e-3


@pytest.mark.medium
def test_what_is_new_in_draws_is_new() -> None:
    """In many draws of several processes the mean is 0 within its standard errors, times what was known before too."""
    network = replace(line({"arcs.dig.flow": DisturbanceEffect(by="price")}), correlation=CORRELATION)
    network = replace(
        network,
        disturbed={
            f"arcs.{a}.{b}": DisturbanceEffect(by=n)
            for (a, b), n in zip(
                [("dig", "flow"), ("tails", "share"), ("leak", "rate")], ("price", "season", "outage"), strict=True
            )
        },
    )
    states = network.processes.sample(range(4000)).states
    parts = innovations(network.processes, states)
    for known in (np.ones_like(parts.new), parts.features[:-1]):
        product_ = parts.new * known
        error = product_.std(axis=2) / np.sqrt(4000)
        assert (np.abs(product_.mean(axis=2)) <= 4.5 * error + 1e-12).all()


def uncertain_network(make_network: Callable[..., Network], seed: int) -> Network | None:
    """Return a random network that is disturbed and has uncertain numbers, or None if nothing in it can be."""
    rng = np.random.default_rng(seed)
    network = certifiable(make_network(seed, int(rng.integers(3, 9)), int(rng.integers(4, 12))), 0.5, pulls=False)
    kinds = {name: kind for name, kind in KINDS.items() if kind.ends[0] > 0}
    network = replace(network, disturbances=kinds, correlation=CORRELATION, scenarios={})
    paths = [f"arcs.{arc.id}.{name}" for arc in network.arcs for name in ("rate", "flow", "share")]
    paths += [f"arcs.{arc.id}.control.high" for arc in network.arcs if arc.control is not None]
    paths += [f"nodes.{node.id}.{name}" for node in network.nodes for name in ("rate", "stretch")]
    paths += [f"services.{service.id}.low" for service in network.services]
    for path in rng.permutation(paths).tolist()[:8]:
        effect = DisturbanceEffect(by=str(rng.choice([*kinds])))
        numbers = {path: Spread(low=0.8, high=1.1, distribution="uniform")} if rng.random() < 0.3 else {}
        try:
            network = replace(
                network,
                disturbed={**network.disturbed, path: effect},
                uncertain={**network.uncertain, **numbers},
            )
        except NetworkError:
            continue  # this number is not stated
    return network.with_options(episode={"horizon": 4}) if network.disturbed and network.agents else None


def merits(network: Network, found: Any, controller: Controller) -> tuple[Floats, Floats]:
    """Return what a policy does in the draws of a bound: λ̄ + Σ μ (level − demand), and what the penalty takes of it."""
    env = MultiAgentVectorEnv(network, num_envs=len(found.values), uncertain=bool(network.uncertain))
    observations = env.reset(seed=first_seed(found.sampling.seed))
    parts = draws.draws_of(env)
    plan = getattr(controller, "plan", None)
    if plan is not None:
        plan(env, 0, lambda share: None)
    else:
        controller.start(env, 0)
    stocks, circularity = [], np.zeros(env.num_envs)
    for _ in range(network.episode.horizon):
        outcome = env.advance(env.stack(controller.act(observations)))
        circularity += outcome.circularity_mean / network.episode.horizon
        stocks.append(env.rows.stocks(env.physical.stock).T.copy())
        observations = env.by_agent(outcome.observation)
    levels = env.physical.service.T / network.episode.horizon
    weights = np.array([found.prices.weights(draw.new) for draw in parts])
    expected = np.array([found.prices.expected_stocks(draw.features) for draw in parts])
    apart = np.moveaxis(np.array(stocks[:-1]), 1, 0) - expected
    return circularity + found.prices.service_value(levels), np.einsum("itn,itn->i", weights, apart)


@pytest.mark.parametrize("lifetime", LIVES)
@pytest.mark.medium
@pytest.mark.sample(1)
def test_prices_stand_on_all_that_is_in_use(lifetime: Lifetime) -> None:
    """With a lifetime the simulator has stages or slots and the program vintages: no policy earns more in any draw."""
    order = Control(kind=ControlKind.FLOW, low=5.0, neutral=10.0, high=15.0)
    network = town(lifetime, np.full(6, 10.0), initial=40.0)
    buy = Arc(id="buy", donor="mine", recipient="use", law=Law.CONTROLLED, control=order)
    network = replace(
        network,
        arcs=(buy, *network.arcs[1:]),
        services=(Service(id="served", provider="use", quantity="stock", low=60.0),),
        disturbances={"wanted": CHAIN},
        disturbed={"services.served.low": DisturbanceEffect(by="wanted")},
    )
    env = MultiAgentVectorEnv(network, num_envs=8)
    env.reset(seed=first_seed(0))
    programs = [DrawProgram(draw, None, 1) for draw in draws.draws_of(env)]
    for seed in range(3):
        prices = prices_of(network, seed, 0.2, 0.5, 20.0)
        values = np.array([program.prove(program.with_prices(prices)).value for program in programs])
        played = SimpleNamespace(values=values, prices=prices, sampling=Sampling())
        for policy in (Neutral(), Random(), Constant({"buy": 1.0}), Constant({"buy": -1.0})):
            merit, penalty = merits(network, played, policy)
            assert np.abs(penalty).max() > 0.1
            assert (merit - penalty <= values + 1e-6).all()


SEEDS = range(40)


@pytest.mark.slow
def test_substeps_of_large_programs_are_merged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then a draw's program has one piece for an interval, proves nearly as much, and no less than what happens."""
    network = load_network("car_batteries").scenario("adoption").with_options(episode={"horizon": 8})
    env = MultiAgentVectorEnv(network, num_envs=3)
    env.reset(seed=first_seed(0))
    drawn, proofs = draws.draws_of(env), list[NDArray[np.float64]]()
    for large, pieces in ((draws.LARGE_DRAW, 4), (1_000, 1)):
        monkeypatch.setattr(draws, "LARGE_DRAW", large)
        programs = [DrawProgram(draw, None, 1) for draw in drawn]
        assert {program.layout.pieces for program in programs} == {pieces}
        proofs.append(np.array([program.prove(program.problem).value for program in programs]))
    assert proofs[1] == pytest.approx(proofs[0], rel=0.1)
    for actions in np.linspace(-1.0, 1.0, 9):
        policy = Constant(dict.fromkeys(network.agents, float(actions)))
        reached = rollout(env, policy, seed=first_seed(0)).episode_circularity
        assert (reached <= np.minimum(*proofs) + 1e-9 * np.abs(reached)).all()


@pytest.mark.slow
@pytest.mark.parametrize("large", [draws.LARGE_DRAW, 0], ids=["fine", "merged"])
def test_no_policy_exceeds_it(
    large: int, make_network: Callable[..., Network], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On at least twenty random networks: in every draw with the penalty, on average without it within the interval."""
    monkeypatch.setattr(draws, "LARGE_DRAW", large)
    attacked = 0
    for seed in SEEDS:
        network = uncertain_network(make_network, seed)
        if network is None:
            continue
        demand = 0.3 if network.services else None
        try:
            found = bound(network, min_service=demand, degree=1, uncertain=Sampling(draws=16, fit_draws=4))
        except NoCertificate:
            continue
        except CirlError as error:
            assert "no policy reaches" in str(error) or "fails in a draw" in str(error)
            continue
        attacked += 1
        weight = 1.0 if demand is None else None
        planners = [
            MPC(min_service=demand),
            MPC(min_service=demand, service_weight=weight, prices=found.prices),
            MPC(min_service=demand, service_weight=weight, futures=2),
        ]
        policies: list[Controller] = [Neutral(), Random(), planners[attacked % len(planners)]]  # they take minutes
        agents, rng = network.agents, np.random.default_rng(seed)
        policies += [Constant({agent: float(rng.uniform(-1, 1)) for agent in agents}) for _ in range(8)]
        policies += [Constant({agent: float(rng.choice([-1, 1])) for agent in agents}) for _ in range(8)]
        size = 1e-7 * (1 + float(np.abs(found.values).max()))
        for policy in policies:
            merit, penalty = merits(network, found, policy)
            assert (merit - penalty <= found.values + size).all(), (seed, policy)
            excess = merit - found.values
            assert excess.mean() <= 4 * excess.std(ddof=1) / np.sqrt(len(excess)) + size, (seed, policy)
    assert attacked >= 20


@pytest.mark.slow
def test_the_interval_covers_what_it_says(works_paths: Paths, works_prices: tuple[Prices, Prices]) -> None:
    """Whoever draws anew has an upper end above the best policy, the extensive form, about as often as is said."""
    chance, (values, luck) = works_paths.chance, proofs(works_paths, works_prices[1])
    # about what is proved on average, which no policy exceeds, so that nothing but the interval counts
    proved = chance @ values
    assert proved >= works_paths.best(DEMAND)[0] - 1e-8
    half_width = vars(uncertain_bound.UncertainBound)["half_width"].fget
    for draws_made, covered in ((12, 0.88), (64, 0.93)):
        drawn = np.random.default_rng(4).choice(len(chance), (2000, draws_made), p=chance)
        samples = (SimpleNamespace(values=values[row], luck=luck[row]) for row in drawn)
        ends = [float((sample.values - sample.luck).mean()) + half_width(sample) for sample in samples]
        assert covered <= np.mean(np.array(ends) >= proved) <= 0.99, draws_made


def small_bound(**options: Any) -> Any:
    """Return the bound of the works over a few intervals."""
    sampling = Sampling(**{"draws": 12, "fit_draws": 8, **options})
    return bound(works(4), min_service=DEMAND, degree=1, uncertain=sampling)


@pytest.fixture(scope="module")
def found() -> Any:
    """Return the bound of the works."""
    return small_bound()


@pytest.mark.medium
def test_the_record_says_what_was_done(found: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its mean is that of every draw, verified without the solver; where that fails others' multipliers count."""
    assert found.verify() == pytest.approx(found.value, abs=1e-12)
    assert found.upper > found.value
    assert len(found.values) == len(found.certificates) == 12
    assert found.failures == 0
    assert "works" in str(found)
    assert not found.hidden_numbers
    merit, _ = merits(found.network, found, Neutral())
    levels = np.ones((12, 1)) * DEMAND
    np.testing.assert_allclose(found.gaps(merit, levels), (found.values - merit) / found.scale)
    calls: list[Any] = []

    def failing(problem: Any, *arguments: Any, **options: Any) -> Any:
        calls.append(problem)
        if len(calls) == 6:
            raise SolverFailure("on purpose")
        return solve(problem, *arguments, **options)

    monkeypatch.setattr(uncertain_bound, "fit_prices", lambda *a, **k: (found.informed_prices, found.prices))
    monkeypatch.setattr(draws, "solve", failing)
    failed = small_bound()
    assert failed.failures == 1
    assert failed.verify() == pytest.approx(failed.value, abs=1e-12)
    assert (failed.values >= found.values - 1e-9).all()
    assert np.flatnonzero(np.isnan(failed.gross_mass)).tolist() == [2]


@pytest.mark.medium
def test_a_dropped_draw_is_an_error(found: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is left out of the mean."""
    prove = DrawProgram.prove

    def broken(self: DrawProgram, *arguments: Any) -> DrawProof:
        return replace(prove(self, *arguments), value=np.nan)

    monkeypatch.setattr(uncertain_bound, "fit_prices", lambda *a, **k: (found.informed_prices, found.prices))
    monkeypatch.setattr(DrawProgram, "prove", broken)
    with pytest.raises(CirlError, match="every one counts"):
        small_bound()


@pytest.mark.slow
@pytest.mark.parametrize("start", [None, 1])
def test_prices_are_fitted_where_hardly_anything_happens(start: int | None) -> None:
    """What differs between draws by rounding alone has no price; a bound needs draws in which something happens."""
    network = works(4, Markov(values=(1.0, 0.3), lengths=(60, 5), start=start))
    for seed in range(4):
        sampling = Sampling(draws=200, fit_draws=8, seed=seed)
        found = bound(network, min_service=DEMAND, degree=1, uncertain=sampling)
        assert np.abs(found.prices.stock).max() < 10 and found.half_width < 0.2
    if start is not None:
        with pytest.raises(CirlError, match=r"10 of 10 draws meet the same disturbances.* take some 60 draws"):
            bound(network, degree=1, uncertain=Sampling(draws=10, fit_draws=8))


def test_rounding_is_no_deviation() -> None:
    """What is the same in all draws has none, though its mean is rounded."""
    samples = np.random.default_rng(0).normal(size=(7, 3, 2))
    samples[..., 0] = 0.1
    assert (samples.mean(axis=0)[:, 0] != 0.1).all()
    apart = price_fit._deviations(samples)
    assert (apart[..., 0] == 0.0).all() and (apart[..., 1] == samples[..., 1] - samples[..., 1].mean(axis=0)).all()


def test_a_single_decision_has_a_bound() -> None:
    """Nothing is new after it, so that it is perfect information's."""
    sampling, shares = Sampling(draws=40, fit_draws=8), list[float]()
    found = bound(works(3), horizon=1, min_service=0.5, degree=1, uncertain=sampling, progress=shares.append)
    assert min(np.diff(shares)) > -1e-9 and len(set(shares)) > 8 and shares[-1] == pytest.approx(1.0)
    assert found.value == pytest.approx(found.perfect_information, abs=1e-9)


@pytest.mark.medium
def test_rounding_of_the_solver_is_no_scale() -> None:
    """Where nothing has to be moved, gaps are in parts of the circularity scale."""
    network = stockist(4)
    found = bound(network, degree=1, uncertain=Sampling(draws=10, fit_draws=4))
    assert abs(found.value) < 1e-6 and found.scale == network.objective.circularity_scale


@pytest.mark.medium
def test_gaps_are_of_draws(found: Any) -> None:
    """Episodes beyond the draws, and levels of other services, are refused by their shape."""
    for circularity, levels in ((np.zeros(13), np.ones((13, 1))), (np.zeros(4), np.ones(4)), (0.0, [[1.0]])):
        with pytest.raises(CirlError, match=r"expected \(draws,\), at most 12 draws, and \(draws, 1\)"):
            found.gaps(circularity, levels)
    figures = found.as_dict()
    assert figures["value"] == found.value and figures["service_prices"] == {"served": found.prices.service[0]}
    foresight_gap = 0.5
    closed = found.closure(foresight_gap) * foresight_gap * found.scale
    assert closed == pytest.approx(found.perfect_information - found.value, abs=1e-12)


@pytest.mark.slow
def test_jobs_prove_the_same(found: Any, tmp_path: Path) -> None:
    """In processes of their own, and what is there already is not done again."""
    elsewhere = small_bound(on="local", workers=2, directory=tmp_path)
    np.testing.assert_array_equal(elsewhere.values, found.values)
    files = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    assert len(files) == 2
    small_bound(directory=tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")} == files


@pytest.mark.medium
def test_hidden_numbers_are_told() -> None:
    """The bound knows what was drawn once, and says so; without their draws it is of the stated numbers."""
    network = replace(works(3), uncertain={"arcs.lose.rate": Spread(low=0.5, high=1.5, distribution="uniform")})
    sampling = Sampling(draws=10, fit_draws=4)
    found = bound(network, degree=1, uncertain=sampling)
    assert found.hidden_numbers == ("arcs.lose.rate",)
    assert "arcs.lose.rate" in str(found)
    stated = bound(network, degree=1, uncertain=replace(sampling, numbers=False))
    assert not stated.hidden_numbers
    assert not np.allclose(stated.values, found.values)


@pytest.mark.parametrize(
    ("network", "options", "message"),
    [
        (works(3), {"uncertain": Sampling(draws=9)}, "draws 9: too few for an interval, at least 10"),
        (works(3), {"uncertain": Sampling(fit_draws=1)}, "fit_draws 1: too few"),
        (works(3), {"uncertain": True, "service_weight": 0.5}, "certain future"),
        (works(3), {"uncertain": 20}, "uncertain must be True, False or a Sampling, got 20"),
        (works(3), {"uncertain": Sampling(draws=10.5)}, "draws must be a whole number of at least 1, got 10.5"),  # type: ignore[arg-type]
        (works(3), {"uncertain": Sampling(numbers="no")}, "numbers must be True or False, got 'no'"),  # type: ignore[arg-type]
        (works(3), {"uncertain": Sampling(directory=4)}, "directory must be a path, got 4"),  # type: ignore[arg-type]
        (works(3), {"uncertain": Sampling(settings=5)}, "settings must be a mapping"),  # type: ignore[arg-type]
        (works(3), {"uncertain": Sampling(draws=600_000)}, "draws 600000: at most 500,000"),
        (works(3), {"uncertain": True, "min_service": "x"}, r"min_service 'x' must lie in \[0, 1\], a number for all"),
        (works(3), {"uncertain": Sampling(on="slurm")}, "needs a directory"),
        (works(3), {"uncertain": Sampling(on="nowhere")}, "nowhere"),
        (load_network("copper_net"), {"uncertain": True}, "nothing disturbs it"),
        (works(3), {"uncertain": Sampling(draws=10, fit_draws=4), "min_service": 1.0}, "no policy reaches an expected"),
    ],
)
def test_what_cannot_be_bounded_is_refused(network: Network, options: dict[str, Any], message: str) -> None:
    """With the number, the place or the size."""
    with pytest.raises(CirlError, match=message):
        bound(network, degree=1, **options)


def test_large_programs_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """With their size, before anything is solved."""
    monkeypatch.setattr(uncertain_bound, "LARGE_PROGRAM", 100)
    monkeypatch.setattr(draws, "solve", None)
    with pytest.raises(CirlError, match=r"the program of a draw has \d+ variables, more than 100"):
        small_bound()


@pytest.mark.medium
def test_entries_have_their_gap(found: Any) -> None:
    """Paired with the draws: to the bound for who does not foresee, and beside it to perfect information."""
    comparison = compare((), ("neutral", "optimum"), network=found.network, bounds=False, uncertain_bound=found)
    assert comparison.episodes == 12
    for row in comparison.rows:
        (entry,), figure, beside = row.entries, row.figure("expected_gap"), row.figure("foresight_gap")
        merit = entry.circularity + (entry.rollout.episode_levels[:, 0] - DEMAND) * found.prices.service[0]
        assert figure is not None and beside is not None
        assert figure.value == pytest.approx((found.values - merit).mean() / found.scale)
        assert figure.high > 0.0
        levels = entry.rollout.episode_levels
        gaps = found.gaps(entry.circularity, levels, with_foresight=True)
        assert beside.value == pytest.approx(gaps.mean())
    with pytest.raises(CirlError, match=r"leave out episodes \(5\)"):
        compare((), ("neutral",), network=found.network, bounds=False, uncertain_bound=found, episodes=5)
    with pytest.raises(CirlError, match="of something else than the bound: horizon 3, not 4"):
        compare((), ("neutral",), network=works(3), bounds=False, uncertain_bound=found)
