"""The policies of a run as a controller."""

from __future__ import annotations

from pathlib import Path

from stable_baselines3.common.vec_env import VecNormalize

from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RunError
from cirl_marl.learners.learner import learnt
from cirl_marl.learners.policies import Policies, Policy
from cirl_marl.learners.run import RunDirectory


class Trained(Policies):
    """Acts by the policies of the checkpoint that a run has chosen.

    ``checkpoint`` is the folder from which they were loaded; a run that is being trained has others later.
    """

    def __init__(self, run: str | Path | RunDirectory) -> None:
        """Load every policy; a ``RunError`` if the run is incomplete or a file of it cannot be read."""
        self.run = run if isinstance(run, RunDirectory) else RunDirectory(run)
        self.checkpoint = folder = self.run.chosen
        env = self.run.make_env(1)
        self._seen = env.layout.names
        policies: dict[str, Policy] = {}
        for group in self.run.groups():
            learner = learnt(folder, group, env)
            normaliser = learner.env if isinstance(learner.env, VecNormalize) else None
            policies[group.name] = Policy(learner.model, normaliser, learner.seat.view)
        super().__init__(policies)

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
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
        super().start(env, seed)
