"""Tuned rows: the recipes ``agents/paper_*.toml``, with vectorised rollouts, for as many environment steps."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from cirl_marl.errors import CirlError, RecipeError
from cirl_marl.learners import Progress, Recipe, load_recipe, train
from cirl_marl.learners.algorithms import build
from cirl_marl.learners.demonstrations import demonstrate, in_copies
from cirl_marl.learners.learner import derived_seed, normalised
from cirl_marl.learners.recipe import LearnerSettings
from cirl_marl.paper.final_policy import Report, predictor
from cirl_marl.paper.published import PaperEnvironment
from cirl_marl.paper.results import PaperRow
from cirl_marl.paper.selection import tuned_recipe
from cirl_marl.paper.untuned import PaperTraining, Watch, check_registered, described, episodes_of, stopwatch


def train_tuned(
    environment: PaperEnvironment, row: PaperRow, report: Report, recipe: Recipe | None = None
) -> PaperTraining:
    """Train by the environment's recipe: networks with batched physics, goal tasks and others in a batch of copies.

    Args:
        environment: of the paper.
        row: what to run; its steps and its seed override the recipe's.
        report: called now and then.
        recipe: None takes that of the catalogue.

    Raises:
        CirlError: if there is no recipe.
        RecipeError: if it asks for something that would make the figures incomparable.
    """
    if recipe is None:
        name = tuned_recipe(environment.name)
        if name is None:
            raise CirlError(f"there is no tuned recipe agents/paper_*.toml for {environment.name}")
        recipe = load_recipe(name)
    if recipe.learner.algorithm != row.algorithm.removesuffix("-HER"):
        raise RecipeError(f"recipe '{recipe.name}' uses {recipe.learner.algorithm}, but the row says {row.algorithm}")
    _check_comparable(recipe)
    recipe.check(row.steps)
    run = _train_network if _is_plain_network(environment) else _train_copies
    return run(environment, recipe, row, report)


def _is_plain_network(environment: PaperEnvironment) -> bool:
    """Return whether the environment is a network seen as a vector, which a seat of the joint environment can show."""
    env = gymnasium.make(environment.id)
    goal = isinstance(env.observation_space, gymnasium.spaces.Dict)
    env.close()
    return not goal and "network" in check_registered(environment).kwargs


def _check_comparable(recipe: Recipe) -> None:
    """Refuse what changes the problem; how it is observed may differ, and is on record in the result."""
    changed = [key for key in recipe.environment if key not in ("observe",)]
    if changed:
        raise RecipeError(f"recipe '{recipe.name}': a tuned recipe keeps the paper's problem; leave out {changed}")
    if recipe.match:
        raise RecipeError(f"recipe '{recipe.name}': one agent learns, so [[match]] has no place")


def _train_network(environment: PaperEnvironment, recipe: Recipe, row: PaperRow, report: Report) -> PaperTraining:
    """Train the one agent of a network in its paper scenario."""
    arguments = check_registered(environment).kwargs
    agent = arguments.get("agent")

    def watch(now: Progress) -> None:
        report("training", min(now.env_steps, now.total), now.total)

    with tempfile.TemporaryDirectory() as folder:
        elapsed = stopwatch()
        training = train(
            arguments["network"],
            recipe,
            directory=Path(folder) / "run",
            steps=row.steps,
            seed=row.seed,
            agents=None if agent is None else [agent],
            scenario=arguments.get("scenario"),
            report=watch,
        )
        seconds, cpu_seconds = elapsed()
        assert training.run is not None
        metrics = training.run.metrics()
    agent = training.env.agents[0]
    learner, copies = training.learners[agent], training.env.num_envs
    # the copies of a network end together, and a row of the metrics is the mean over them
    returns = np.repeat(metrics[f"return:{agent}"], copies).tolist()
    ends = np.repeat(np.asarray(metrics["env_steps"], dtype=int), copies).tolist()
    normalise = learner.env.normalize_obs if isinstance(learner.env, VecNormalize) else _unchanged
    return PaperTraining(
        predict=predictor(learner.model, normalise),
        ends=ends,
        returns=returns,
        steps=training.joint_steps * copies,
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        settings=_settings(environment, recipe, copies),
        options=recipe.environment,
    )


def _train_copies(environment: PaperEnvironment, recipe: Recipe, row: PaperRow, report: Report) -> PaperTraining:
    """Train in copies of the Gymnasium environment; a goal task gets hindsight, as in the paper."""
    learner, copies = recipe.learner, recipe.run.envs
    plain = LearnerSettings(algorithm=learner.algorithm)
    unused = [key for key in ("scheme", "share_of_steps", "bootstrap") if getattr(learner, key) != getattr(plain, key)]
    if recipe.environment or unused:
        left_out = ", ".join([*(["environment"] if recipe.environment else []), *unused])
        raise RecipeError(f"recipe '{recipe.name}': {environment.name} learns in copies: leave out {left_out}")
    monitors: list[Monitor[Any, Any]] = [Monitor(gymnasium.make(environment.id)) for _ in range(copies)]
    env: VecEnv = DummyVecEnv([lambda monitor=monitor: monitor for monitor in monitors])  # type: ignore[misc]
    goal = isinstance(env.observation_space, gymnasium.spaces.Dict)
    env = normalised(env, learner, ["observation"] if goal else None)  # hindsight swaps goals, which keep one scale
    parameters = learner.parameters | ({"replay_buffer_class": HerReplayBuffer} if goal else {})
    policy = learner.policy.replace("Mlp", "MultiInput") if goal else learner.policy
    model = build(learner.algorithm, policy, env, parameters, seed=row.seed, device="cpu")
    env.seed(row.seed * copies)  # one seed for each copy from there on, so that no two rows share a start
    elapsed = stopwatch()
    if learner.demonstrations is not None:
        assert isinstance(model, OffPolicyAlgorithm)
        seeds = [derived_seed(row.seed, "demonstrations", i) for i in range(copies)]
        act = in_copies(learner.demonstrations.controller, monitors, seeds)

        def act_and_report() -> NDArray[np.float32]:
            report("training", model.num_timesteps, row.steps)
            return act()

        demonstrate(model, learner.demonstrations.steps, act_and_report)
    left, fresh = row.steps - model.num_timesteps, model.num_timesteps == 0
    model.learn(left, callback=Watch(report, row.steps), reset_num_timesteps=fresh)
    seconds, cpu_seconds = elapsed()
    ends, returns = episodes_of(monitors)
    settings = _settings(environment, recipe, copies)
    return PaperTraining(
        predict=predictor(model, env.normalize_obs if isinstance(env, VecNormalize) else _unchanged),
        ends=ends,
        returns=returns,
        steps=model.num_timesteps,
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        settings=settings | ({"replay_buffer_class": "HerReplayBuffer"} if goal else {}),
        options={},
    )


def _settings(environment: PaperEnvironment, recipe: Recipe, copies: int) -> dict[str, Any]:
    return {"recipe": recipe.model_dump(mode="json"), "copies": copies, **described(environment)}


def _unchanged(observation: Any) -> Any:
    return observation
