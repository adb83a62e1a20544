"""The default scenarios pose a problem worth learning: neither stopping nor doing as today is best."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cirl_marl import MultiAgentVectorEnv
from cirl_marl.controllers import Constant, Controller, Neutral
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.learners.interface import train
from cirl_marl.learners.recipe import load_recipe
from cirl_marl.learners.run_directory import RunDirectory

BETTER = {
    "copper_net": {"mine": -0.5, "use_to_landfill": -1.0, "use_to_collection": 0.5, "use": -0.5},
    "carbo_net": {"urban_to_capture": 0.8, "fossil_reserve": 0.2},
}
"""A few constant settings, found by hand, that beat neutral control in λ̄ and in service."""


def run(network: str, controller: Controller) -> Rollout:
    """Return 16 episodes of the default scenario."""
    return rollout(MultiAgentVectorEnv(network, num_envs=16), controller)


@pytest.mark.parametrize("network", sorted(BETTER))
def test_stopping_everything_is_not_the_best_policy(network: str) -> None:
    """It has the best λ̄ of the three but fails the service, and its return is the worst."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    stop = run(network, Constant(dict.fromkeys(env.agents, -1.0)))
    neutral, better = run(network, Neutral()), run(network, Constant(BETTER[network]))
    assert stop.episode_circularity.mean() > neutral.episode_circularity.mean()
    assert stop.episode_service.mean() < neutral.episode_service.mean()
    assert stop.returns.mean() < neutral.returns.mean() < better.returns.mean()


@pytest.mark.parametrize("network", sorted(BETTER))
def test_there_is_room_above_neutral(network: str) -> None:
    """Constant settings raise λ̄ and do not lower the service level: the two goals can be reached together."""
    neutral, better = run(network, Neutral()), run(network, Constant(BETTER[network]))
    assert np.all(better.episode_circularity > neutral.episode_circularity)
    assert better.episode_service.mean() >= neutral.episode_service.mean()


@pytest.mark.slow
@pytest.mark.medium
def test_learners_raise_their_returns_together(tmp_path: Path) -> None:
    """A twentieth of the default run already lifts the mean return of the sixteen agents well above where it began."""
    recipe = load_recipe("independent_ars")
    brief = recipe.model_copy(update={"run": recipe.run.model_copy(update={"evaluations": 1, "episodes": 8})})
    train("copper_net", brief, directory=tmp_path / "run", steps=300_000, seed=0)
    metrics = RunDirectory(tmp_path / "run").metrics()
    returns = np.mean([values for name, values in metrics.items() if name.startswith("return:")], axis=0)
    assert returns[-1] - returns[0] > 0.2 * abs(returns[0])
    assert metrics["service_level"][-1] > metrics["service_level"][0]
