"""The algorithms of Stable-Baselines3 and sb3-contrib by name, unmodified."""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
from pydantic import ConfigDict, TypeAdapter, ValidationError
from sb3_contrib import ARS, RecurrentPPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy, MultiInputActorCriticPolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from cirl_marl.errors import RecipeError, unknown_name
from cirl_marl.learners.policies import CentralCriticPolicy
from cirl_marl.learners.views import CENTRAL_CRITIC

DISCRETE = ("DQN", "QRDQN", "MaskablePPO")
POLICIES: Mapping[str, type[BasePolicy]] = {CENTRAL_CRITIC: CentralCriticPolicy}
"""Policies that Stable-Baselines3 has no name for."""

RESERVED_PARAMETERS = ("self", "env", "seed", "policy", "tensorboard_log", "verbose", "device", "_init_setup_model")
SHARES = "gamma gae_lambda tau line_search_shrinking_factor"
COUNTS = """
    n_steps n_epochs batch_size buffer_size train_freq n_delta n_top n_eval_episodes policy_delay target_update_interval
    cg_max_steps line_search_max_iter n_critic_updates sub_sampling_factor stats_window_size
"""
AMOUNTS = """
    learning_rate learning_starts clip_range target_kl delta_std max_grad_norm vf_coef rms_prop_eps cg_damping
    target_policy_noise target_noise_clip top_quantiles_to_drop_per_net
"""
BOUNDS = {
    name: (low, high)
    for names, low, high in (
        (SHARES, 0.0, 1.0),
        (COUNTS, 1.0, math.inf),
        (AMOUNTS, 0.0, math.inf),
        ("gradient_steps sde_sample_freq", -1.0, math.inf),
    )
    for name in names.split()
}
"""Lowest and highest number of parameters whose annotations do not say it."""
WIDEST = 2**16
"""Most units of a layer."""
NOISES: Mapping[str, type[ActionNoise]] = {
    "normal": NormalActionNoise,
    "ornstein_uhlenbeck": OrnsteinUhlenbeckActionNoise,
}


def every_algorithm() -> dict[str, type[BaseAlgorithm]]:
    """Return every algorithm that the installed packages export, by class name."""
    classes = {name: getattr(module, name) for module in (stable_baselines3, sb3_contrib) for name in module.__all__}
    return {
        name: kind
        for name, kind in sorted(classes.items())
        if isinstance(kind, type) and issubclass(kind, BaseAlgorithm)
    }


def algorithms() -> dict[str, type[BaseAlgorithm]]:
    """Return those for continuous actions, which compartments have."""
    return {name: kind for name, kind in every_algorithm().items() if name not in DISCRETE}


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """Return the algorithm called ``name``; a ``RecipeError`` names the nearest if there is none.

    >>> algorithm_class("PPO").__name__
    'PPO'
    """
    classes = every_algorithm()
    if name not in classes:
        raise RecipeError(f"algorithm: {unknown_name('algorithm', name, classes)}")
    return classes[name]


def parameters_of(name: str) -> dict[str, inspect.Parameter]:
    """Return the constructor parameters that a recipe may set."""
    parameters = inspect.signature(algorithm_class(name).__init__).parameters
    return {key: parameter for key, parameter in parameters.items() if key not in RESERVED_PARAMETERS}


