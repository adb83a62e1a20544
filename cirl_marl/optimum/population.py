"""Many episodes from the same starts, side by side: what a search by simulation tries its plans on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cirl_marl.controllers.basic import Controller
from cirl_marl.controllers.rollout import EVALUATION_SEEDS
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers, Network


@dataclass(frozen=True, slots=True)
class Episodes:
    """What episodes were like, for each start and each copy that began there.

    Attributes:
        circularity: λ̄, shape (starts, copies), mass.
        service: mean service level, shape (starts, copies).
        levels: mean level of each service, shape (services, starts, copies).
        actions: normalised actions, shape (steps, entries, starts, copies).
        deviation: mean between knots of what actions, once clipped, had beyond the controller's, shape
            (starts, copies, knots, entries).
    """

    circularity: Floats
    service: Floats
    levels: Floats
    actions: Floats
    deviation: Floats


class Population:
    """Copies of a network, equally many from each of some starts."""

    def __init__(self, network: Network, agents: Sequence[str] | None, starts: Floats, size: int) -> None:
        """Make the environment and put its copies where they start.

        Args:
            network: under its scenario and horizon.
            agents: who acts; None is the network's own choice.
            starts: stocks and inner states, the first of ``MultiAgentVectorEnv.state_names``, shape (starts, rows).
            size: copies from each start.

        Raises:
            CirlError: for starts that no episode can begin with, or if nobody acts.
        """
        self._shape = (len(starts), size)
        self._env = env = MultiAgentVectorEnv(network, num_envs=len(starts) * size, agents=agents)
        if not env.agents:
            raise CirlError(f"network '{network.name}': nobody acts, so there is nothing to search for")
        self.agents = env.agents
        env.reset(seed=EVALUATION_SEEDS, options={"initial_state": named(env, np.repeat(starts, size, axis=0))})
        self._start = env.snapshot()

    @property
    def entries(self) -> int:
        """Entries of a stacked action."""
        return sum(neutral.shape[1] for neutral in self._env.neutral_action.values())

    def run(
        self,
        controllers: Sequence[Controller],
        which: Integers,
        deviation: Floats,
        progress: Callable[[float], None] = lambda share: None,
    ) -> Episodes:
        """Run an episode in every copy.

        Args:
            controllers: each has to act for all copies.
            which: whose actions each copy takes, shape (starts, copies).
            deviation: what is added to them between knots, shape (starts, copies, knots, entries).
            progress: called with the share of the episode that is done.
        """
        env, shape = self._env, self._shape
        observations = env.restore(self._start)
        taken = which.ravel()
        acting = {int(i): controllers[i] for i in np.unique(taken)}
        for controller in acting.values():
            controller.start(env, EVALUATION_SEEDS)
        steps, knots = env.network.episode.horizon, deviation.shape[2]
        added = np.ascontiguousarray(np.moveaxis(deviation.reshape(len(taken), knots, -1), 0, 2))
        realised, counts = np.zeros_like(added), np.bincount(np.arange(steps) * knots // steps, minlength=knots)
        actions = np.empty((steps, *added.shape[1:]))
        for t in range(steps):
            unchanged = actions[t]
            for i, controller in acting.items():
                np.copyto(unchanged, env.stack(controller.act(observations)), where=taken == i)
            knot = t * knots // steps
            clipped = np.clip(unchanged + added[knot], -1.0, 1.0)
            realised[knot] += clipped - unchanged
            actions[t] = clipped
            observations = env.by_agent(env.advance(clipped).observation)
            progress((t + 1) / steps)
        realised /= counts[:, None, None]
        state = env.physical
        levels = state.service / steps
        return Episodes(
            (state.circularity / steps).reshape(shape),
            env.scoring.service_level(levels).reshape(shape),
            levels.reshape(-1, *shape),
            actions.reshape(*actions.shape[:2], *shape),
            np.moveaxis(realised, 2, 0).reshape(deviation.shape),
        )


def starting_states(env: MultiAgentVectorEnv) -> Floats:
    """Return the stocks and inner states in which the copies of ``env`` are, shape (copies, rows)."""
    state = env.physical
    return env.rows.start_of(state.stock, state.inner).T


def named(env: MultiAgentVectorEnv, starts: Floats) -> dict[str, Floats]:
    """Return stocks and inner states, shape (copies, rows), by their names, shape (copies,) each.

    Raises:
        CirlError: for another shape.
    """
    names = env.rows.start_names
    if starts.ndim != 2 or starts.shape[1] != len(names):
        raise CirlError(f"initial has shape {starts.shape}, expected (starts, {len(names)})")
    return dict(zip(names, starts.T, strict=True))
