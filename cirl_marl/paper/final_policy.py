"""What a final policy is worth: fresh episodes that no training saw."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from cirl_marl.paper.published import PaperEnvironment
from cirl_marl.paper.results import Evaluation

EVALUATION_EPISODES = 100
EVALUATION_COPIES = 20

Report = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""
Predict = Callable[[Any, Any, NDArray[np.bool_]], tuple[NDArray[Any], Any]]
"""From observations, recurrent state and episode starts to deterministic actions and the next recurrent state."""


def evaluation_episodes(environment: PaperEnvironment, asked: int | None) -> int:
    """Return how many episodes a final policy plays: as many as ``asked``, else 100, or the paper's that succeed."""
    return asked or environment.success_episodes or EVALUATION_EPISODES


def predictor(model: BaseAlgorithm, normalise: Callable[[Any], Any] = lambda observation: observation) -> Predict:
    """Return the deterministic policy of ``model`` behind the normalisation that it was trained with."""

    def predict(observation: Any, state: Any, starts: NDArray[np.bool_]) -> tuple[NDArray[Any], Any]:
        return model.predict(normalise(observation), state, starts, deterministic=True)

    return predict


def evaluate(
    id_: str, predict: Predict, episodes: int, seed: int, report: Report, options: dict[str, Any], *, warm_up: int = 0
) -> Evaluation:
    """Return mean return and share of successes of ``episodes`` fresh episodes.

    Each copy plays a fixed number of episodes, so that short ones are not favoured, after ``warm_up`` that do not
    count.
    """
    copies = min(EVALUATION_COPIES, episodes)
    env = DummyVecEnv([lambda: Monitor(gymnasium.make(id_, **options))] * copies)
    env.seed(seed)
    quota = np.array([(episodes + copy) // copies for copy in range(copies)])
    played = np.full(copies, -warm_up)
    reached, starts = np.zeros(copies, dtype=bool), np.ones(copies, dtype=bool)
    returns: list[float] = []
    successes: list[bool] = []
    knows_success, state, observation = False, None, env.reset()
    while (played < quota).any():
        actions, state = predict(observation, state, starts)
        observation, _, starts, infos = env.step(actions)
        for copy, info in enumerate(infos):
            knows_success |= "success" in info
            reached[copy] |= bool(info.get("success", False))
            if starts[copy]:
                if 0 <= played[copy] < quota[copy]:
                    returns.append(float(info["episode"]["r"]))
                    successes.append(bool(reached[copy]))
                played[copy] += 1
                reached[copy] = False
        report("evaluating", len(returns), episodes)
    env.close()
    return Evaluation(
        episodes=len(returns),
        mean=float(np.mean(returns)),
        deviation=float(np.std(returns)),
        success=100 * float(np.mean(successes)) if knows_success else None,
    )
