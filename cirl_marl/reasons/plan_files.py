"""Plans that somebody made, read from the tables that ``cirl simulate`` and ``cirl plan`` write, or from a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.controllers.episode_quantities import QuantityKind, episode_quantities
from cirl_marl.controllers.rollout import episode_start, first_seed, rollout
from cirl_marl.controllers.schedule import control_names
from cirl_marl.definitions.data_files import CsvRows, number_in
from cirl_marl.dynamics.components import simulated_network
from cirl_marl.dynamics.state_layout import StateLayout
from cirl_marl.environments.actuators import Actuators
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RunError, unknown_name
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Floats, Network
from cirl_marl.optimum.options import by_stage
from cirl_marl.reasons.objective_terms import PlannedEpisode
from cirl_marl.records.files import read_content

ALIKE = 1e-4
"""Relative distance of circularities up to which an episode that is simulated again is the one in a table."""


def episodes_of_plan(
    network: Network, plan: str | Path, *, seed: int | None = None, episodes: int = 4
) -> list[PlannedEpisode]:
    """Return the episodes of a plan.

    A table with stocks and flows, as ``cirl simulate`` writes it, is taken as it is. One with controls, as
    ``cirl plan`` writes it, is carried out again from ``episode_start``. The policies of a run play fresh episodes.

    Args:
        network: of which the plan is.
        plan: CSV file or run directory.
        seed: of the start, as it was given to ``cirl plan``; of a run, of its episodes.
        episodes: of a run.

    Raises:
        CirlError: for a file that is no plan of this network; names what is missing or unknown.
        RunError: for a run that is incomplete.
    """
    path = Path(plan)
    if path.is_dir():
        return _episodes_of_run(RunDirectory(path), first_seed(0 if seed is None else seed), episodes)
    table = _Table(path)
    if any(name.startswith("flow of ") for name in table.header):
        return [_simulated_episode(network, table)]
    return [_carry_out(network, table, seed)]


def episode_setting(network: Network, plans: Sequence[object]) -> tuple[Network, tuple[str, ...] | None]:
    """Return the network with the horizon of the first run among plans, and who acts there; None is its own choice.

    Raises:
        RunError: for a run of another network, or of another horizon or other agents than the first.
    """
    setting, agents = network, None
    for plan in plans:
        if not isinstance(plan, str | Path) or not Path(plan).is_dir():
            continue
        run = RunDirectory(plan)
        env = run.make_env(1, uncertain=False)
        if _parts(env.network) != _parts(network):
            raise RunError(
                f"{run.path}: was trained on '{env.network.name}', scenario '{env.network.scenario_name}', not on this"
                f" '{network.name}', scenario '{network.scenario_name}'; what it was trained on is {run.definition}"
            )
        if agents is not None and (env.network.episode, env.agents) != (setting.episode, agents):
            steps = f"{env.network.episode.horizon} steps of {len(env.agents)} agents"
            raise RunError(f"{run.path}: its episodes are {steps}, those of another run are not")
        setting, agents = env.network, env.agents
    return setting, agents


def _parts(network: Network) -> tuple[object, ...]:
    """Return what plans are of: all but how learners were paid, which a recipe may choose."""
    objective = replace(network.objective, circularity_weight=0.5)
    return network.nodes, network.arcs, network.services, objective, network.episode.control_interval


class _Table:
    """A CSV file with a header, whose errors name the file, the line and the column."""

    def __init__(self, path: Path) -> None:
        """Read it; a ``CirlError`` if it cannot be."""
        if not path.is_file():
            raise CirlError(f"{path}: no such file; a plan is a CSV file of cirl plan or cirl simulate, or a run")
        self.path = path
        try:
            content = read_content(path)
        except OSError as error:
            raise CirlError(f"{path}: cannot be read: {error}") from error
        rows = CsvRows(str(path), content)
        self.lines, (self.header, *self.rows) = rows.lines[1:], rows

    def check_steps(self, network: Network, intervals: int) -> None:
        """Check how many intervals it has, which are those of an episode."""
        steps = network.episode.horizon
        if intervals != steps:
            raise CirlError(f"{self.path}: has {intervals} intervals, an episode of '{network.name}' has {steps}")

    def column(self, name: str, first: int = 0) -> Floats:
        """Return the numbers of a column from a row on."""
        if name not in self.header:
            raise CirlError(f"{self.path}: {unknown_name('column', name, self.header)} It is no plan of this network")
        place, numbers = self.header.index(name), []
        for line, row in zip(self.lines[first:], self.rows[first:], strict=True):
            numbers.append(number_in(row[place]))
            if not math.isfinite(numbers[-1]):
                raise CirlError(f"{self.path}, line {line}: '{name}' is {row[place]!r}, not a number")
        return np.array(numbers)


def _simulated_episode(network: Network, table: _Table) -> PlannedEpisode:
    table.check_steps(network, len(table.rows) - 1)
    kinds: tuple[QuantityKind, ...] = ("stock", "flow", "content")
    stocks, flows, contents = ([q.heading for q in episode_quantities(network, kind)] for kind in kinds)
    for name in table.header:
        if name.startswith(("stock of ", "flow of ")) and name not in {*stocks, *flows}:
            columns = sorted({*stocks, *flows})
            raise CirlError(f"{table.path}: {unknown_name('column', name, columns)} It is a plan of another network")
    stock = np.array([table.column(name) for name in stocks]).T
    flow = np.array([table.column(name, 1) for name in flows]).T
    initial = by_stage(network, StateLayout(simulated_network(network)), stock[0])
    shape = (len(network.substances), len(network.compartments), len(flow))
    parts = np.reshape([table.column(name, 1) for name in contents], shape)
    return PlannedEpisode(str(table.path), initial, stock[1:], flow, np.moveaxis(parts, 2, 0))


class _TableController(Controller):
    """Acts as a table of physical controls says, shape (entries, steps)."""

    def __init__(self, values: Floats) -> None:
        self._values, self._step = values, 0

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        self._step, self._actuators = 0, Actuators(env.network, env.agents, 1)

    def act(self, observations: Arrays) -> Arrays:
        step = np.array([self._step])
        self._step += 1
        values, entries = self._values[:, step], self._actuators.entries
        return {agent: self._actuators.normalise(agent, values[rows], step).T for agent, rows in entries.items()}


def _carry_out(network: Network, table: _Table, seed: int | None) -> PlannedEpisode:
    env = MultiAgentVectorEnv(network, num_envs=1)
    table.check_steps(network, len(table.rows))
    values = np.array([table.column(name) for name in control_names(network, env.agents)])
    start = episode_start(env, seed)
    start.reset(env)
    initial = _stocks(env)
    episode = start.play(env, _TableController(values))
    mass, on_file = network.mass_unit, table.column(f"mean circularity ({network.mass_unit})")
    circularity = episode.circularity_mean[0]
    if not np.allclose(circularity, on_file, rtol=ALIKE, atol=ALIKE * float(np.abs(circularity).max(initial=0.0))):
        raise CirlError(
            f"{table.path}: carried out from {start.description} its mean circularity is {circularity.mean():.6g} "
            f"{mass}, but the file says {on_file.mean():.6g}: it is of another start (--seed), scenario or definition"
        )
    return PlannedEpisode(str(table.path), initial, episode.stock, episode.flow, episode.contents)


def _stocks(env: MultiAgentVectorEnv) -> Floats:
    """Return the stocks of the only copy, shape (stocks,), as the simulator has them."""
    return np.asarray(env.physical.stock[env.rows.nodes][:, 0].copy())


def _episodes_of_run(run: RunDirectory, seed: int, count: int) -> list[PlannedEpisode]:
    from cirl_marl.learners.interface import Trained  # it needs torch

    policies, env, episodes = Trained(run), run.make_env(1, uncertain=False), []
    for episode in range(count):
        env.reset(seed=seed + episode)
        initial, outcome = _stocks(env), rollout(env, policies, seed=seed + episode)
        name, parts = f"{run.path}, episode {episode + 1}", (outcome.stock, outcome.flow, outcome.contents)
        episodes.append(PlannedEpisode(name, initial, *parts))
    return episodes
