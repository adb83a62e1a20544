"""The policies of a run as a controller."""

from __future__ import annotations

from pathlib import Path

from cirl_marl.environments.vector import VectorEnv
from cirl_marl.errors import RunError
from cirl_marl.learners.learner import load_model, load_normaliser
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
            name, view = group.name, group.view(env)
            model = load_model(folder, name, group.spec.algorithm)
            normaliser = load_normaliser(folder, name, group.spec)
            for loaded in (model, normaliser):
                shapes = getattr(loaded, "observation_space", None), getattr(loaded, "action_space", None)
                if loaded is not None and shapes != (view.observation_space, view.action_space):
                    what = f"the policy or normaliser of '{name}'"
                    raise RunError(f"{folder}: {what} is for other observations or actions")
            policies[name] = Policy(model, normaliser, view)
        super().__init__(policies)

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
        super().start(env, seed)
