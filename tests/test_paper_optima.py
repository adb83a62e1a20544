"""The best possible returns of the paper's environments, and how near the kept policies come to them."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

import cirl_marl
from cirl_marl.evaluate import EVALUATION_SEEDS, SEED_SPACING
from cirl_marl.network import Floats
from cirl_marl.paper.published import ENVIRONMENTS
from cirl_marl.paper.results import Result, Results
from cirl_marl.paper.training import evaluate

KEPT = Path(__file__).parent.parent / "benchmarks" / "results" / "paper"
NETWORKS = {"CarboNet": "carbo_net", "CopperNet": "copper_net"}


@cache
def best_return(name: str, steps: int) -> float:
    """Return the best return of ``steps`` steps from the fixed start: the stocks are affine in the actions.

    With residuals r(u) = r(0) + J·u, u in [−1, 1], the return is −|r(u)|², so bounded least squares finds the best.
    """
    network = cirl_marl.load_network(NETWORKS[name], scenario="paper").with_options(episode={"horizon": steps + 1})
    tracked = network.objective.tracked
    rows = [network.node_index[node] for node in tracked]
    targets = np.array([[network.compartments[node].set_point, network.compartments[node].scale] for node in tracked])
    env = cirl_marl.VectorEnv(network, num_envs=steps + 1)

    def play(actions: Floats) -> tuple[Floats, Floats]:
        """Return the residuals, shape (steps·tracked, copies), and the returns of ``actions``, (copies, steps)."""
        env.reset(seed=0)
        residuals, returns = [], np.zeros(env.num_envs)
        for action in actions.T:
            _, rewards, *_ = env.step({env.agents[0]: action[:, None]})
            residuals.append((env.physical.stock[rows] - targets[:, :1]) / targets[:, 1:])
            returns += rewards[env.agents[0]]
        return np.concatenate(residuals), returns

    residuals, _ = play(np.concatenate([np.zeros((1, steps)), np.eye(steps)]))
    jacobian = residuals[:, 1:] - residuals[:, :1]
    found = lsq_linear(jacobian, -residuals[:, 0], bounds=(-1.0, 1.0), tol=1e-14, max_iter=1000)
    returns = play(np.tile(found.x, (env.num_envs, 1)))[1]
    assert returns[0] == pytest.approx(-2.0 * found.cost, rel=1e-6)
    return float(returns[0])


@pytest.mark.parametrize("name", NETWORKS)
def test_best_return_of_a_published_network(name: str) -> None:
    """Bounded least squares over the 50 actions gives the optimum that the tables show, and nobody beats it."""
    best = best_return(name, 50)
    assert best == pytest.approx(ENVIRONMENTS[name].optima[0].value, rel=1e-4)
    assert all(result.evaluation.mean <= best for result in kept(name) if result.evaluation is not None)


@pytest.mark.parametrize(("name", "published"), [("CarboNet", -1.593e5), ("CopperNet", -4.674e7)])
def test_best_return_under_the_published_step_counter(name: str, published: float) -> None:
    """An episode of 49 steps, and one more from a fresh start, which no action can help."""
    assert best_return(name, 49) + best_return(name, 1) == pytest.approx(published, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "action", "within"),
    [
        ("TransportTruck", 0.0, 0.01),
        ("CO2MicroalgaeMonod", -1.0, 1e-6),
        ("CO2MicroalgaeDroop", 1.0, 1e-3),
    ],
)
def test_tuned_policy_against_the_best_in_the_same_episodes(name: str, action: float, within: float) -> None:
    """No force, no light and full light are best; starts vary by far more than a policy can lose."""

    def hold(observation: Any, state: Any, starts: NDArray[np.bool_]) -> tuple[NDArray[Any], Any]:
        del starts
        return np.full((len(observation), 1), action, dtype=np.float32), state

    result = next(result for result in kept(name) if result.row.recipe == "tuned")
    assert result.evaluation is not None
    seed = EVALUATION_SEEDS + SEED_SPACING * result.row.seed
    best = evaluate(ENVIRONMENTS[name].id, hold, result.evaluation.episodes, seed, lambda *_: None, {})
    assert best.deviation > 0
    assert result.evaluation.mean <= best.mean + 1e-9 * abs(best.mean)
    assert result.evaluation.mean == pytest.approx(best.mean, rel=within)


def kept(name: str) -> list[Result]:
    """Return the rows of the tables for one environment."""
    return [result for result in Results(KEPT).all() if result.row.environment == name]
