"""Trainings of the paper's environments, by the paper's own settings and by the recipes ``agents/paper_*.toml``."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.definitions.writer import fingerprint
from cirl_marl.errors import CirlError, RecipeError, RunError
from cirl_marl.learners.algorithms import build
from cirl_marl.learners.demonstrations import demonstrate, in_copies
from cirl_marl.learners.interface import train
from cirl_marl.learners.learner import derived_seed, wrap_in_normaliser
from cirl_marl.learners.recipe import LearnerSettings, Normalisation, Recipe, load_recipe
from cirl_marl.learners.trainer import Progress
from cirl_marl.network.declarations import frozen_record
from cirl_marl.paper.published import PaperEnvironment
from cirl_marl.paper.results import PaperRow
from cirl_marl.paper.row_selection import tuned_recipe

Report = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""
Predict = Callable[[Any, Any, NDArray[np.bool_]], tuple[NDArray[Any], Any]]
"""From observations, recurrent state and episode starts to deterministic actions and the next recurrent state."""


@frozen_record
class TrainingRecord:
    """What a training hands over to be measured."""

    predict: Annotated[Predict | None, "the final policy; None if its weights became NaN"]
    ends: Annotated[list[int], "environment steps at which each training episode ended"]
    returns: Annotated[list[float], "undiscounted return of each"]
    steps: int
    seconds: float
    cpu_seconds: float
    settings: Annotated[dict[str, Any], "what the row depends on"]
    options: Annotated[dict[str, Any], "of the environment to evaluate in"]


def check_registered(environment: PaperEnvironment) -> gymnasium.envs.registration.EnvSpec:
    """Return the Gymnasium specification of an environment of the paper; a ``RunError`` if this version lacks it."""
    if environment.id not in gymnasium.registry:
        raise RunError(f"{environment.id}: this version of cirl_marl does not register it")
    return gymnasium.registry[environment.id]


def describe(environment: PaperEnvironment) -> dict[str, Any]:
    """Return id, arguments and fingerprint of the definition of an environment, for the record."""
    spec = check_registered(environment)
    text = {"environment": spec.id, "arguments": {key: str(value) for key, value in spec.kwargs.items()}}
    if "network" in spec.kwargs:
        network = load_network(spec.kwargs["network"], scenario=spec.kwargs.get("scenario"))
        text["definition_sha256"] = fingerprint(network)
    return text


def train_published(environment: PaperEnvironment, row: PaperRow, report: Report) -> TrainingRecord:
    """Train with the paper's settings: the library's default hyperparameters, one copy; hindsight for goal tasks.

    A learner whose weights become NaN ends there, and that is what these settings give: the same seed gives it again.
    """
    name, _, hindsight = row.algorithm.partition("-")
    plain = LearnerSettings(algorithm=name, normalise=Normalisation(observation=False, reward=False))
    settings = {
        "policy": "MultiInputPolicy" if hindsight else "MlpPolicy",
        "hyperparameters": "defaults of the library",
    }
    if hindsight:
        settings["replay_buffer_class"] = "HerReplayBuffer, defaults of the library"
    return _train_copies(environment, plain, 1, row, report, settings)


def train_tuned(
    environment: PaperEnvironment, row: PaperRow, report: Report, recipe: Recipe | None = None
) -> TrainingRecord:
    """Train by a recipe: networks with batched physics, goal tasks and others in a batch of copies.

    Without a recipe it is the catalogue's; steps and seed are those of the row.

    Raises:
        CirlError: if there is no recipe.
        RecipeError: if it asks for something that would make the figures incomparable.
    """
    if recipe is None:
        name = tuned_recipe(environment.name)
        if name is None:
            raise CirlError(f"there is no tuned recipe agents/paper_*.toml for {environment.name}")
        recipe = load_recipe(name)
    learner, agents = recipe.learner, f"recipe '{recipe.name}'"
    if learner.algorithm != row.algorithm.removesuffix("-HER"):
        raise RecipeError(f"{agents} uses {learner.algorithm}, but the row says {row.algorithm}")
    if overrides := [key for key in recipe.environment if key != "observe"]:  # which is on record in the result
        raise RecipeError(f"{agents}: a tuned recipe keeps the paper's problem; leave out {overrides}")
    if recipe.match:
        raise RecipeError(f"{agents}: one agent learns, so [[match]] has no place")
    recipe.check(row.steps)
    settings: dict[str, Any] = {"recipe": recipe.model_dump(mode="json")}
    if not environment.has_goals and "network" in check_registered(environment).kwargs:
        return _train_network(environment, recipe, row, report, settings)
    plain = LearnerSettings(algorithm=learner.algorithm)
    surplus = ["environment"] if recipe.environment else []
    network_settings = ("scheme", "share_of_steps", "bootstrap", "centre_rewards")
    surplus += [key for key in network_settings if getattr(learner, key) != getattr(plain, key)]
    if surplus:
        raise RecipeError(f"{agents}: {environment.name} learns in copies: leave out {', '.join(surplus)}")
    if environment.has_goals:
        settings["replay_buffer_class"] = "HerReplayBuffer"
    return _train_copies(environment, learner, recipe.run.envs, row, report, settings)


def _train_network(
    environment: PaperEnvironment, recipe: Recipe, row: PaperRow, report: Report, settings: dict[str, Any]
) -> TrainingRecord:
    arguments = check_registered(environment).kwargs
    agent = arguments.get("agent")

    def watch(now: Progress) -> None:
        report("training", min(now.env_steps, now.total), now.total)

    options: dict[str, Any] = {"steps": row.steps, "seed": row.seed, "scenario": arguments.get("scenario")}
    options |= {"agents": None if agent is None else [agent]}
    with tempfile.TemporaryDirectory() as folder:
        stop_clock = _stopwatch()
        training = train(arguments["network"], recipe, directory=Path(folder) / "run", report=watch, **options)
        times = stop_clock()
        assert training.run is not None
        metrics = training.run.metrics()
    agent = training.env.agents[0]
    learner, copies = training.learners[agent], training.env.num_envs
    return TrainingRecord(
        predict=_predictor(learner.model, learner.env),
        # the copies of a network end together, and a row of the metrics is the mean over them
        ends=np.repeat(np.asarray(metrics["env_steps"], dtype=int), copies).tolist(),
        returns=np.repeat(metrics[f"return:{agent}"], copies).tolist(),
        steps=training.joint_steps * copies,
        settings={"copies": copies, **settings, **describe(environment)},
        options=recipe.environment,
        **times,
    )


def _train_copies(
    environment: PaperEnvironment,
    learner: LearnerSettings,
    copies: int,
    row: PaperRow,
    report: Report,
    settings: dict[str, Any],
) -> TrainingRecord:
    """Train in copies of the Gymnasium environment; a goal task gets hindsight, as in the paper."""
    monitors: list[Monitor[Any, Any]] = [Monitor(gymnasium.make(environment.id)) for _ in range(copies)]
    env: VecEnv = DummyVecEnv([lambda monitor=monitor: monitor for monitor in monitors])  # type: ignore[misc]
    parameters, policy = learner.parameters, learner.policy
    if environment.has_goals:
        parameters, policy = parameters | {"replay_buffer_class": HerReplayBuffer}, policy.replace("Mlp", "MultiInput")
    # hindsight swaps goals, which keep one scale
    env = wrap_in_normaliser(env, learner, ["observation"] if environment.has_goals else None)
    model = build(learner.algorithm, policy, env, parameters, seed=row.seed, device="cpu")
    env.seed(row.seed * copies)  # one seed for each copy from there on, so that no two rows share a start

    def tell(*_: Any) -> bool:
        report("training", min(model.num_timesteps, row.steps), row.steps)
        return True

    stop_clock = _stopwatch()
    if learner.demonstrations is not None:
        seeds = [derived_seed(row.seed, "demonstrations", i) for i in range(copies)]
        act = in_copies(learner.demonstrations.controller, monitors, seeds)

        def act_and_tell() -> NDArray[np.float32]:
            tell()
            return act()

        demonstrate(model, learner.demonstrations.steps, act_and_tell)
    rest, fresh = row.steps - model.num_timesteps, model.num_timesteps == 0
    try:
        model.learn(rest, callback=tell, reset_num_timesteps=fresh)
    except (CirlError, ValueError):  # what torch's distributions and the environments say of NaN
        if _is_finite(model):
            raise
    figures: dict[str, Any] = {"steps": model.num_timesteps, **stop_clock()}
    ends, returns = _episodes_of(monitors)
    env.close()
    predict = _predictor(model, env) if _is_finite(model) else None
    settings = {"copies": copies, **settings, **describe(environment)}
    return TrainingRecord(predict=predict, ends=ends, returns=returns, settings=settings, options={}, **figures)


def _is_finite(model: BaseAlgorithm) -> bool:
    return all(bool(weights.isfinite().all()) for weights in model.policy.parameters())


def _predictor(model: BaseAlgorithm, env: VecEnv) -> Predict:
    """Return the deterministic policy of ``model`` behind the normaliser that it was trained with, if any."""

    def predict(observation: Any, state: Any, starts: NDArray[np.bool_]) -> tuple[NDArray[Any], Any]:
        observations = env.normalize_obs(observation) if isinstance(env, VecNormalize) else observation
        return model.predict(observations, state, starts, deterministic=True)

    return predict


def _episodes_of(monitors: list[Monitor[Any, Any]]) -> tuple[list[int], list[float]]:
    """Return when the episodes of several copies ended, in steps summed over the copies, and their returns, in order.

    What the monitor of each copy saw counts, as ARS keeps its episodes from callbacks.
    """
    episodes = sorted(
        (int(end) * len(monitors), copy, value)
        for copy, monitor in enumerate(monitors)
        for end, value in zip(np.cumsum(monitor.get_episode_lengths()), monitor.get_episode_rewards(), strict=True)
    )
    return [end for end, _, _ in episodes], [value for _, _, value in episodes]


def _stopwatch() -> Callable[[], dict[str, float]]:
    """Start to measure; the function returned gives wall time and processor time since then, in seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    return lambda: {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
