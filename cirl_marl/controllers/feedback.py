"""Rules of feedback that definitions state: more or less of what an agent does, as stocks and disturbances say."""

from __future__ import annotations

from collections.abc import Container

import numpy as np

from cirl_marl.controllers.basic import Arrays
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network import Floats
from cirl_marl.network.elements import FeedbackRule
from cirl_marl.network.processes import interval_of


class FeedbackRules:
    """The rules of the agents of an environment, who know all stocks and the disturbances of the coming interval.

    Attributes:
        agents: those who have a rule.
    """

    def __init__(self, env: MultiAgentVectorEnv, without: Container[str] = (), *, margin: float = 1.0) -> None:
        """Take the rules of all agents but some; all that they aim at is multiplied by ``margin``."""
        rules = {agent: env.network.compartments[agent].rule for agent in env.agents if agent not in without}
        self._env, self._margin = env, margin
        self._rules: dict[str, FeedbackRule] = {agent: rule for agent, rule in rules.items() if rule is not None}
        self.agents = tuple(self._rules)

    def actions(self, neutral: Arrays) -> dict[str, Floats]:
        """Return the actions of the agents in the coming interval, shape (B, 1) each; see ``FeedbackRule``.

        Those of all agents are ``neutral`` while no rule acts.
        """
        env = self._env
        state, lacks = env.physical, env.lacks()
        levels = {a: np.full_like(neutral[a], r.level) for a, r in self._rules.items() if r.level is not None}
        start = env.control_values({**neutral, **levels})
        values = dict(zip(env.network.processes.names, interval_of(state.disturbances, state.step), strict=True))
        actions = {}
        for agent, rule in self._rules.items():
            value = start[env.network.control_rows[agent].start]
            for name in rule.follows:
                value = value * values[name]
            factor = np.ones_like(value)
            for name, gain in zip(rule.watches, rule.gains, strict=True):
                factor += gain * (1.0 - (1.0 - lacks[name]) / self._margin)
            actions[agent] = env.normalise(agent, (value * factor)[None])
        return actions
