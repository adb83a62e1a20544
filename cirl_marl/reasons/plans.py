"""Plans that somebody made, read from the tables that ``cirl simulate`` and ``cirl plan`` write, or from a run."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.controllers.rollout import episode_start, first_seed, rollout
from cirl_marl.controllers.schedule import control_names
from cirl_marl.environments.actuators import Actuators
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RunError, unknown
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Floats, Network
from cirl_marl.optimum.options import by_stage
from cirl_marl.reasons.objective_terms import PlannedEpisode

ALIKE = 1e-4
"""Relative distance of circularities up to which an episode that is simulated again is the one in a table."""


def episodes_of_plan(
    network: Network, plan: str | Path, *, seed: int | None = None, episodes: int = 4
) -> list[PlannedEpisode]:
    """Return the episodes of a plan.

    A table with stocks and flows, as ``cirl simulate`` writes it, is taken as it is. One with controls alone, as
    ``cirl plan`` writes it, is carried out again from ``beginning``. The policies of a run play fresh episodes.

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
        return _of_run(RunDirectory(path), 0 if seed is None else seed, episodes)
    header, rows = _table(path)
    if any(each.startswith("stock of ") for each in header):
        return [_of_trajectory(network, path, header, rows)]
    return [_of_controls(network, path, header, rows, seed)]


def episode_setting(network: Network, plans: Sequence[object]) -> tuple[Network, tuple[str, ...] | None]:
    """Return the network with the horizon of the first run among plans, and who acts there; None is its own choice.

    Raises:
        RunError: for a run of another network, or of another horizon or other agents than the first.
    """
    found, agents = network, None
    for plan in plans:
        if not isinstance(plan, str | Path) or not Path(plan).is_dir():
            continue
        run = RunDirectory(plan)
        env = run.make_env(1, uncertain=False)
        theirs = env.network
        if _parts(theirs) != _parts(network):
            raise RunError(
                f"{run.path}: was trained on '{theirs.name}', scenario '{theirs.scenario_name}', not on this"
                f" '{network.name}', scenario '{network.scenario_name}'; what it was trained on is {run.definition}"
            )
        if agents is not None and (theirs.episode, env.agents) != (found.episode, agents):
            steps = f"{theirs.episode.horizon} steps of {len(env.agents)} agents"
            raise RunError(f"{run.path}: its episodes are {steps}, those of another run are not")
        found, agents = theirs, env.agents
    return found, agents


def _parts(network: Network) -> tuple[object, ...]:
    return network.nodes, network.arcs, network.services, network.objective, network.episode.control_interval


def _table(path: Path) -> tuple[list[str], list[list[str]]]:
    if not path.is_file():
        raise CirlError(f"{path}: no such file; a plan is a CSV file of cirl plan or cirl simulate, or a run")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file))
    except (ValueError, UnicodeDecodeError, csv.Error) as error:
        raise CirlError(f"{path}: is no CSV file with a header: {error}") from error
    for line, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise CirlError(f"{path}, line {line}: has {len(row)} cells, the header has {len(header)}")
    return header, rows


def _number(path: Path, line: int, column: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise CirlError(f"{path}, line {line}: '{column}' is {cell!r}, not a number")
    return value


def _column(path: Path, header: list[str], rows: list[list[str]], name: str, first: int = 0) -> Floats:
    if name not in header:
        raise CirlError(f"{path}: {unknown('column', name, header)} It is no plan of this network")
    place = header.index(name)
    return np.array([_number(path, first + i + 2, name, row[place]) for i, row in enumerate(rows[first:])])


def _of_trajectory(network: Network, path: Path, header: list[str], rows: list[list[str]]) -> PlannedEpisode:
    mass, steps = network.mass_unit, network.episode.horizon
    rate = f"{mass}/{network.time_unit}"
    if len(rows) != steps + 1:
        raise CirlError(f"{path}: has {len(rows) - 1} intervals, an episode of '{network.name}' has {steps}")
    wanted = [f"stock of {node.id} ({mass})" for node in network.stores]
    known = {*wanted, *(f"flow of {arc.id} ({rate})" for arc in network.arcs)}
    for each in header:
        if each.startswith(("stock of ", "flow of ")) and each not in known:
            raise CirlError(f"{path}: {unknown('column', each, sorted(known))} It is a plan of another network")
    stock = np.array([_column(path, header, rows, each) for each in wanted]).T
    flow = np.array([_column(path, header, rows, f"flow of {arc.id} ({rate})", 1) for arc in network.arcs]).T
    return PlannedEpisode(str(path), by_stage(network, stock[0]), stock[1:], flow)


class _Given(Controller):
    """Holds controls that a table has."""

    def __init__(self, values: Floats) -> None:
        """Take physical values, shape (entries, steps)."""
        self._values, self._step = values, 0

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        self._env, self._step = env, 0
        self._actuators = Actuators(env.network, env.agents, 1)

    def act(self, observations: Arrays) -> Arrays:
        step = np.array([self._step])
        found: Mapping[str, Floats] = {
            agent: self._actuators.normalise(agent, self._values[entries, self._step][:, None], step).T
            for agent, entries in self._actuators.entries.items()
        }
        self._step += 1
        return found


def _of_controls(
    network: Network, path: Path, header: list[str], rows: list[list[str]], seed: int | None
) -> PlannedEpisode:
    env = MultiAgentVectorEnv(network, num_envs=1)
    steps = network.episode.horizon
    if len(rows) != steps:
        raise CirlError(f"{path}: has {len(rows)} intervals, an episode of '{network.name}' has {steps}")
    values = np.array([_column(path, header, rows, name) for name in control_names(network, env.agents)])
    begun = episode_start(env, seed)
    begun.reset(env)
    initial = _stocks(env)
    run = rollout(env, _Given(values), seed=begun.seed, start=begun.initial_state)
    told = _column(path, header, rows, f"mean circularity ({network.mass_unit})")
    found = run.circularity_mean[0]
    if not np.allclose(found, told, rtol=ALIKE, atol=ALIKE * float(np.abs(found).max(initial=0.0))):
        raise CirlError(
            f"{path}: carried out from {begun.description} its mean circularity is {found.mean():.6g} "
            f"{network.mass_unit}, but the file says {told.mean():.6g}: "
            "it is of another start (--seed), scenario or definition"
        )
    return PlannedEpisode(str(path), initial, run.stock, run.flow)


def _stocks(env: MultiAgentVectorEnv) -> Floats:
    """Return the stocks of the only copy, shape (stocks,), as the simulator has them."""
    found: Floats = env.physical.stock[env.rows.nodes][:, 0].copy()
    return found


def _of_run(run: RunDirectory, seed: int, episodes: int) -> list[PlannedEpisode]:
    from cirl_marl.learners.interface import Trained  # it needs torch

    policies, env, found = Trained(run), run.make_env(1, uncertain=False), []
    for episode in range(episodes):
        first = first_seed(seed) + episode
        env.reset(seed=first)
        initial, played = _stocks(env), rollout(env, policies, seed=first)
        found.append(PlannedEpisode(f"{run.path}, episode {episode + 1}", initial, played.stock, played.flow))
    return found
