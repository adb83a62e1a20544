"""Independent learners and one shared policy on ``simple_spread`` of MPE2: what each learns with the same experience.

    python benchmarks/spread.py [SEEDS]

Writes ``benchmarks/results/spread.json`` and ``docs/pictures/simple_spread.png``. The shared policy is learnt as
SuperSuit's tutorial has it: every agent is a row of one vector environment. Both have the same PPO, and each agent the
same experience; the returns are those of fresh episodes, the same for both.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from mpe2 import simple_spread_v3
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm

import cirl_marl
from cirl_marl.learners.teams.copies import Copies
from cirl_marl.learners.trainer import one_torch_thread

with warnings.catch_warnings():
    warnings.simplefilter("ignore", UserWarning)
    import supersuit

COPIES, CYCLES, EPISODES = 8, 25, 100
STEPS, POINTS = 200_000, 10
LEARNS: dict[str, Any] = {"n_steps": 250, "batch_size": 500, "n_epochs": 5, "gamma": 0.95, "learning_rate": 1e-3}
RESULTS = Path(__file__).parent / "results" / "spread.json"
PICTURE = Path(__file__).parent.parent / "docs" / "pictures" / "simple_spread.png"
make_env = partial(simple_spread_v3.parallel_env, max_cycles=CYCLES)


def independent(seed: int) -> list[float]:
    """Return the mean return of the team after each tenth of the steps, with a learner for each agent."""
    team = cirl_marl.independent(make_env, partial(PPO, **LEARNS), num_envs=COPIES, seed=seed)
    found = [mean_return({agent: team[agent] for agent in team})]
    for _ in range(POINTS):
        team.learn(STEPS // POINTS)
        found.append(mean_return({agent: team[agent] for agent in team}))
        say("independent", seed, found)
    return found


def shared(seed: int) -> list[float]:
    """Return the same of one policy for all, learnt through SuperSuit's bridge."""
    env = supersuit.pettingzoo_env_to_vec_env_v1(make_env())
    env = supersuit.concat_vec_envs_v1(env, COPIES, num_cpus=1, base_class="stable_baselines3")
    model = PPO("MlpPolicy", env, device="cpu", **{**LEARNS, "batch_size": 1500})  # it takes no seed
    model.set_random_seed = lambda seed=None: None  # type: ignore[method-assign]
    agents = make_env().possible_agents
    found = [mean_return(dict.fromkeys(agents, model))]
    for _ in range(POINTS):
        with one_torch_thread():
            model.learn(len(agents) * STEPS // POINTS, reset_num_timesteps=False)
        found.append(mean_return(dict.fromkeys(agents, model)))
        say("shared", seed, found)
    return found


def mean_return(models: Mapping[str, BaseAlgorithm]) -> float:
    """Return the mean over fresh episodes of the sum of what all agents are paid."""
    copies = Copies(make_env, 10)
    seen = copies.reset(seed=list(range(10**6, 10**6 + 10)))
    paid, ended = 0.0, 0
    while ended < EPISODES:
        actions = {agent: models[agent].predict(seen[agent], deterministic=True)[0] for agent in copies.agents}
        seen, rewards, *_ = copies.step(actions)
        paid += sum(float(each.sum()) for each in rewards.values())
        ended += int(copies.new_episode.sum())
    return paid / ended


def say(kind: str, seed: int, found: list[float]) -> None:
    """Tell how far it is."""
    sys.stderr.write(f"{kind}, seed {seed}: {found[-1]:.1f} after {(len(found) - 1) * STEPS // POINTS:,} steps\n")


def draw(results: dict[str, list[list[float]]]) -> None:
    """Draw the means over seeds, with the lowest and the highest."""
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    steps = np.linspace(0, STEPS, POINTS + 1) / 1000
    for (kind, curves), colour in zip(results.items(), ("#0b6e4f", "#c8553d"), strict=True):
        rows = np.array(curves)
        axes.fill_between(steps, rows.min(axis=0), rows.max(axis=0), color=colour, alpha=0.2, linewidth=0)
        axes.plot(steps, rows.mean(axis=0), color=colour, label=kind)
    axes.set(xlabel="environment steps, thousands", ylabel="return of the team, mean of 100 episodes")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower right")
    figure.savefig(PICTURE, dpi=120)


def main(seeds: int) -> None:
    """Train, write and draw."""
    results = {
        "independent: a PPO for each agent": [independent(seed) for seed in range(seeds)],
        "shared: one PPO for all, through SuperSuit": [shared(seed) for seed in range(seeds)],
    }
    RESULTS.write_text(json.dumps({"steps": STEPS, "copies": COPIES, "returns": results}, indent=2) + "\n")
    draw(results)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
