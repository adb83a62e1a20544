"""The policies of a run as a controller."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.environments.vector import VectorEnv
from cirl_marl.errors import RunError
from cirl_marl.learners.learner import load_model, load_normaliser
from cirl_marl.learners.run import RunDirectory
from cirl_marl.learners.views import unseen_state


class Trained(Controller):
    """Acts by the deterministic policies of a run's newest checkpoint, with their normalisers frozen.

    ``checkpoint`` is the folder from which they were loaded; a run that is being trained has others later.
    """

    def __init__(self, run: str | Path | RunDirectory) -> None:
        """Load every policy; a ``RunError`` if the run is incomplete or a file of it cannot be read."""
        self.run = run if isinstance(run, RunDirectory) else RunDirectory(run)
        self.checkpoint = folder = self.run.checkpoint
        groups = self.run.groups()
        env = self.run.make_env(1)
        self._seen = env.layout.names
        self._views = {group.name: group.view(env) for group in groups}
        self._models = {group.name: load_model(folder, group.name, group.spec.algorithm) for group in groups}
        self._normalisers = {group.name: load_normaliser(folder, group.name, group.spec) for group in groups}
        for name, view in self._views.items():
            for loaded in (self._models[name], self._normalisers[name]):
                shapes = getattr(loaded, "observation_space", None), getattr(loaded, "action_space", None)
                if loaded is not None and shapes != (view.observation_space, view.action_space):
                    what = f"the policy or normaliser of '{name}'"
                    raise RunError(f"{folder}: {what} is for other observations or actions")
        self._memory: dict[str, Any] = {}
        self._starts = np.ones(1, dtype=bool)

    def start(self, env: VectorEnv, seed: int) -> None:
        """Forget the last episode; a ``RunError`` if ``env`` has other agents, or shows them something else."""
        if set(env.agents) != set(self._seen):
            raise RunError(f"{self.run.path}: trained {sorted(self._seen)}, not {sorted(env.agents)}")
        for agent, seen in self._seen.items():
            if (shown := env.layout.names[agent]) != seen:
                other = next((name for name in shown if name not in seen), f"{len(shown)} entries, not {len(seen)}")
                raise RunError(
                    f"{self.run.path}: '{agent}' learnt from other observations than this environment's ({other}); "
                    "make the environment with the options of the run, as its make_env() does"
                )
        self._memory = dict.fromkeys(self._models)
        self._starts = np.ones(env.num_envs, dtype=bool)
        self._state = unseen_state(env)

    def act(self, observations: Arrays) -> Arrays:
        """Return each policy's deterministic action, which depends on the observations of its agents alone."""
        actions: dict[str, NDArray[np.floating]] = {}
        for name, model in self._models.items():
            view, normaliser = self._views[name], self._normalisers[name]
            seen = view.observe(observations, self._state)
            if normaliser is not None:
                seen = normaliser.normalize_obs(seen)
            starts = np.tile(self._starts, max(1, len(view.row_agents)))
            chosen, self._memory[name] = model.predict(seen, self._memory[name], starts, deterministic=True)
            actions.update(view.act(chosen))
        self._starts = np.zeros_like(self._starts)
        return actions
