"""Episodes of policies that are watched, and episodes in which others act for some of the agents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RunError
from cirl_marl.network import Floats, Integers

if TYPE_CHECKING:
    from cirl_marl.learners.policies import Policies


@dataclass(frozen=True, slots=True)
class RecordedEpisodes:
    """What agents saw, and what a teacher did there.

    Attributes:
        observations: by agent, shape (steps, B, k).
        actions: of the teacher, by agent, shape (steps, B, entries).
        memories: what each policy remembered before it acted, by name, as its algorithm has it, one a step; zeros at
            first.
    """

    observations: Mapping[str, Floats]
    actions: Mapping[str, Floats]
    memories: Mapping[str, list[Any]]


@dataclass
class Recorder(Controller):
    """Lets a pupil act, or the teacher itself, and keeps what the teacher would have done."""

    teacher: Policies
    pupil: Controller | None = None
    _seen: list[Arrays] = field(default_factory=list)
    _done: list[Arrays] = field(default_factory=list)
    _memories: list[Mapping[str, Any]] = field(default_factory=list)

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Forget what was seen.

        Raises:
            RunError: if an agent sees anything but a row of numbers.
        """
        for agent, space in env.observation_spaces.items():
            if len(getattr(space, "shape", None) or ()) != 1:
                raise RunError(f"agent '{agent}' sees {space}, not a row of named numbers; there is nothing to explain")
        self.teacher.start(env, seed)
        if self.pupil is not None:
            self.pupil.start(env, seed)
        self._seen, self._done, self._memories = [], [], []

    def act(self, observations: Arrays) -> Arrays:
        """Return what the pupil does."""
        self._seen.append({agent: np.array(each, dtype=np.float64) for agent, each in observations.items()})
        self._memories.append(dict(self.teacher.memory))
        actions = self.teacher.act(observations)
        self._done.append({agent: np.array(each, dtype=np.float64) for agent, each in actions.items()})
        return actions if self.pupil is None else self.pupil.act(observations)

    @property
    def seen(self) -> RecordedEpisodes:
        """What was seen and done in the last episodes."""
        agents = self._seen[0]
        return RecordedEpisodes(
            {agent: np.stack([each[agent] for each in self._seen]) for agent in agents},
            {agent: np.stack([each[agent] for each in self._done]) for agent in self._done[0]},
            {name: [each[name] for each in self._memories] for name in self.teacher.policies},
        )


@dataclass
class FixedInputs(Controller):
    """A controller to whom some entries of what agents see are shown at fixed values."""

    controller: Controller
    held: Mapping[str, tuple[Integers, Floats]]

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Start the controller."""
        self.controller.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return what it does when it sees that."""
        shown = dict(observations)
        for agent, (entries, values) in self.held.items():
            shown[agent] = np.array(observations[agent])
            shown[agent][:, entries] = values
        return self.controller.act(shown)


@dataclass
class Substitution(Controller):
    """A controller in whose place others act for some agents."""

    everyone: Controller
    others: Mapping[str, Controller]

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Start all of them."""
        self.everyone.start(env, seed)
        for other in {id(each): each for each in self.others.values()}.values():
            other.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return each agent's action by whoever acts for it."""
        actions = dict(self.everyone.act(observations))
        acted = {id(other): other.act(observations) for other in {id(o): o for o in self.others.values()}.values()}
        return actions | {agent: acted[id(other)][agent] for agent, other in self.others.items()}


def play_episodes(
    env: MultiAgentVectorEnv, controller: Controller, seed: int, progress: Callable[[float], None] = lambda share: None
) -> Rollout:
    """Return the episodes of a controller from the starts of a seed."""
    steps = env.network.episode.horizon
    return rollout(env, controller, seed=seed, progress=lambda done: progress(done / steps))
