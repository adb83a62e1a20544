"""Our own learners: PPO with the settings that peers have, in lockstep or stacked, and our recipes as they are."""

from __future__ import annotations

from importlib.metadata import version
from unittest.mock import patch

from benchmarks.peers.problem import Scaling
from benchmarks.peers.settings import NETWORK, SETTINGS
from benchmarks.peers.watch import TimeIsUp, Watch
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.learners import trainer
from cirl_marl.learners.interface import train
from cirl_marl.learners.policies import Policies
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.trainer import Progress
from cirl_marl.learners.validation import Score, validation_score

EVALUATIONS = 20
"""At which policies are judged whose recipe has none."""
SERVING = 0.8
"""Weight of circularity at which services are met at once."""


def lockstep(watch: Watch, seed: int, scaling: Scaling, envs: int, threads: int) -> None:
    """Learn as peers do, each by the unmodified ``learn()`` of Stable-Baselines3."""
    _learn(watch, _plain(load_recipe("independent_ppo")), "lockstep", seed)


def stacked(watch: Watch, seed: int, scaling: Scaling, envs: int, threads: int) -> None:
    """Learn as peers do, all as one."""
    _learn(watch, _plain(load_recipe("independent_ppo")), "stacked", seed)


def independent_ppo(watch: Watch, seed: int, scaling: Scaling, envs: int, threads: int) -> None:
    """Learn by the whole recipe: evaluations choose, and the price of service moves."""
    _learn(watch, load_recipe("independent_ppo"), "stacked", seed)


def independent_ars(watch: Watch, seed: int, scaling: Scaling, envs: int, threads: int) -> None:
    """Learn by the default recipe."""
    _learn(watch, load_recipe("independent_ars"), "stacked", seed)


def serving_ars(watch: Watch, seed: int, scaling: Scaling, envs: int, threads: int) -> None:
    """Learn by the default recipe, paid more for service from the beginning, so that its price need not rise."""
    recipe = load_recipe("independent_ars")
    environment = {**recipe.environment, "circularity_weight": SERVING}
    _learn(watch, recipe.model_copy(update={"environment": environment}), "stacked", seed)


def _learn(watch: Watch, recipe: Recipe, engine: str, seed: int) -> None:
    """Train until the recipe ends or time is up; policies are judged where the recipe evaluates them."""
    run = recipe.run
    versions = {name: version(name) for name in ("cirl-marl", "stable-baselines3", "torch")}
    watch.record.setup = {"envs": run.envs, "threads": 1, "recipe": recipe.name, "engine": engine, **versions}
    steps = 0

    def judged(env: MultiAgentVectorEnv, policies: Policies) -> Score:
        found = validation_score(env, policies)
        watch.judge(policies, steps)
        return found

    def report(progress: Progress) -> None:
        nonlocal steps
        steps = progress.env_steps
        if steps == run.envs:
            watch.begin()
        elif steps % SETTINGS.rollout == run.envs:  # the step after the update of a rollout
            watch.lap(steps)

    if watch.judges and not run.evaluations:
        run = run.model_copy(update={"evaluations": EVALUATIONS, "episodes": 1})
    try:
        with patch.object(trainer, "validation_score", judged if watch.judges else validation_score):
            train(NETWORK, recipe.model_copy(update={"run": run}), seed=seed, engine=engine, report=report)
    except TimeIsUp:
        return


def _plain(recipe: Recipe) -> Recipe:
    """Return the recipe without what peers have nothing of: evaluations that choose, and a price that moves."""
    bare = recipe.run.model_copy(update={"evaluations": 0, "min_service": None, "price_rate": 0.0})
    return recipe.model_copy(update={"run": bare})
