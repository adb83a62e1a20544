"""The algorithms of Stable-Baselines3 and sb3-contrib by name, unmodified."""

from __future__ import annotations

import copy
import importlib
import inspect
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from cirl_marl.errors import RecipeError, unknown
from cirl_marl.learners.central_critic import CentralCriticPolicy

MODULES = ("stable_baselines3", "sb3_contrib")
CENTRAL_CRITIC = "CentralCriticPolicy"
POLICIES = {CENTRAL_CRITIC: CentralCriticPolicy}
"""Policies that Stable-Baselines3 has no name for."""

RESERVED = ("self", "env", "seed", "policy", "tensorboard_log", "verbose", "device", "_init_setup_model")
NOISES: Mapping[str, type[ActionNoise]] = {
    "normal": NormalActionNoise,
    "ornstein_uhlenbeck": OrnsteinUhlenbeckActionNoise,
}


def algorithms() -> dict[str, type[BaseAlgorithm]]:
    """Return every algorithm for continuous actions that the installed packages export, by class name."""
    found: dict[str, type[BaseAlgorithm]] = {}
    for name in MODULES:
        module = importlib.import_module(name)
        for attribute in module.__all__:
            value = getattr(module, attribute)
            if isinstance(value, type) and issubclass(value, BaseAlgorithm):
                found[attribute] = value
    return {name: found[name] for name in sorted(found) if name not in ("DQN", "QRDQN", "MaskablePPO")}


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """Return the algorithm called ``name``.

    Raises:
        RecipeError: if there is none; names the nearest.

    >>> algorithm_class("PPO").__name__
    'PPO'
    """
    known = algorithms()
    if name not in known:
        raise RecipeError(f"algorithm: {unknown('algorithm', name, known)}")
    return known[name]


def parameters_of(name: str) -> dict[str, inspect.Parameter]:
    """Return the constructor parameters that a recipe may set."""
    signature = inspect.signature(algorithm_class(name).__init__)
    return {name: parameter for name, parameter in signature.parameters.items() if name not in RESERVED}


def checked_parameters(name: str, parameters: Mapping[str, Any]) -> None:
    """Refuse parameters that the algorithm does not have, and values of another type than its constructor states.

    Raises:
        RecipeError: naming the parameter, and the nearest that exists or the type that it needs.
    """
    known = parameters_of(name)
    for parameter, value in parameters.items():
        if parameter not in known:
            raise RecipeError(f"parameters: {unknown(f'parameter of {name}', parameter, known)}")
        if parameter == "learning_rate" and isinstance(value, Mapping):
            if not (set(value) == {"linear_from", "linear_to"} and _are_numbers(value.values())):
                raise RecipeError(f"parameters.learning_rate: needs a number, or linear_from and linear_to: {value!r}")
        elif parameter == "action_noise" and value is not None:
            _check_noise(value)
        else:
            _check_type(name, known[parameter], value)


def _check_noise(noise: object) -> None:
    if not isinstance(noise, Mapping) or set(noise) != {"kind", "sigma"} or not _are_numbers([noise["sigma"]]):
        raise RecipeError(f"parameters.action_noise: needs kind and a number sigma, got {noise!r}")
    if noise["kind"] not in NOISES:
        raise RecipeError(f"parameters.action_noise: {unknown('kind', noise['kind'], NOISES)}")


def _check_type(name: str, parameter: inspect.Parameter, value: object) -> None:
    stated = TypeAdapter(parameter.annotation, config=ConfigDict(strict=True, arbitrary_types_allowed=True))
    try:
        stated.validate_python(_as_tuple(value))
    except ValidationError:
        needs = inspect.formatannotation(parameter.annotation).replace("collections.abc.", "").replace("typing.", "")
        raise RecipeError(f"parameters.{parameter.name}: {name} needs {needs}, got {value!r}") from None


def _as_tuple(value: Any) -> Any:
    """Return what the library takes for a list of TOML, which knows no tuples."""
    return tuple(value) if isinstance(value, list) else value


def checked_policy(name: str, policy: str) -> None:
    """Refuse a policy that the algorithm does not have.

    Raises:
        RecipeError: naming the nearest that it has.
    """
    aliases = algorithm_class(name).policy_aliases
    known = [alias for alias in aliases if not alias.startswith(("Cnn", "MultiInput"))]
    if aliases.get("MultiInputPolicy") is MultiInputActorCriticPolicy:
        known.append(CENTRAL_CRITIC)
    if policy not in known:
        raise RecipeError(f"policy: {unknown(f'policy of {name} for vectors', policy, known)}")


def has_replay_buffer(name: str) -> bool:
    """Return whether the algorithm learns from what it keeps of the past."""
    return issubclass(algorithm_class(name), OffPolicyAlgorithm)


def checked_off_policy(name: str) -> None:
    """Refuse an algorithm that has no replay buffer to keep demonstrations in.

    Raises:
        RecipeError: naming those that have one.
    """
    if not has_replay_buffer(name):
        fit = [other for other in algorithms() if has_replay_buffer(other)]
        raise RecipeError(f"demonstrations: {name} has no replay buffer to keep them in; use one of {', '.join(fit)}")


def _are_numbers(values: Iterable[object]) -> bool:
    return all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in values)


def build(name: str, policy: str, env: VecEnv, parameters: Mapping[str, Any], **fixed: Any) -> BaseAlgorithm:
    """Construct the algorithm on ``env``; it logs nowhere until it is given a logger.

    Args:
        name: class name in Stable-Baselines3 or sb3-contrib.
        policy: such as ``MlpPolicy``.
        env: what it learns in.
        parameters: keyword arguments of its constructor; ``learning_rate = {linear_from, linear_to}`` and
            ``action_noise = {kind, sigma}`` are turned into the objects that the library expects.
        **fixed: seed, device, tensorboard_log and so on.

    Raises:
        RecipeError: for unknown parameters or values that the algorithm refuses.
    """
    checked_parameters(name, parameters)
    arguments = {key: _as_tuple(value) for key, value in copy.deepcopy(dict(parameters)).items()}
    rate = arguments.get("learning_rate")
    if isinstance(rate, Mapping):
        arguments["learning_rate"] = LinearSchedule(rate["linear_from"], rate["linear_to"], 1.0)
    noise = arguments.get("action_noise")
    if noise is not None:
        mean = np.zeros(env.action_space.shape or (1,))
        arguments["action_noise"] = NOISES[noise["kind"]](mean, noise["sigma"] * np.ones_like(mean))  # type: ignore[call-arg]
    try:
        model = algorithm_class(name)(POLICIES.get(policy, policy), env, **arguments, **fixed)
    except (TypeError, ValueError, AssertionError, KeyError) as error:
        raise RecipeError(f"{name} refuses its parameters {dict(parameters)}: {error}") from error
    model.set_logger(Logger(None, []))  # left to itself it makes an empty temporary folder when it begins to learn
    return model
