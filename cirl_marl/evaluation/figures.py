"""The figures that compare controllers, and what they depend on: command, versions, network and runs."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cirl_marl.controllers.indicators import indicators
from cirl_marl.controllers.outcome import time_window
from cirl_marl.controllers.rollout import Rollout
from cirl_marl.definitions.writer import fingerprint
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.evaluation.statistics import SHARE, Aggregate, over_episodes, worst_mean
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Floats, Network
from cirl_marl.optimum.bounds import relative
from cirl_marl.records.files import sha256_of
from cirl_marl.records.machine import versions


def gain(rollout_: Rollout, neutral: Rollout) -> Floats:
    """Return the circularity gain (λ̄ − λ̄_neutral)/|λ̄_neutral| of each episode, shape (B,); NaN where λ̄_neutral = 0."""
    reference = neutral.episode_circularity
    return relative(rollout_.episode_circularity - reference, reference)


def summary(env: MultiAgentVectorEnv, rollouts: Mapping[str, Rollout]) -> dict[str, Any]:
    """Return the figures of each controller beside those of ``neutral``, ready for JSON.

    Each figure is a mean over episodes with its 95 % confidence interval; gains are paired, episode by episode, with
    the neutral controller's from the same start. What is ``worst`` is the mean of the 5 % worst episodes. Indicators
    are those of the mean flows. A network that states the criticality of its material has its time-window circularity
    as well (see ``time_window``).
    """
    neutral = rollouts["neutral"]
    figures = {}
    for name, run in rollouts.items():
        figures[name] = {
            "circularity": over_episodes(run.episode_circularity).as_dict(),
            "circularity_gain": over_episodes(gain(run, neutral)).as_dict(),
            "service_level": over_episodes(run.episode_service, SHARE).as_dict(),
            "service_levels": _by_service(env, [over_episodes(row, SHARE) for row in run.episode_levels.T]),
            "worst_circularity": worst_mean(run.episode_circularity).as_dict(),
            "worst_service_levels": _by_service(env, [worst_mean(row) for row in run.episode_levels.T]),
            "service_level_over_neutral": over_episodes(run.episode_service - neutral.episode_service).as_dict(),
            "return": _by_agent(env, run.returns),
            "local_return": _by_agent(env, run.local_returns),
        }
        if env.network.accounts:
            totals = zip(env.network.accounts, run.accounts.T, strict=True)
            figures[name]["accounts"] = {account.id: over_episodes(row).as_dict() for account, row in totals}
        if found := indicators(env.network, run.mean_flow):
            figures[name]["indicators"] = asdict(found)
        if (of_window := time_window(env.network, run)) is not None:
            figures[name]["time_window_circularity"] = over_episodes(of_window).as_dict()
    return {"unit": env.network.mass_unit, "episodes": env.num_envs, "controllers": figures}


def _by_service(env: MultiAgentVectorEnv, figures: Sequence[Aggregate]) -> dict[str, Any]:
    return {service.id: figure.as_dict() for service, figure in zip(env.network.services, figures, strict=True)}


def _by_agent(env: MultiAgentVectorEnv, samples: Floats) -> dict[str, Any]:
    return {agent: over_episodes(row).as_dict() for agent, row in zip(env.agents, samples, strict=True)}


def provenance(network: Network, runs: Sequence[RunDirectory] = (), **options: Any) -> dict[str, Any]:
    """Return what a result depends on, ready for JSON: network, training runs, and what else was asked for."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "versions": versions(),
        "network": {
            "name": network.name,
            "scenario": network.scenario_name,
            "file_sha256": network.source_sha256,
            "data_sha256": dict(network.data_sha256),
            "definition_sha256": fingerprint(network),
        },
        "options": options,
        "runs": [_run(run) for run in runs],
    }


def _run(run: RunDirectory) -> dict[str, Any]:
    config, status = run.config, run.status
    return {
        "directory": str(run.path),
        "recipe": config.recipe.name,
        "seed": config.seed,
        "state": status["state"],
        "joint_steps": status["joint_steps"],
        "config_sha256": sha256_of(run.path / "config.json"),
        "network_sha256": sha256_of(run.definition),
        "data_sha256": config.data_sha256,
        "policies_sha256": {
            group.name: sha256_of(run.acting_checkpoint / f"{group.name}.safetensors") for group in run.groups()
        },
    }
