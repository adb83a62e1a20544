"""Bound and best plan of each network of the catalogue, kept for the pages of the site.

python -m benchmarks.best_plans [NETWORK ...]    # those whose definition has changed since; all of them take an hour

Each network has a file in ``benchmarks/results/plans``: figures, the actions of the plan, and the fingerprint of the
definition that they are of. Who reads it replays the actions in the simulator, so that figures of another definition,
or of another simulator, do not go unnoticed.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cirl_marl import CirlError, MultiAgentVectorEnv, Network, load_network, networks
from cirl_marl.controllers.rollout import episode_start
from cirl_marl.controllers.schedule import Schedule, schedule
from cirl_marl.definitions.writer import fingerprint
from cirl_marl.network import Floats
from cirl_marl.optimum import NoCertificate, Plan, bound, improve_plan, search
from cirl_marl.optimum.planned_episodes import starting_states
from cirl_marl.records.files import write_atomically
from cirl_marl.records.machine import versions

FOLDER = Path(__file__).parent / "results" / "plans"
LEFT_OUT = {"steel_world": "its bound and its plan take minutes and are in docs/cycles.md"}
"""Networks without a file, and why."""
DEMANDED = (1.0, 0.99)
"""Levels of every service that plans are made for: the first that can be had from the middle of the initial ranges."""
SEARCHED = 0.99
"""The same where plans are looked for by simulation."""
ITERATIONS = {"solids_net": 0}
"""Iterations of that search, if not the usual ones; robots are slow: there it is the best of the known controllers."""
USUAL_ITERATIONS = 30
DIGITS = 6
"""Of the actions."""
SHORT = 1e-6
"""What a service may lack of the level that is demanded."""
SERVED_DIGITS = 4
"""Of the level that the bound is proved for instead, where the plan lacks more."""
SAME = 1e-6
"""Relative difference of λ̄ that rounding makes between machines."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BestPlan:
    """The best plan known of a network from the middle of its initial ranges, under its default scenario.

    Attributes:
        network: its name.
        definition_sha256: fingerprint of the definition.
        min_service: level demanded of every service.
        bound: no λ̄ from that start with these services exceeds it, mass; None if nothing is proved.
        reason: why nothing is proved; empty if something is.
        circularity: λ̄ of the plan in the simulator, mass.
        actions: normalised actions of each agent in each control interval, shape (steps, entries).
        versions: of what it was made with.
    """

    network: str
    definition_sha256: str
    min_service: float
    bound: float | None
    reason: str
    circularity: float
    actions: Mapping[str, list[list[float]]]
    versions: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class KeptActions:
    """A plan that ``Plan`` carries out."""

    network: Network
    agents: tuple[str, ...]
    initial: Floats
    actions: Floats


def read_plan(name: str, folder: Path = FOLDER) -> BestPlan:
    """Return the best plan of a network as it was kept.

    Raises:
        CirlError: if none was kept, or if the definition has changed since.
    """
    path = folder / f"{name}.json"
    if not path.is_file():
        raise CirlError(f"{path}: is missing; python -m benchmarks.best_plans {name}")
    found = BestPlan(**json.loads(path.read_text(encoding="utf-8")))
    if found.definition_sha256 != fingerprint(load_network(name)):
        raise CirlError(f"{path}: the definition has changed since; python -m benchmarks.best_plans {name}")
    return found


def replayed(kept: BestPlan) -> Schedule:
    """Return the episode that the kept actions make, beside business as usual.

    Raises:
        CirlError: if the simulator gives another λ̄ than what was kept.
    """
    run = _episode(load_network(kept.network), kept.actions)
    found = float(run.rollout.episode_circularity[0])
    if abs(found - kept.circularity) > SAME * abs(kept.circularity):
        raise CirlError(f"{kept.network}: the kept plan has λ̄ {found!r} in the simulator, not {kept.circularity!r}")
    return run


def _episode(network: Network, actions: Mapping[str, list[list[float]]]) -> Schedule:
    env = MultiAgentVectorEnv(network, num_envs=1)
    episode_start(env, None).reset(env)
    rows = np.concatenate([np.array(actions[agent]) for agent in env.agents], axis=1)
    return schedule(env, Plan(KeptActions(env.network, env.agents, starting_states(env)[0], rows)))


def best_plan(name: str) -> BestPlan:
    """Return the best plan of a network: that of the bound, improved, or where nothing is proved what a search finds.

    Raises:
        CirlError: if none of the levels ``DEMANDED`` can be had, or a solver fails.
    """
    network = load_network(name)
    env = MultiAgentVectorEnv(network, num_envs=1)
    begun = episode_start(env, None)
    begun.reset(env)
    start = env.physical.stock[env.rows.nodes, 0]
    proved, reason, level = None, "", SEARCHED
    try:
        for level in DEMANDED:
            try:
                found = bound(network, start, min_service=level)
                break
            except NoCertificate:
                raise
            except CirlError:
                if level == DEMANDED[-1]:
                    raise
        proved, plan = float(found.objective), improve_plan(found).actions
    except NoCertificate as missing:
        reason, level = str(missing), SEARCHED
        iterations = ITERATIONS.get(name, USUAL_ITERATIONS)
        plan = search(network, begun.initial_state, min_service=level, iterations=iterations).actions
    actions = {agent: np.round(plan[:, rows], DIGITS).tolist() for agent, rows in _entries(env).items()}
    run = _episode(network, actions).rollout
    served = float(run.least_service[0])
    if proved is not None and served < level - SHORT:
        # the bound's program is a relaxation: a plan that serves in full there may lack a little in the simulator
        level = math.floor(served * 10**SERVED_DIGITS) / 10**SERVED_DIGITS
        proved = float(bound(network, start, min_service=level).objective)
    return BestPlan(
        network=name,
        definition_sha256=fingerprint(network),
        min_service=level,
        bound=proved,
        reason=reason,
        circularity=float(run.episode_circularity[0]),
        actions=actions,
        versions=versions(),
    )


def _entries(env: MultiAgentVectorEnv) -> dict[str, slice]:
    """Return the entries of each agent among those of all."""
    sizes = [int(env.action_spaces[agent].shape[0]) for agent in env.agents]
    ends = np.cumsum(sizes).tolist()
    return {agent: slice(end - size, end) for agent, end, size in zip(env.agents, ends, sizes, strict=True)}


def write_plan(found: BestPlan, folder: Path = FOLDER) -> Path:
    """Write a plan, a line for each agent; return its path."""
    path = folder / f"{found.network}.json"
    folder.mkdir(parents=True, exist_ok=True)
    figures = {name: getattr(found, name) for name in BestPlan.__dataclass_fields__ if name != "actions"}
    head = json.dumps(figures, indent=1).removesuffix("\n}")
    rows = ",\n".join(f"  {json.dumps(agent)}: {json.dumps(values)}" for agent, values in found.actions.items())
    text = f'{head},\n "actions": {{\n{rows}\n }}\n}}\n'
    write_atomically(path, lambda partial: partial.write_text(text, encoding="utf-8"))
    return path


def main() -> None:
    """Make the plans that are missing or of another definition."""
    for name in sys.argv[1:] or networks():
        if name in LEFT_OUT:
            continue
        try:
            replayed(read_plan(name))
        except CirlError:
            sys.stdout.write(f"{name} …\n")
            sys.stdout.flush()
            found = best_plan(name)
            sys.stdout.write(f"{write_plan(found)}: λ̄ {found.circularity:.6g}, bound {found.bound}\n")


if __name__ == "__main__":
    main()
