"""What each lever of a network brings: alone, added in the best order, and left out of all of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import Rollout, episode_start
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.environments.actuators import Actuators
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, unknown_name, whole_number
from cirl_marl.evaluation.comparison import ProgressReport, part_of
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.bounds import Bound, bound, gap
from cirl_marl.optimum.improve import PENALTY, improve_plan, penalised_objective, prices
from cirl_marl.optimum.planned_episodes import simulate_plan

ROUNDING = 1e-6
"""By how much less service is demanded than there is as usual, so that it can be had."""
SHORT = 1e-3
"""What a service may lack, before the plan of some levers is improved."""
ROUNDS = 6
"""Most programs that are solved to improve the plan of a row."""
MOST_VARIABLES = 50_000
"""Variables of a program up to which the bound of each row is solved unless it is asked for."""
MOST = 24
"""Most rows unless another number is asked for."""
SETTLED = 1e-3
"""Part of what all levers bring within which some are taken to do as much: nothing more is solved for them."""
RISE = 2.0
"""How many times what it last added, or what all lose without it, a lever may add: no bound is solved for more."""
CLOSE = 0.01
"""Gap from which on the plan of some levers is improved."""


@positional_record
class Trial:
    """The episode in which some levers are pulled, and all others left as they are as usual."""

    run: Annotated[Rollout, "the episode"]
    bound: Annotated[float | None, "λ̄ that nobody can exceed with these levers at this service, mass; None: unknown"]

    @property
    def circularity(self) -> float:
        """λ̄, mass."""
        return float(self.run.episode_circularity[0])

    @property
    def service(self) -> float:
        """Mean level of the service that lacks most."""
        return float(self.run.least_service[0])

    @property
    def gap(self) -> float | None:
        """(bound − λ̄)/|bound|; None without a bound."""
        return None if self.bound is None else float(gap(self.bound, self.circularity))


@positional_record
class LeverRow:
    """A lever, and three episodes that tell what it brings."""

    name: Annotated[str, "what it is called"]
    agents: Annotated[tuple[str, ...], "who pulls it"]
    alone: Annotated[Trial, "it alone"]
    added: Annotated[Trial, "with all in the rows above"]
    without: Annotated[Trial, "all others"]


@positional_record
class Levers:
    """The levers of a network, each the one that adds most to those before it; the last may be all that are left."""

    network: Annotated[Network, "under its scenario"]
    plan: Annotated[Bound, "of all levers; its ``min_service`` is what is demanded"]
    usual: Annotated[Trial, "nobody acts"]
    together: Annotated[Trial, "all levers"]
    rows: Annotated[tuple[LeverRow, ...], "in the order in which they are added"]

    def changes(self, row: int) -> tuple[float, float, float]:
        """Return what the lever of a row adds to λ̄ alone and with those above, and what is lost without it, mass."""
        lever, before = self.rows[row], self.usual if row == 0 else self.rows[row - 1].added
        return (
            lever.alone.circularity - self.usual.circularity,
            lever.added.circularity - before.circularity,
            self.together.circularity - lever.without.circularity,
        )

    def account_changes(self, row: int) -> Floats:
        """Return what the lever of a row adds to the total of each account in the same three ways, (3, accounts)."""
        lever, before = self.rows[row], self.usual if row == 0 else self.rows[row - 1].added
        pairs = ((lever.alone, self.usual), (lever.added, before), (self.together, lever.without))
        return np.array([trial.run.accounts[0] - reference.run.accounts[0] for trial, reference in pairs])

    def share(self, row: int) -> float:
        """Return the part of what all levers bring that those up to a row bring together; NaN if that is nothing."""
        whole = self.together.circularity - self.usual.circularity
        return (self.rows[row].added.circularity - self.usual.circularity) / whole if whole else float("nan")


def levers(
    network: str | Path | Network,
    *,
    scenario: str | None = None,
    groups: Mapping[str, Sequence[str]] | None = None,
    min_service: ArrayLike | None = None,
    bounds: bool | None = None,
    most: int = MOST,
    progress: ProgressReport = lambda activity, share: None,
) -> Levers:
    """Tell what each lever brings: alone, added to those that bring more, and left out of all of them.

    A lever is an agent, or a group of agents; in copies the same agent of all regions. What supplies to make up for a
    service is none. All levers are planned together; then those of a row are simulated as they are planned, and as a
    plan of these alone has them if its bound is solved, and the better counts. The others are neutral. The order is
    greedy: with each lever those before it can do most, by their bound if it is solved. Bounds are solved where they
    decide: not of a lever that would have to add more than RISE times what it did when it was last tried and what is
    lost without it, and not once all that is left to gain is SETTLED of what all levers bring; the rest then follow by
    what they added last, and the bound of all stands for theirs. All is at the service demanded: what a service lacks
    has its price in these choices, and stands in the result.

    Args:
        network: catalogue name, path of a definition file, or a network.
        scenario: of the definition; None is the default.
        groups: agents by the name of the lever that they are together, agents of copies as in what was copied; all
            others are levers of their own.
        min_service: mean level of every service, or of each, shape (services,), in [0, 1]; None: what there is as
            usual.
        bounds: whether the bound of each row is solved; None: if the program has at most MOST_VARIABLES variables.
        most: rows, at least 2; what would have come later is one lever in the last of them.
        progress: called with what is being done and the share that is done.

    Raises:
        NoCertificate: for a network that has no bound.
        CirlError: for input that cannot be used, or fewer than two levers.
    """
    variant = load_network(network, scenario=scenario)
    by_lever = _agents_by_lever(variant, groups or {})
    whole_number("most", most, 2)
    env = MultiAgentVectorEnv(variant, num_envs=1)
    usual = episode_start(env).play(env, Neutral())
    demand = np.maximum(usual.episode_levels[0] - ROUNDING, 0.0) if min_service is None else min_service
    agents = {agent for group in by_lever.values() for agent in group}
    progress("plan of all levers", 0.0)
    solution = bound(variant, min_service=demand, agents=[agent for agent in variant.agents if agent in agents])
    plan = improve_plan(solution, progress=part_of(progress, "plan of all levers", 0.05, 0.1))
    solves = len(plan.solution) <= MOST_VARIABLES if bounds is None else bounds
    trials = _Trials(plan, by_lever, solves, usual)
    trials.leave_out(part_of(progress, "levers left out", 0.15, 0.35))
    order, together, rows = trials.order(most, part_of(progress, "order", 0.5, 0.3)), trials.together, []
    for place, name in enumerate(order):
        progress("levers", 0.8 + 0.2 * place / len(order))
        added = together if place == len(order) - 1 else trials.best(order[: place + 1])
        alone = added if place == 0 else trials.best([name])
        rows.append(LeverRow(name, tuple(by_lever[name]), alone, added, trials.without(name)))
    progress("levers", 1.0)
    return Levers(variant, plan, Trial(usual, None), together, tuple(rows))


class _Trials:
    """Episodes in which some of the levers of a plan are pulled.

    Attributes:
        together: that of all levers.
    """

    def __init__(self, plan: Bound, by_lever: dict[str, list[str]], solves: bool, usual: Rollout) -> None:
        self._plan, self._by_lever, self._solves = plan, by_lever, solves
        self._entries, self._bounds = Actuators(plan.network, plan.agents, 1).entries, dict[tuple[str, ...], Bound]()
        # a service that all levers have in plenty has no price in their plan, and some of them may still lack it
        self._prices = np.maximum(prices(plan), PENALTY * abs(float(usual.episode_circularity[0])))
        self.together = Trial(simulate_plan(plan), plan.objective)
        self._first = self._worth(usual)
        self._near = SETTLED * abs(self._worth(self.together.run) - self._first)
        self._without: dict[str, Trial] = {}

    def leave_out(self, progress: Callable[[float], None]) -> None:
        """Try what all levers but one do, for each."""
        for done, name in enumerate(self._by_lever):
            progress(done / len(self._by_lever))
            self.without(name)

    def without(self, name: str) -> Trial:
        """Return what all levers but one do."""
        if name not in self._without:
            members = self._by_lever[name]
            rest = [other for other, agents in self._by_lever.items() if not {*agents} & {*members}]
            self._without[name] = self.best(rest)
        return self._without[name]

    def order(self, most: int, progress: Callable[[float], None]) -> list[str]:
        """Return the levers, each the one with which those before it can do most, or do most as they are planned.

        What would come after ``most`` of them is one lever, which is added to those that are known.
        """
        order, value = list[str](), self._first
        rest = dict.fromkeys(self._by_lever, np.inf)  # what each added when it was last tried
        while rest:
            progress(1 - len(rest) ** 2 / len(self._by_lever) ** 2)
            if len(order) == most - 1 and len(rest) > 1:
                name = f"{len(rest)} others"
                self._by_lever[name] = [agent for lever in rest for agent in self._by_lever[lever]]
                return [*order, name]
            if self._solves and order and self._plan.objective - value <= self._near:
                return order + sorted(rest, key=lambda name: -rest[name])
            best, most_added = -np.inf, {name: max(rest[name], self._loss(name)) for name in rest}
            for name in sorted(rest, key=lambda name: -most_added[name]):
                if not self._solves or RISE * most_added[name] >= best:
                    rest[name] = self._promise(self._part_of_plan([*order, name])) - value
                    best = max(best, rest[name])
            order.append(max(rest, key=lambda name: rest[name]))
            value += rest.pop(order[-1])
        return order

    def best(self, names: Iterable[str]) -> Trial:
        """Return the better of two episodes in which these levers are pulled: as all are planned, and these alone."""
        part = self._part_of_plan(names)
        run = simulate_plan(part)
        if not self._solves:
            return Trial(run, None)
        if part.agents not in self._bounds and self._worth(run) >= self._worth(self.together.run) - self._near:
            return Trial(run, self._plan.objective)
        alone = self._bound(part.agents)
        run, plan = max((run, part), (simulate_plan(alone), alone), key=lambda pair: self._worth(pair[0]))

        def is_good(trial: Rollout) -> bool:
            return not self._lacks(trial) and bool(gap(alone.objective, trial.episode_circularity[0]) <= CLOSE)

        if not is_good(run):
            improved = improve_plan(replace(alone, actions=plan.actions), rounds=ROUNDS, enough=is_good)
            run = max(run, simulate_plan(improved), key=self._worth)
        return Trial(run, alone.objective)

    def _loss(self, name: str) -> float:
        """Return what all levers lose without one, by their bounds or in the simulator."""
        trial = self.without(name)
        loss = self._worth(self.together.run) - self._worth(trial.run)
        return loss if trial.bound is None else max(loss, self._plan.objective - trial.bound)

    def _promise(self, part: Bound) -> float:
        return self._bound(part.agents).objective if self._solves else self._worth(simulate_plan(part))

    def _bound(self, agents: tuple[str, ...]) -> Bound:
        if agents not in self._bounds:
            self._bounds[agents] = bound(self._plan.network, min_service=self._plan.min_service, agents=agents)
        return self._bounds[agents]

    def _part_of_plan(self, names: Iterable[str]) -> Bound:
        chosen = {agent for name in names for agent in self._by_lever[name]}
        agents = tuple(agent for agent in self._plan.agents if agent in chosen)
        columns = [entry for agent in agents for entry in range(*self._entries[agent].indices(2**31))]
        return replace(self._plan, agents=agents, actions=self._plan.actions[:, columns])

    def _worth(self, run: Rollout) -> float:
        return penalised_objective(self._plan, run, self._prices)

    def _lacks(self, run: Rollout) -> bool:
        demand = self._plan.min_service
        return demand is not None and bool((run.episode_levels[0] < demand - SHORT).any())


def _agents_by_lever(network: Network, groups: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """Return the agents of each lever by its name; a ``CirlError`` names what is no agent or stands in two levers."""
    supplies = {arc.id for arc in network.arcs if arc.makes_up_for}
    originals = {agent: network.counterpart(agent) or agent for agent in network.agents if agent not in supplies}
    together: dict[str, str] = {}
    for name, members in groups.items():
        for member in members:
            if member not in originals.values():
                raise CirlError(f"groups: '{name}': {unknown_name('agent', member, sorted({*originals.values()}))}")
            if member in together:
                raise CirlError(f"groups: '{member}' is in '{together[member]}' and in '{name}'; a lever has it alone")
            together[member] = name
    titles = Counter(network.compartments[agent].label for agent in originals)
    by_lever: dict[str, list[str]] = {}
    for agent, original in originals.items():
        title = network.compartments[agent].label
        name = title if agent == original and titles[title] == 1 else original.replace("_", " ")
        by_lever.setdefault(together.get(original, name), []).append(agent)
    if len(by_lever) < 2:
        count = "one lever" if by_lever else "no levers"
        raise CirlError(f"network '{network.name}': it has {count}; two or more can be told apart")
    return by_lever
