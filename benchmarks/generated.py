"""What is measured but stands in no catalogue: random networks of any size, and an environment that costs nothing.

With it come VMAS's ``simple_spread``, the yardstick from outside, and the two ways to let learners learn in the free
environment: together in lockstep, and each alone.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from cirl_marl.environments.vector import Infos, MultiAgentVectorEnv
from cirl_marl.learners.agent_env import AgentVecEnv, StepResult
from cirl_marl.learners.learner import Learner
from cirl_marl.learners.lockstep import Lockstep, NetworkWorld, Participant
from cirl_marl.learners.recipe import Recipe
from cirl_marl.learners.views import OneAgent
from cirl_marl.network import Network
from cirl_marl.network.elements import Arc, Control, ControlKind, Episode, Law, Node, Role

TURNOVER = 0.2
"""Share of its stock that a node with outflows sends on in one control interval, as the faster nodes of copper_net."""

Weights = list[NDArray[np.float32]]

SCENES = 64
"""Steps after which the outcomes of ``FreeEnv`` repeat."""


def random_network(arcs: int, seed: int = 0) -> Network:
    """Return a network of ``arcs`` nodes and as many arcs between nodes drawn uniformly, so that the mean degree is 2.

    Nothing is near anything else: donor and recipient of an arc are anywhere in memory, which is the worst case for
    caches. Every node that has outflows turns over the same share, so the solver takes the same number of terms
    whatever the size. The first node has a valve, since an environment needs an agent.
    """
    random = np.random.default_rng(seed)
    donors = random.integers(arcs, size=arcs)
    recipients = (donors + random.integers(1, arcs, size=arcs)) % arcs
    rates = TURNOVER / np.bincount(donors)[donors]
    ends = zip(donors.tolist(), recipients.tolist(), rates.tolist(), strict=True)
    valve = Control(kind=ControlKind.RATE, low=0.5, high=1.0, neutral=1.0)
    return Network(
        name=f"random_{arcs}",
        nodes=tuple(Node(id=f"n{i}", initial=(0.5, 1.5), control=None if i else valve) for i in range(arcs)),
        arcs=tuple(
            Arc(id=f"a{k}", donor=f"n{donor}", recipient=f"n{recipient}", rate=rate)
            for k, (donor, recipient, rate) in enumerate(ends)
        ),
        episode=Episode(control_interval=1.0, horizon=1_000_000),
    )


CHAIN: Mapping[str, Mapping[str, float | None]] = {
    "mining": {"world ore": 0.4, "smelting": None},
    "smelting": {"landfill": 0.03, "refining": None},
    "refining": {"smelting": 0.05, "world metal": 0.25, "casting": None},
    "casting": {"remelting": 0.03, "semis": None},
    "semis": {"remelting": 0.1, "world semis": 0.2, "fabrication": None},
    "fabrication": {"scrap_market": 0.15, "manufacturing": None},
    "manufacturing": {"scrap_market": 0.05, "machines": 0.35, "vehicles": 0.25, "buildings": None},
    "machines": {"landfill": 0.15, "collection": None},
    "vehicles": {"landfill": 0.1, "collection": None},
    "buildings": {"landfill": 0.2, "collection": None},
    "collection": {"landfill": 0.05, "dismantling": None},
    "dismantling": {"landfill": 0.05, "sorting": None},
    "sorting": {"dismantling": 0.05, "landfill": 0.05, "scrap_market": None},
    "scrap_market": {"world scrap": 0.2, "smelting": 0.1, "remelting": None},
    "remelting": {"landfill": 0.02, "world metal": 0.1, "casting": None},
}
"""Where each process and stock of a region sends what share of its outflow, None being the rest."""

TRADED = {"ore": "smelting", "metal": "casting", "semis": "fabrication", "scrap": "sorting"}
"""What world markets trade, and the process of each region that buys it."""

IN_USE = {"machines": (5.0, 15.0), "vehicles": (10.0, 20.0), "buildings": (30.0, 50.0)}
"""Range of the mean residence time in each stock in use, years."""


def yearly_network(*, monthly: bool = False, regions: int = 33, seed: int = 0) -> Network:
    """Return the cycle of a metal in some regions and on the world market: 500 nodes, 400 of them without stock.

    Its numbers are drawn; its stages are those that flow analyses of steel, copper and aluminium tell apart. Each
    region mines, smelts, casts, makes products, collects and remelts them (``CHAIN``), with home scrap, new scrap and
    the secondary smelter as loops of its own; four world markets join the regions, so that one loop holds ten processes
    of each and three of the markets, 333 nodes. What is in use stays for 5 to 50 years (``IN_USE``); all the other
    nodes pass on within the year what they get. Every fifth region has two agents, who set its import share of semis
    and how much scrap it exports, and one agent sets what part of the world's scrap the first region gets.

    Args:
        monthly: whether the nodes without stock hold what they get for a month instead.
        regions: number of regions.
        seed: of residence times, mines, and shares in the world markets.
    """
    random = np.random.default_rng(seed)
    asked = Control(kind=ControlKind.SHARE, low=0.1, neutral=0.2, high=0.4)
    held: dict[str, Any] = {"initial": (0.0, 0.0), "rate": 12.0} if monthly else {"stores": False}
    nodes = [Node(id="deposits", role=Role.NONRENEWABLE_RESERVOIR), Node(id="landfill", role=Role.LANDFILL)]
    arcs: list[Arc] = []
    for i in range(regions):
        for name, shares in CHAIN.items():
            years = random.uniform(*IN_USE.get(name, (1.0, 1.0)))
            used: dict[str, Any] = {"initial": (50.0, 150.0), "rate": 1.0 / years}
            nodes.append(Node(id=f"{name}_{i}", **(used if name in IN_USE else held)))
            for end, value in shares.items():
                recipient = end.replace(" ", "_") if end.startswith("world") or end == "landfill" else f"{end}_{i}"
                chosen: dict[str, Any] = {"share": value}
                if i % 5 == 0 and (name, end) in (("scrap_market", "world scrap"), ("semis", "world semis")):
                    chosen = {"control": asked}
                donor = f"{name}_{i}"
                arcs.append(
                    Arc(id=f"{donor}_to_{recipient}", donor=donor, recipient=recipient, law=Law.SHARE, **chosen)
                )
        mined = float(random.uniform(1.0, 10.0))
        arcs.append(Arc(id=f"ore_{i}", donor="deposits", recipient=f"mining_{i}", law=Law.EXOGENOUS, flow=mined))
    for good, buyer in TRADED.items():
        nodes.append(Node(id=f"world_{good}", **held))
        parts = 0.6 * random.dirichlet(np.full(regions, 5.0))
        for i, part in enumerate(parts.tolist()):
            chosen = {"share": part if i + 1 < regions else None}
            if good == "scrap" and i == 0:
                chosen = {"control": asked}
            name, buys = f"world_{good}", f"{buyer}_{i}"
            arcs.append(Arc(id=f"{name}_to_{i}", donor=name, recipient=buys, law=Law.SHARE, **chosen))
    return Network(
        name="yearly",
        nodes=tuple(nodes),
        arcs=tuple(arcs),
        episode=Episode(control_interval=1.0, horizon=30),
        time_unit="year",
    )


def market_network(markets: int, *, every: int = 3, skew: float = 0.8, seed: int = 0) -> Network:
    """Return markets without stock that pass to each other at random, with a fifth as many stocks in use.

    Each passes to three others and to a stock, which returns it after 5 to 30 years. The chance to be passed to falls
    with the number of a market to the power of ``skew``: the first ones are hubs.

    Args:
        markets: number of markets.
        every: every so manieth market has an agent, who sets its first share; 0 for none.
        skew: 0 makes all alike.
        seed: of all that is drawn.
    """
    random = np.random.default_rng(seed)
    stocks = max(2, markets // 5)
    chances = np.arange(1, markets + 1) ** -skew
    asked = Control(kind=ControlKind.SHARE, low=0.05, neutral=0.1, high=0.3)
    residence = random.uniform(5.0, 30.0, stocks).tolist()
    nodes = [Node(id=f"stock_{i}", initial=(50.0, 150.0), rate=1.0 / years) for i, years in enumerate(residence)]
    nodes += [Node(id=f"market_{i}", stores=False) for i in range(markets)]
    nodes.append(Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR))
    arcs = [Arc(id="feed", donor="mine", recipient="market_0", law=Law.EXOGENOUS, flow=7.0)]
    ends: list[tuple[str, int]] = [(f"stock_{i}", int(random.integers(markets))) for i in range(stocks)]
    arcs += [Arc(id=f"{id_}_out", donor=id_, recipient=f"market_{j}", law=Law.SHARE) for id_, j in ends]
    for i in range(markets):
        drawn = random.choice(markets, size=3, p=chances / chances.sum())
        others = [int(j) for j in dict.fromkeys(drawn.tolist()) if j != i]
        # what a control takes is left over
        parts = (0.6 * random.dirichlet(np.ones(len(others) + 1))[1:]).tolist()
        for n, (j, part) in enumerate(zip(others, parts, strict=True)):
            chosen: dict[str, Any] = {"control": asked} if every and i % every == 0 and n == 0 else {"share": part}
            arcs.append(
                Arc(id=f"market_{i}_to_{j}", donor=f"market_{i}", recipient=f"market_{j}", law=Law.SHARE, **chosen)
            )
        used = f"stock_{random.integers(stocks)}"
        arcs.append(Arc(id=f"market_{i}_to_use", donor=f"market_{i}", recipient=used, law=Law.SHARE))
    return Network(
        name="markets",
        nodes=tuple(nodes),
        arcs=tuple(arcs),
        episode=Episode(control_interval=1.0, horizon=30),
        time_unit="year",
    )


def simple_spread(copies: int, agents: int) -> Callable[[], object] | None:
    """Return what steps VMAS's ``simple_spread`` once, with random continuous actions; None if VMAS is missing."""
    try:
        vmas = importlib.import_module("vmas")
    except ImportError:
        return None
    env = vmas.make_env("simple_spread", num_envs=copies, n_agents=agents, device="cpu", seed=0)
    actions = list(torch.rand(agents, copies, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1)
    return lambda: env.step(actions)


class FreeEnv(MultiAgentVectorEnv):
    """Agents, spaces and episode length of a network, but nothing is simulated: outcomes were drawn beforehand.

    No agent's outcome depends on any action, so a learner meets the same steps here as in its ``lone_seat``.
    """

    def __init__(self, network: str, num_envs: int) -> None:
        """Draw ``SCENES`` outcomes for each agent."""
        super().__init__(network, num_envs=num_envs)
        random = np.random.default_rng(0)
        self._seen: dict[str, list[NDArray[np.float32]]] = {}
        self._paid: dict[str, NDArray[np.float64]] = {}
        for agent, space in self.observation_spaces.items():
            shape = (SCENES, num_envs, *space.shape)
            self._seen[agent] = list(random.uniform(size=shape).astype(np.float32))
            self._paid[agent] = random.normal(size=(SCENES, num_envs))
        self._step = 0

    def observation(self, agent: str, step: int) -> NDArray[np.float32]:
        """Return what ``agent`` sees after ``step`` steps, shape (B, entries)."""
        return self._seen[agent][step % SCENES]

    def reward(self, agent: str, step: int) -> NDArray[np.float64]:
        """Return what the last of ``step`` steps paid ``agent``, shape (B,)."""
        paid: NDArray[np.float64] = self._paid[agent][step % SCENES]
        return paid

    def ended(self, step: int) -> NDArray[np.bool_]:
        """Return whether the episodes end after ``step`` steps: all at once, at the horizon."""
        return np.full(self.num_envs, step % self.network.episode.horizon == 0)

    def reset(
        self, seed: int | Sequence[int] | None = None, options: Mapping[str, Any] | None = None
    ) -> dict[str, NDArray[np.float32]]:
        """Go back to the first outcome."""
        self._step = 0
        return {agent: self.observation(agent, 0) for agent in self.agents}

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[
        dict[str, NDArray[np.float32]],
        dict[str, NDArray[np.float64]],
        dict[str, NDArray[np.bool_]],
        dict[str, NDArray[np.bool_]],
        Infos,
    ]:
        """Return the next outcome, whatever the actions."""
        self._step += 1
        ended = self.ended(self._step)
        observations = {agent: self.observation(agent, self._step) for agent in self.agents}
        over = bool(ended[0])
        return (
            observations,
            {agent: self.reward(agent, self._step) for agent in self.agents},
            dict.fromkeys(self.agents, np.zeros_like(ended)),
            dict.fromkeys(self.agents, ended),
            {agent: {"final_obs": seen} if over else {} for agent, seen in observations.items()},
        )


def lone_seat(env: FreeEnv, agent: str) -> AgentVecEnv:
    """Return a seat that nobody else waits for: a ``VecEnv`` with the outcomes that ``env`` has for ``agent``."""
    step = 0

    def wait() -> None:
        nonlocal step
        step += 1
        seen, nothing = env.observation(agent, step), np.zeros(env.num_envs)
        paid = env.reward(agent, step).astype(np.float32)
        agent_env.last_step = StepResult(seen, paid, env.ended(step), seen, nothing, nothing.astype(int))

    agent_env = AgentVecEnv(env, agent, OneAgent(env, agent))
    agent_env.wait = wait
    ready = np.zeros(env.num_envs, dtype=np.float32), np.ones(env.num_envs, dtype=bool)
    agent_env.last_step = StepResult(env.observation(agent, 0), *ready)
    return agent_env


def learn_together(env: FreeEnv, recipe: Recipe, steps: int) -> tuple[float, Weights]:
    """Let every agent learn for ``steps`` in lockstep; return the seconds it took, without set-up, and the weights."""
    world = NetworkWorld(env, range(env.num_envs))
    learners = {agent: _built(agent_env, recipe, env) for agent, agent_env in world.agent_envs.items()}
    everyone = [
        Participant(
            agent, _learning(learner, steps), learner.act, learner.streams, budget=partial(learner.budget, steps)
        )
        for agent, learner in learners.items()
    ]
    began = time.perf_counter()
    Lockstep([world], everyone).run()
    return time.perf_counter() - began, _weights(learners.values())


def learn_alone(env: FreeEnv, recipe: Recipe, steps: int) -> tuple[float, Weights]:
    """Call the algorithm's own ``learn()`` for one agent after another; return what ``learn_together`` does."""
    learners = [_built(lone_seat(env, agent), recipe, env) for agent in env.agents]
    seconds = 0.0
    for learner in learners:
        with learner.streams.active():
            began = time.perf_counter()
            learner.model.learn(steps)
            seconds += time.perf_counter() - began
    return seconds, _weights(learners)


def _built(agent_env: AgentVecEnv, recipe: Recipe, env: FreeEnv) -> Learner:
    return Learner(agent_env, recipe.learner_of(agent_env.name, env.network), 0).build()


def _learning(learner: Learner, steps: int) -> Callable[[], None]:
    return lambda: learner.learn(steps, None)


def _weights(learners: Iterable[Learner]) -> Weights:
    return [value.numpy().copy() for learner in learners for value in learner.model.policy.state_dict().values()]
