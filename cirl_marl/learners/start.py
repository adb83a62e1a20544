"""A start from what was learnt before: its policy and the statistics of its observations.

From another run the policy comes whole, with critics and a learnt entropy coefficient; of a recipe that learnt first
only what acts. Optimiser, replay buffer, statistics of rewards and schedules begin anew, as rewards, copies and steps
may be others now. The statistics of observations stay as they were: another environment shows other states more often,
and a policy that sees the same state in other numbers forgets.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path

from torch import Tensor

from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RecipeError, unknown_name
from cirl_marl.learners.checkpoint import CRITICS, freeze_statistics, set_variables, variables
from cirl_marl.learners.demonstrations import keep_parameters
from cirl_marl.learners.learner import Learner, load_acting_learner
from cirl_marl.learners.recipe import LearnerSettings, Start
from cirl_marl.learners.run_directory import Origin, RunDirectory
from cirl_marl.learners.views import CENTRAL_CRITIC
from cirl_marl.records.files import sha256_of

NAMES_LISTED = 3
"""Entries that a message lists of those that differ."""
EXPLORATION = "log_std"
"""Beginning of the names of parameters that spread actions, but do not decide what a policy does without noise."""

Bounds = tuple[float, float]


def begin_from(learner: Learner, start: Start, env: MultiAgentVectorEnv, run: str | Path) -> Origin:
    """Give a fresh ``learner`` in ``env`` the policy that a ``run`` learnt, as its ``start`` says; return its origin.

    Raises:
        RecipeError: if there is no such run or learner, if its run is not whole, or if it learnt something else.
    """
    try:
        return _begin_from(RunDirectory(run), start, learner, env)
    except CirlError as error:
        raise RecipeError(f"{learner.agent_env.title}: start: {error}") from error


def _begin_from(run: RunDirectory, start: Start, learner: Learner, env: MultiAgentVectorEnv) -> Origin:
    name, groups = start.agent or learner.name, {part.name: part for part in run.groups()}
    if name not in groups:
        raise RecipeError(f"{run.path}: {unknown_name('agent', name, groups)}")
    group, source, folder = groups[name], run.make_env(1), run.acting_checkpoint
    view = learner.agent_env.view
    _refuse(f"{run.path}: '{name}'", [*_other_settings(group.spec, learner.spec)])
    entries = (_entries(source, group.agents, learner.spec), _entries(env, view.agents, learner.spec))
    actions, actions_here = group.view(source).action_space, view.action_space
    other_actions = [] if actions == actions_here else [f"acts in {actions}, not in {actions_here}"]
    _refuse(f"{run.path}: '{name}'", [*_other_entries(*entries), *other_actions])
    source_learner = load_acting_learner(folder, group, source)
    weights, present = (_weights_to_take(part, start) for part in (source_learner, learner))
    _refuse(f"{folder / name}.json:", [*_other_shapes(weights, present)])
    learner.model.policy.load_state_dict(learner.model.policy.state_dict() | weights)
    _take_over(source_learner, learner, start)
    files = [folder / f"{name}.{kind}" for kind in ("json", "safetensors")]
    hashes = {file.name: sha256_of(file) for file in files}
    return Origin(run=start.recipe or str(run.path.resolve()), agent=name, checkpoint=folder.name, sha256=hashes)


def _weights_to_take(learner: Learner, start: Start) -> dict[str, Tensor]:
    """Return the weights that a start takes over: all of a run, those by which it acts of a recipe."""
    weights: dict[str, Tensor] = learner.model.policy.state_dict()
    if start.takes_critics:
        return weights
    return {name: value for name, value in weights.items() if not name.startswith((*CRITICS, EXPLORATION))}


def begin_again(folder: Path, learner: Learner) -> None:
    """Give a fresh ``learner`` the start that a checkpoint of its own run holds."""
    learner.take(folder)
    if learner.spec.start is not None and learner.normaliser is not None and learner.normaliser.norm_obs:
        freeze_statistics(learner.normaliser, learner.spec.start.frozen_statistics)


def _refuse(subject: str, mistakes: Sequence[str]) -> None:
    if mistakes:
        raise RecipeError(f"{subject} {'; '.join(mistakes)}")


def _take_over(source: Learner, learner: Learner, start: Start) -> None:
    """Copy the statistics of observations and, from a run, a learnt entropy coefficient."""
    model, normaliser = learner.model, learner.normaliser
    keep_parameters(model)
    if start.takes_critics:
        set_variables(model, variables(model) | variables(source.model))
    if source.normaliser is not None and normaliser is not None and normaliser.norm_obs:
        freeze_statistics(normaliser, start.frozen_statistics, source.normaliser)


def _other_settings(source: LearnerSettings, target: LearnerSettings) -> Iterator[str]:
    """Yield which settings that a policy depends on differ."""
    normalisation = [f"normalise.{key}" for key in ("observation", "clip_observation", "epsilon")]
    critics = ["policy"] if target.start is None or target.start.takes_critics else []
    for key in ("scheme", "algorithm", *critics, *normalisation):
        old, new = map(attrgetter(key), (source, target))
        if old != new and (source.normalise.observation or key not in normalisation[1:]):
            yield f"has {key} = {_toml(old)}, not {_toml(new)}"


def _toml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _entries(env: MultiAgentVectorEnv, agents: Sequence[str], spec: LearnerSettings) -> dict[str, Bounds]:
    """Return what a learner of ``agents`` sees, in order, with its bounds."""
    bounds: dict[str, Bounds] = {}
    for agent in agents:
        space, prefix = env.observation_spaces[agent], f"{agent}: " if spec.scheme != "independent" else ""
        for name, low, high in zip(env.layout.names[agent], space.low.tolist(), space.high.tolist(), strict=True):
            bounds[prefix + name] = low, high
    if spec.policy == CENTRAL_CRITIC and (spec.start is None or spec.start.takes_critics):
        bounds |= {f"state: {name}": (0.0, 0.0) for name in env.state_names}
    return bounds


def _other_entries(source: Mapping[str, Bounds], target: Mapping[str, Bounds]) -> Iterator[str]:
    """Yield which entries of the observation are only there or only here, have another place or other bounds."""
    sides = (("only there", source, target), ("only here", target, source))
    alone = [(side, [name for name in entries if name not in opposite]) for side, entries, opposite in sides]
    if any(names for _, names in alone):
        lists = (f"{side} {_first_names(names)}" for side, names in alone if names)
        yield f"sees other things, {len(source)} entries there and {len(target)} here: {'; '.join(lists)}"
    elif displaced_names := [name for name, opposite in zip(source, target, strict=True) if name != opposite]:
        yield f"sees the same in another order, from {_first_names(displaced_names)} on"
    else:
        for name in target:
            if source[name] != target[name]:
                yield f"sees '{name}' in {list(source[name])}, not in {list(target[name])}"


def _first_names(names: Sequence[str]) -> str:
    more = f" and {len(names) - NAMES_LISTED} more" if len(names) > NAMES_LISTED else ""
    return ", ".join(f"'{name}'" for name in names[:NAMES_LISTED]) + more


def _other_shapes(source: Mapping[str, Tensor], target: Mapping[str, Tensor]) -> Iterator[str]:
    """Yield which weights two policies do not have in common; the first says enough."""
    old, new = ({key: tuple(value.shape) for key, value in part.items()} for part in (source, target))
    for key in (*old, *new):
        if old.get(key) != new.get(key):
            shapes = [str(shapes[key]) if key in shapes else "missing" for shapes in (old, new)]
            yield f"weights '{key}' are {shapes[0]} there and {shapes[1]} here; write policy_kwargs as there"
            return
