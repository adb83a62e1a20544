"""Checkpoints: all that an algorithm of Stable-Baselines3 resumes from, bit for bit, and the files that it is kept in.

A checkpoint is a tree of plain values and arrays, written as JSON and safetensors: nobody can hide code in these.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from cirl_marl.errors import RunError
from cirl_marl.learners.algorithms import RESERVED_PARAMETERS, parameters_of
from cirl_marl.records.files import read_json

KIND = "__kind__"
"""Key that says what a table stands for, if it is no table."""
CRITICS = ("value_net.", "mlp_extractor.value_net.", "critic.", "critic_target.", "actor_target.")
"""Beginnings of the names of parameters by which no policy acts."""
UNREADABLE = (
    OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError, SafetensorError,
)  # fmt: skip
"""What damaged files, or those of something else, raise."""


def write_tree(folder: Path, name: str, value: Any) -> None:
    """Write tables, lists, tuples, numbers, texts, arrays and tensors, nested at will.

    Raises:
        TypeError: for anything else.
        OSError: if they cannot be written, as on a full disk.
    """
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    text = json.dumps(_to_json(value, arrays, ()))
    path = folder / f"{name}.safetensors"
    try:
        save_file(arrays, path)
    except SafetensorError as error:
        raise OSError(f"{path}: cannot be written: {error}") from error
    (folder / f"{name}.json").write_text(text + "\n")


def read_tree(folder: Path, name: str) -> Any:
    """Return what ``write_tree`` wrote; a ``RunError`` names a file that is missing or says something else."""
    path = folder / f"{name}.safetensors"
    try:
        arrays = load_file(path)
        path = folder / f"{name}.json"
        return _from_json(read_json(path), arrays)
    except RunError:
        raise
    except UNREADABLE as error:
        raise RunError(f"{path}: cannot be read: {error}") from error


def is_plain(value: object) -> bool:
    """Return whether a value can be written; tensors only if nothing is learnt about them."""
    if isinstance(value, torch.Tensor):
        return not value.requires_grad
    if isinstance(value, Mapping):
        return all(isinstance(key, str) and is_plain(part) for key, part in value.items())
    if isinstance(value, deque | tuple | list):
        return all(map(is_plain, value))
    return value is None or isinstance(value, bool | int | float | str | np.generic | np.ndarray)


def require_alike(value: Any, template: Any, place: str) -> None:
    """Raise a ``RunError`` that names where a tree has other keys, lengths, types or shapes than ``template``."""
    if isinstance(template, Mapping):
        if not isinstance(value, Mapping) or set(value) != set(template):
            raise RunError(f"{place} is no table of {', '.join(map(str, template))}")
        for key, part in template.items():
            require_alike(value[key], part, f"{place}: {key}")
    elif isinstance(template, tuple | list):
        if not isinstance(value, tuple | list) or len(value) != len(template):
            raise RunError(f"{place} is no list of {len(template)}")
        for number, (part, template_part) in enumerate(zip(value, template, strict=True)):
            require_alike(part, template_part, f"{place}, entry {number}")
    elif isinstance(template, np.ndarray):
        if not isinstance(value, np.ndarray) or (value.dtype, value.shape) != (template.dtype, template.shape):
            raise RunError(f"{place} is no array of {template.dtype}, shape {template.shape}")
    elif isinstance(value, bool) != isinstance(template, bool) or not isinstance(
        value, (float, int) if isinstance(template, float) else type(template)
    ):
        raise RunError(f"{place} is {str(value)[:60]}, not of type {type(template).__name__}")


def _to_json(value: Any, arrays: dict[str, np.ndarray[Any, Any]], path: tuple[object, ...]) -> Any:
    """Return what stands for a value in JSON; arrays are gathered by the names on their paths."""
    if isinstance(value, torch.Tensor):
        return {KIND: "tensor", "is": _to_json(value.detach().cpu().numpy(), arrays, path)}
    if isinstance(value, np.ndarray):
        key = ".".join(map(str, path))
        key = f"{key}#{len(arrays)}" if key in arrays else key
        arrays[key] = np.array(value, order="C")
        return {KIND: "array", "is": key}
    if isinstance(value, Mapping):
        if all(isinstance(key, str) and key != KIND for key in value):
            return {key: _to_json(part, arrays, (*path, key)) for key, part in value.items()}
        entries = [[_to_json(key, arrays, path), _to_json(part, arrays, (*path, key))] for key, part in value.items()]
        return {KIND: "table", "is": entries}
    if isinstance(value, tuple | list | deque):
        items = [_to_json(part, arrays, (*path, place)) for place, part in enumerate(value)]
        return {KIND: "tuple", "is": items} if isinstance(value, tuple) else items
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a {type(value).__name__} cannot be kept")


def _from_json(plain: Any, arrays: Mapping[str, np.ndarray[Any, Any]]) -> Any:
    if isinstance(plain, list):
        return [_from_json(part, arrays) for part in plain]
    if not isinstance(plain, dict):
        return plain
    if KIND not in plain:
        return {key: _from_json(part, arrays) for key, part in plain.items()}
    inside = plain["is"]
    match plain[KIND]:
        case "array":
            return np.array(arrays[inside])  # its own, to be written to
        case "tensor":
            return torch.from_numpy(_from_json(inside, arrays))
        case "table":
            return {_from_json(key, arrays): _from_json(part, arrays) for key, part in inside}
        case "tuple":
            return tuple(_from_json(part, arrays) for part in inside)
    raise ValueError(f"unknown kind {plain[KIND]!r}")


MATRICES = ("exploration_mat", "exploration_matrices")
"""Noise that depends on the state, drawn at the beginning of a rollout."""


def model_state(model: BaseAlgorithm) -> dict[str, Any]:
    """Return parameters, optimisers, counters, last observations, noise and stream of actions, without the buffer."""
    settings = {*parameters_of(type(model).__name__), *RESERVED_PARAMETERS, "start_time"}
    return {
        "parameters": model.get_parameters(),
        "variables": variables(model),
        "values": {k: v for k, v in vars(model).items() if k not in settings and _is_progress(v)},
        "noise": [{k: v for k, v in vars(noise).items() if isinstance(v, np.ndarray)} for noise in _noises(model)],
        "matrices": [{name: getattr(explorer, name) for name in MATRICES} for explorer in _explorers(model)],
        "action_stream": model.action_space.np_random.bit_generator.state,
    }


def set_model_state(model: BaseAlgorithm, state: Mapping[str, Any]) -> None:
    """Bring a model that was built alike into a state of ``model_state``."""
    model.set_parameters(dict(state["parameters"]), exact_match=True, device=model.device)
    set_variables(model, state["variables"])
    for name, value in state["values"].items():
        now = getattr(model, name, None)
        if isinstance(now, int | float) and not isinstance(value, int | float):
            raise RunError(f"{name} is {str(value)[:60]}, no number")
        setattr(model, name, _like(now, value))
    for noise, values in zip(_noises(model), state["noise"], strict=True):
        for name, value in values.items():
            if np.shape(value) != np.shape(getattr(noise, name)):
                raise RunError(f"{name} has shape {np.shape(value)}, not {np.shape(getattr(noise, name))}")
            setattr(noise, name, value)
    for explorer, matrices in zip(_explorers(model), state["matrices"], strict=True):
        for name, value in matrices.items():
            setattr(explorer, name, value)
    model.action_space.np_random.bit_generator.state = state["action_stream"]


def variables(model: BaseAlgorithm) -> dict[str, Any]:
    """Return what is learnt beside the networks, such as an entropy coefficient."""
    return {name: attrgetter(name)(model) for name in model._get_torch_save_params()[1]}


def set_variables(model: BaseAlgorithm, state: Mapping[str, Any]) -> None:
    """Bring what is learnt beside the networks into a state."""
    for name, variable in variables(model).items():
        variable.data.copy_(state[name])


def buffer_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """Return what is in a replay buffer, without the room that is left."""
    length = buffer.buffer_size if buffer.full else buffer.pos
    attributes = {name: value for name, value in vars(buffer).items() if is_plain(value)}
    return {name: _first(value, length, buffer.buffer_size) for name, value in attributes.items()}


def set_buffer_state(buffer: ReplayBuffer, state: Mapping[str, Any]) -> None:
    """Fill an empty buffer; a ``ValueError`` if it is one of other observations, actions or rows."""
    for name, value in state.items():
        now = getattr(buffer, name)
        for key, part in value.items() if isinstance(value, dict) else [(None, value)]:
            into = now if key is None else now[key]
            if isinstance(into, np.ndarray):
                if into.shape[1:] != part.shape[1:] or len(part) > len(into):
                    raise ValueError(f"holds what another learner saw: {name} of shape {part.shape}, not {into.shape}")
                into[: len(part)] = part
            else:
                require_alike(part, into, name)
                setattr(buffer, name, part)


def observation_statistics(env: VecNormalize) -> dict[str, RunningMeanStd]:
    """Return the running moments of observations by key, ``observation`` if the space is no dict; {} if none are."""
    if not env.norm_obs:
        return {}
    statistics: Any = env.obs_rms
    return statistics if isinstance(statistics, dict) else {"observation": statistics}


def normaliser_state(env: VecNormalize) -> dict[str, Any]:
    """Return the moments of observations and rewards, and the discounted returns under way, as plain numbers."""
    return {
        "observations": {key: _moments(part) for key, part in observation_statistics(env).items()},
        "rewards": _moments(env.ret_rms),
        "returns": _numbers(env.returns),
    }


def set_normaliser_state(env: VecNormalize, state: Mapping[str, Any], *, returns: bool = True) -> None:
    """Bring a normaliser into a state; a ``RunError`` if it sees something else."""
    observations = observation_statistics(env)
    if set(observations) != set(state["observations"]):
        raise RunError(f"normalises {sorted(state['observations'])}, not {sorted(observations)}")
    pairs = [(part, state["observations"][key]) for key, part in observations.items()]
    for statistics, moments in ((env.ret_rms, state["rewards"]), *pairs):
        mean, var = _array(moments["mean"]), _array(moments["var"])
        if np.shape(statistics.mean) != mean.shape:
            raise RunError(f"is for {mean.size} entries, not {np.size(statistics.mean)}")
        if var.shape != mean.shape or not (np.isfinite(mean) & np.isfinite(var) & (var >= 0)).all():
            raise RunError("has moments that are none: means and variances must be finite, variances not negative")
        require_alike(moments["count"], float(statistics.count), "count")
        statistics.mean, statistics.var, statistics.count = mean, var, moments["count"]
    if returns:
        if np.shape(now := _array(state["returns"])) != env.returns.shape:
            raise RunError(f"has returns of shape {now.shape}, not {env.returns.shape}")
        env.returns = now


class FrozenStatistics(RunningMeanStd):
    """Running moments that no longer follow what is observed."""

    def __init__(self, statistics: RunningMeanStd) -> None:
        """Stay at the moments of ``statistics``."""
        super().__init__(shape=statistics.mean.shape)
        self.mean, self.var, self.count = statistics.mean.copy(), statistics.var.copy(), statistics.count

    def update_from_moments(self, batch_mean: Any, batch_var: Any, batch_count: float) -> None:
        """Do nothing."""


def freeze_statistics(env: VecNormalize, keys: Collection[str], source: VecNormalize | None = None) -> None:
    """Let these statistics of observations stay as they are, or as ``source`` has them; others go on following."""
    parts = observation_statistics(source or env)
    frozen_by_key = {key: FrozenStatistics(part) for key, part in parts.items() if key in keys}
    by_key = observation_statistics(env) | frozen_by_key
    env.obs_rms = by_key if isinstance(env.obs_rms, dict) else by_key["observation"]


def _moments(moments: RunningMeanStd) -> dict[str, Any]:
    return {"mean": _numbers(moments.mean), "var": _numbers(moments.var), "count": float(moments.count)}


def _numbers(array: Any) -> dict[str, Any]:
    numbers = np.asarray(array)
    return {"type": numbers.dtype.name, "values": numbers.tolist()}


def _array(numbers: Mapping[str, Any]) -> Any:
    if numbers["type"] not in ("float32", "float64"):
        raise ValueError(f"numbers of type {numbers['type']!r}")
    return np.array(numbers["values"], dtype=numbers["type"])


def _is_progress(value: object) -> bool:
    """Return whether an attribute tells how far a model is: lists alone do not, which hold parts of its networks."""
    if isinstance(value, dict):  # an observation
        return bool(value) and all(isinstance(part, np.ndarray) for part in value.values())
    return not isinstance(value, list | Mapping | str) and is_plain(value)


def _like(now: Any, value: Any) -> Any:
    """Return a value as what the attribute is now: a queue of the same length, a named tuple of the same kind."""
    if isinstance(now, deque):
        return deque(value, maxlen=now.maxlen)
    if isinstance(now, tuple) and hasattr(now, "_fields"):
        return type(now)(*value)
    return value


def _noises(model: BaseAlgorithm) -> Iterator[Any]:
    """Yield what draws the noise of actions; one of each row if there are several."""
    noise = getattr(model, "action_noise", None)
    if noise is not None:
        yield from getattr(noise, "noises", [noise])


def _explorers(model: BaseAlgorithm) -> list[Any]:
    """Return distributions whose noise depends on the state."""
    parts = (model.policy, getattr(model.policy, "actor", None))
    drawn = [getattr(part, "action_dist", None) for part in parts]
    return [source for source in drawn if isinstance(getattr(source, MATRICES[0], None), torch.Tensor)]


def _first(value: Any, length: int, size: int) -> Any:
    if isinstance(value, dict):
        return {key: _first(part, length, size) for key, part in value.items()}
    return value[:length] if isinstance(value, np.ndarray) and value.ndim and len(value) == size else value