def algorithm_mistakes(name: str, policy: str, parameters: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong with an algorithm, its policy and its parameters: key, value and what would do."""
    classes = algorithms()
    if name not in classes:
        yield f"algorithm: {unknown_name('algorithm', name, classes)}"
        return
    aliases = classes[name].policy_aliases
    fit = [alias for alias in aliases if not alias.startswith(("Cnn", "MultiInput"))]
    if aliases.get("MultiInputPolicy") is MultiInputActorCriticPolicy:
        fit.append(CENTRAL_CRITIC)
    if policy not in fit:
        yield f"policy: {unknown_name(f'policy of {name} for vectors', policy, fit)}"
    yield from parameter_mistakes(name, parameters)


def parameter_mistakes(name: str, parameters: Mapping[str, Any]) -> Iterator[str]:
    """Yield parameters that there are not, numbers like NaN, and values of another type or size than can be meant.

    Stable-Baselines3 checks ``policy_kwargs`` when it is constructed, but few others: an entropy coefficient that is a
    text fails in the middle of a training, a discount of 1.5, a batch of 0 or gradients clipped to −1 never do.
    """
    signature = parameters_of(name)
    for key, value in parameters.items():
        place = f"parameters.{key}"
        if key not in signature:
            yield f"parameters: {unknown_name(f'parameter of {name}', key, signature)}"
        elif infinite := {part: x for part, x in _leaves(place, value) if _is_infinite(x)}:
            yield from (f"{part}: must be a finite number, got {number!r}" for part, number in infinite.items())
        elif not _takes(signature[key], value):
            if key in TABLE_CHECKS:
                yield from TABLE_CHECKS[key](place, value)
            else:
                yield f"{place}: {name} needs {_requirement(signature[key])}, got {value!r}"
        elif key == "policy_kwargs" and value:
            for part, width in _leaves(f"{place}.net_arch", value.get("net_arch")):
                is_width = isinstance(width, int) and not isinstance(width, bool) and 1 <= width <= WIDEST
                if width is not None and not is_width:
                    yield f"{part}: a layer has 1 to {WIDEST:,} units, got {width!r}"
            for part, kind in value.items():
                if isinstance(kind, str) and part.endswith(("_class", "_fn")):
                    yield f"{place}.{part}: is a class, which only Python can give, not a text, got {kind!r}"
    kwargs = parameters.get("policy_kwargs")
    quantiles = kwargs.get("n_quantiles", 25) if isinstance(kwargs, Mapping) else 25
    for part, whole, spare in (
        ("n_top", parameters.get("n_delta", 8), 0),
        ("top_quantiles_to_drop_per_net", quantiles, 1),
    ):
        number = parameters.get(part)
        if part in signature and isinstance(number, int) and isinstance(whole, int) and number > whole - spare:
            yield f"parameters.{part}: {name} has no more than {whole - spare}, got {number}"


def _is_infinite(value: object) -> bool:
    return isinstance(value, float | np.floating) and not math.isfinite(value)


def _leaves(place: str, value: object) -> Iterator[tuple[str, object]]:
    """Yield every value in tables and lists with its path."""
    if isinstance(value, Mapping | list | tuple):
        for key, part in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _leaves(f"{place}.{key}", part)
    else:
        yield place, value


def _takes(parameter: inspect.Parameter, value: object) -> bool:
    """Whether a value is of the type that a constructor states, and within its bounds."""
    number = value[0] if isinstance(value, list | tuple) and value else value
    if parameter.name in BOUNDS and isinstance(number, int | float):
        low, high = BOUNDS[parameter.name]
        if not low <= number <= high:
            return False
    adapter = TypeAdapter[Any](parameter.annotation, config=ConfigDict(strict=True, arbitrary_types_allowed=True))
    for form in (value, _as_tuple(value)):
        with suppress(ValidationError):
            adapter.validate_python(form)
            return True
    return False


def _requirement(parameter: inspect.Parameter) -> str:
    text = inspect.formatannotation(parameter.annotation).replace("collections.abc.", "").replace("typing.", "")
    if parameter.name not in BOUNDS:
        return text
    low, high = BOUNDS[parameter.name]
    return f"{text} of at least {low:g}" if high == math.inf else f"{text} in [{low:g}, {high:g}]"


def _as_tuple(value: Any) -> Any:
    """Return what the library takes for a list of TOML, which knows no tuples."""
    return tuple(value) if isinstance(value, list) else value


def _rate_mistakes(place: str, rate: object) -> Iterator[str]:
    if not isinstance(rate, Mapping) or set(rate) != {"linear_from", "linear_to"} or not _are_amounts(rate.values()):
        yield f"{place}: needs a number of at least 0, or two such, linear_from and linear_to: {rate!r}"


def _noise_mistakes(place: str, noise: object) -> Iterator[str]:
    if not isinstance(noise, Mapping) or set(noise) != {"kind", "sigma"} or not _are_amounts([noise["sigma"]]):
        yield f"{place}: needs kind and a number sigma of at least 0, got {noise!r}"
    elif noise["kind"] not in NOISES:
        yield f"{place}: {unknown_name('kind', noise['kind'], NOISES)}"


def _are_amounts(values: Iterable[object]) -> bool:
    return all(isinstance(value, int | float) and not isinstance(value, bool) and value >= 0 for value in values)


SCHEDULE_PARAMETERS = ("learning_rate", "clip_range", "delta_std")
"""Parameters that may change from one number to another over the run."""
TABLE_CHECKS: Mapping[str, Callable[[str, object], Iterator[str]]] = {
    **dict.fromkeys(SCHEDULE_PARAMETERS, _rate_mistakes),
    "action_noise": _noise_mistakes,
}
"""Parameters that recipes may write as tables, which ``build`` turns into the objects that the library takes."""


def has_replay_buffer(name: str) -> bool:
    """Return whether the algorithm learns from what it keeps of the past."""
    return issubclass(algorithm_class(name), OffPolicyAlgorithm)


def can_be_shown(name: str) -> bool:
    """Return whether the algorithm learns from demonstrations: keeps them, or imitates them by a policy of one step."""
    kind = algorithm_class(name)
    imitates = issubclass(kind, OnPolicyAlgorithm | ARS) and not issubclass(kind, RecurrentPPO)
    return imitates or has_replay_buffer(name)


def build(name: str, policy: str, env: VecEnv, parameters: Mapping[str, Any], **more: Any) -> BaseAlgorithm:
    """Construct the algorithm on ``env``; it logs nowhere until it is given a logger.

    Args:
        name: class name in Stable-Baselines3 or sb3-contrib.
        policy: such as ``MlpPolicy``.
        env: what it learns in.
        parameters: keyword arguments of its constructor; tables that recipes write become the objects that it expects.
        **more: seed, device, tensorboard_log and so on.

    Raises:
        RecipeError: for unknown parameters or values that the algorithm refuses.
    """
    if mistakes := list(parameter_mistakes(name, parameters)):
        raise RecipeError("; ".join(mistakes))
    arguments = {key: _as_tuple(value) for key, value in copy.deepcopy(dict(parameters)).items()}
    for key in SCHEDULE_PARAMETERS:
        if isinstance(ends := arguments.get(key), Mapping):
            arguments[key] = LinearSchedule(ends["linear_from"], ends["linear_to"], 1.0)
    noise = arguments.get("action_noise")
    if isinstance(noise, Mapping):
        mean = np.zeros(env.action_space.shape or (1,))
        arguments["action_noise"] = NOISES[noise["kind"]](mean, noise["sigma"] * np.ones_like(mean))  # type: ignore[call-arg]
    try:
        model = algorithm_class(name)(POLICIES.get(policy, policy), env, **arguments, **more)
    except (TypeError, ValueError, AssertionError, KeyError, NotImplementedError) as error:
        raise RecipeError(f"{name} refuses its parameters {dict(parameters)}: {error}") from error
    model.set_logger(Logger(None, []))  # left to itself it makes an empty temporary folder when it begins to learn
    return model
