"""solids_net: what a slower robot brings, and what learners do there (docs/study.md).

python -m benchmarks.solids             # scripts that wait in each attempt
python -m benchmarks.solids RUN [RUN …]  # whom a run has acts as it learnt, the others by script
python -m benchmarks.solids RUN --carry 0.4  # and the robot carries what it holds at 0.4 of its speed
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecNormalize

from cirl_marl.controllers.rollout import first_seed
from cirl_marl.controllers.scripted import ScriptController
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.evaluation.statistics import over_episodes, over_seeds
from cirl_marl.learners.learner import Learner, load_acting_learner
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Floats

EPISODES = 16
WAITS = ((0, 0), (0, 10), (0, 28), (28, 28), (50, 50))
"""Steps that the robot waits in each attempt at an item of the first and of the second batch."""
SECOND_BATCH = 200
"""Interval in which the second batch leaves the reservoir: after 8 s of 0.04 s each."""
WITHIN_GRIP = 0.03
"""Distance from the gripper, m, within which an item is held once the gripper closes."""
REST = np.array([0.0, 0.0, 0.0, 1.0])
"""Action of the robot that moves nothing and keeps the gripper open."""

Actions = dict[str, NDArray[np.floating]]
Act = Callable[[MultiAgentVectorEnv, int, Actions, Actions], Actions]
"""From the environment, the interval, what is seen and what the script does to what is done instead."""


@dataclass
class Episodes:
    """What came of the episodes: mass, levels, and numbers of items and loads, shape (episodes,)."""

    circularity: Floats
    service: Floats
    sorted: Floats
    missed: Floats
    loads: Floats

    def __str__(self) -> str:
        """Return a row of a table."""
        found = over_episodes(self.circularity)
        items = (self.sorted, self.missed, self.loads)
        numbers = ", ".join(
            f"{name} {each.mean():.2f}" for name, each in zip(("sorted", "missed", "loads"), items, strict=True)
        )
        return f"λ̄ {found.value:.1f} ± {found.high - found.value:.1f} kg, service {self.service.mean():.4f}, {numbers}"


def main(
    runs: Annotated[list[Path] | None, typer.Argument(help="Runs in solids_net; default: scripts that wait.")] = None,
    carry: Annotated[float, typer.Option(min=0.0, max=1.0, help="Part of its speed at which the robot carries.")] = 1.0,
) -> None:
    """Play episodes and print what came of them: a row for each run, and what they have in common."""
    if not runs:
        for waits in WAITS:
            typer.echo(f"waits {waits}: {played(partial(_waiting, waits))}")
        return
    found = [played(_carrying(_learnt(run), carry)) for run in runs]
    for run, each in zip(runs, found, strict=True):
        typer.echo(f"{run.name}: {each}")
    if len(found) > 1:
        means = [
            over_seeds([float(getattr(each, name).mean()) for each in found]) for name in ("circularity", "service")
        ]
        told = ", ".join(f"{each.value:.4g} [{each.low:.4g}, {each.high:.4g}]" for each in means)
        typer.echo(f"interquartile means of λ̄ (kg) and service over {len(found)} seeds, bootstrap intervals: {told}")


def played(act: Act) -> Episodes:
    """Play episodes by script, but for what ``act`` gives."""
    env, script = MultiAgentVectorEnv("solids_net", num_envs=EPISODES), ScriptController()
    seen = env.reset(seed=first_seed(0))
    script.start(env, 0)
    place = {name: env.state_names.index(name) for name in ("sorter.sorted_now", "sorter.missed_now")}
    bound = env.state_names.index("truck.destination_m")
    items, loads, before = np.zeros((2, EPISODES)), np.zeros(EPISODES), np.zeros(EPISODES)
    infos: dict[str, Any] = {}
    for t in range(env.network.episode.horizon):
        actions: Actions = dict(script.act(seen))
        seen, _, _, _, infos = env.step(actions | act(env, t, dict(seen), actions))
        last = infos["sorter"].get("final_info", {}).get("state")
        state = env.state() if last is None else last
        items += state[:, list(place.values())].T
        loads += (before > 0) & (state[:, bound] == 0)
        before = state[:, bound]
    told = infos["sorter"]
    return Episodes(told["episode_circularity"], told["episode_service_level"], items[0], items[1], loads)


def _waiting(waits: tuple[int, int], env: MultiAgentVectorEnv, t: int, _seen: Actions, script: Actions) -> Actions:
    """Rest in the first steps of each attempt."""
    attempt = env.state()[:, env.state_names.index("sorter.attempt_step")]
    rests = attempt < waits[t >= SECOND_BATCH]
    return {"sorter": np.where(rests[:, None], REST, script["sorter"])}


def _learnt(run: Path) -> Act:
    """Return what the learners of a run do, each for its own agent."""
    directory = RunDirectory(run)
    env = directory.make_env(1)
    policies = {
        group.name: _policy(load_acting_learner(directory.acting_checkpoint, group, env))
        for group in directory.groups()
    }
    return lambda _env, _t, seen, _script: {agent: act(seen[agent]) for agent, act in policies.items()}


def _carrying(act: Act, speed: float) -> Act:
    """Return ``act`` with a robot that moves at a part of its speed while it holds an item."""

    def slowly(env: MultiAgentVectorEnv, t: int, seen: Actions, script: Actions) -> Actions:
        actions = act(env, t, seen, script)
        if "sorter" not in actions or speed == 1.0:
            return actions
        names = env.layout.names["sorter"]
        from_grip = seen["sorter"][:, [names.index(f"sorter.object_from_grip_{axis}") for axis in "xyz"]]
        moved = np.clip(actions["sorter"], -1.0, 1.0)
        held = (moved[:, 3] < 0) & (np.linalg.norm(from_grip, axis=1) < WITHIN_GRIP)
        moved[held, :3] *= speed
        return actions | {"sorter": moved}

    return slowly


def _policy(learner: Learner) -> Callable[[NDArray[np.floating]], NDArray[np.floating]]:
    model, normaliser = learner.model, learner.env if isinstance(learner.env, VecNormalize) else None

    def act(seen: NDArray[np.floating]) -> NDArray[np.floating]:
        shown: Any = seen if normaliser is None else normaliser.normalize_obs(seen)
        return model.predict(shown, deterministic=True)[0]

    return act


if __name__ == "__main__":
    typer.run(main)
