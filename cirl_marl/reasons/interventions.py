"""Episodes of policies: recorded ones, and such with some inputs held fixed or some agents replaced."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RunError
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record

if TYPE_CHECKING:
    from cirl_marl.learners.policies import Policies


@positional_record
class RecordedEpisodes:
    """What agents saw, and what the expert did there."""

    observations: Annotated[Mapping[str, Floats], "by agent, shape (steps, B, k)"]
    actions: Annotated[Mapping[str, Floats], "of the expert, by agent, shape (steps, B, entries)"]
    memories: Annotated[
        Mapping[str, list[Any]],
        "what each policy remembered before it acted, by name, as its algorithm has it, one a step; zeros at first",
    ]


@dataclass
class Recorder(Controller):
    """Lets the imitator act, or the expert itself, and records what the expert would have done (as DAgger does)."""

    expert: Policies
    imitator: Controller | None = None
    _steps: list[tuple[Arrays, Arrays, Mapping[str, Any]]] = field(default_factory=list)

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Forget earlier episodes.

        Raises:
            RunError: if an agent sees anything but a row of numbers.
        """
        for agent, space in env.observation_spaces.items():
            if len(getattr(space, "shape", None) or ()) != 1:
                raise RunError(f"agent '{agent}' sees {space}, not a row of named numbers; there is nothing to explain")
        self.expert.start(env, seed)
        if self.imitator is not None:
            self.imitator.start(env, seed)
        self._steps = []

    def act(self, observations: Arrays) -> Arrays:
        """Return what the imitator does."""
        inputs, memory = _copies(observations), dict(self.expert.memory)
        actions = self.expert.act(observations)
        self._steps.append((inputs, _copies(actions), memory))
        return actions if self.imitator is None else self.imitator.act(observations)

    @property
    def episodes(self) -> RecordedEpisodes:
        """What was seen and done in the last episodes."""
        observations, actions, memories = zip(*self._steps, strict=True)
        return RecordedEpisodes(
            {agent: np.stack([step[agent] for step in observations]) for agent in observations[0]},
            {agent: np.stack([step[agent] for step in actions]) for agent in actions[0]},
            {name: [memory[name] for memory in memories] for name in self.expert.policies},
        )


def _copies(arrays: Arrays) -> Arrays:
    return {agent: np.array(values, dtype=np.float64) for agent, values in arrays.items()}


@dataclass
class FixedInputs(Controller):
    """A controller to whom some entries of what agents see are shown at fixed values, by agent: entries and values."""

    controller: Controller
    constants: Mapping[str, tuple[Integers, Floats]]

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Start the controller."""
        self.controller.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return what it does when it sees that."""
        inputs = dict(observations)
        for agent, (entries, values) in self.constants.items():
            inputs[agent] = np.array(observations[agent])
            inputs[agent][:, entries] = values
        return self.controller.act(inputs)


@dataclass
class Substitution(Controller):
    """A controller in whose place a substitute acts for some agents."""

    controller: Controller
    substitute: Controller
    agents: Collection[str]

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Start both."""
        self.controller.start(env, seed)
        self.substitute.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return each agent's action by whoever acts for it."""
        actions, substitutes = self.controller.act(observations), self.substitute.act(observations)
        return {**actions, **{agent: substitutes[agent] for agent in self.agents}}
