"""The policies of a run as a controller."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.controllers.basic import Arrays
from cirl_marl.errors import RunError
from cirl_marl.learners.run import RunDirectory
from cirl_marl.learners.trainee import load_model, load_normaliser
from cirl_marl.vector_env import VectorEnv


class Trained:
    """Acts by the deterministic policies of a run's newest checkpoint, with their normalisers frozen."""

    def __init__(self, run: str | Path | RunDirectory) -> None:
        """Load every policy.

        Raises:
            RunError: if the run is incomplete or a file of it cannot be read.
        """
        self.run = run if isinstance(run, RunDirectory) else RunDirectory(run)
        config, folder = self.run.config, self.run.checkpoint
        network = self.run.make_env(1).network
        specs = {agent: config.recipe.learner_of(agent, network) for agent in config.agents}
        self._models = {agent: load_model(folder, agent, spec.algorithm) for agent, spec in specs.items()}
        self._normalisers = {agent: load_normaliser(folder, agent, spec) for agent, spec in specs.items()}
        self._memory: dict[str, Any] = {}
        self._starts = np.ones(1, dtype=bool)

    def start(self, env: VectorEnv, seed: int) -> None:
        """Forget the last episode.

        Raises:
            RunError: if ``env`` has other agents than the run.
        """
        if set(env.agents) != set(self._models):
            raise RunError(f"{self.run.path}: trained {sorted(self._models)}, not {sorted(env.agents)}")
        self._memory = dict.fromkeys(self._models)
        self._starts = np.ones(env.num_envs, dtype=bool)

    def act(self, observations: Arrays) -> Arrays:
        """Return each policy's deterministic action."""
        actions: dict[str, NDArray[np.floating]] = {}
        for agent, model in self._models.items():
            seen = np.ascontiguousarray(observations[agent])
            normaliser = self._normalisers[agent]
            if normaliser is not None:
                seen = normaliser.normalize_obs(seen)  # type: ignore[assignment]
            actions[agent], self._memory[agent] = model.predict(
                seen, self._memory[agent], self._starts, deterministic=True
            )
        self._starts = np.zeros_like(self._starts)
        return actions
