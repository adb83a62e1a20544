"""One learner: algorithm, normaliser, random streams; how it learns, goes on acting, is saved and loaded."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from sb3_contrib import ARS, MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import Schedule, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RecipeError, RunError
from cirl_marl.learners.agent_env import AgentVecEnv, StepResult
from cirl_marl.learners.algorithms import algorithm_class, build, has_replay_buffer
from cirl_marl.learners.barrier import CheckpointBarrier
from cirl_marl.learners.checkpoint import (
    UNREADABLE,
    buffer_state,
    freeze_statistics,
    model_state,
    normaliser_state,
    read_tree,
    set_buffer_state,
    set_model_state,
    set_normaliser_state,
    set_variables,
    variables,
    write_tree,
)
from cirl_marl.learners.demonstrations import Demonstrator, demonstrate, keep_parameters, steps_counted
from cirl_marl.learners.lockstep import BudgetSpent, Streams, wait
from cirl_marl.learners.recipe import Group, LearnerSettings

ACTING_PARAMETERS = ("policy_kwargs", "use_sde", "ent_coef", "gamma")
"""Parameters on which it depends what acts."""


def derived_seed(seed: int, *names: str | int) -> int:
    """Return a seed below 2³¹ that depends on ``seed`` and ``names`` only, not on who else learns.

    Up to three names, zeros at the end do not count, so that what begins at step 0 needs no number.

    >>> derived_seed(0, "mine") == derived_seed(0, "mine", 0) != derived_seed(0, "use")
    True
    """
    keys = [name if isinstance(name, int) else zlib.crc32(name.encode()) for name in names]
    return int(np.random.SeedSequence([seed, *keys]).generate_state(1)[0] >> 1)


class Learner:
    """A learner seated in the joint environment.

    Attributes:
        spec: its part of the recipe.
        seat: its view of the environment, from which it has its name.
        env: the seat, behind ``VecNormalize`` if the recipe normalises.
        model: the algorithm, as Stable-Baselines3 made it.
        demonstrator: whom it follows before it acts itself; None if it needs nobody.
        boundary: where it can be saved.
        was_stacked: of one that goes on: whether it was one of a stack; None of others.
        shown: whether it follows its demonstrator now.
    """

    model: BaseAlgorithm
    env: VecEnv
    demonstrator: Demonstrator | None = None

    def __init__(self, seat: AgentVecEnv, spec: LearnerSettings, seed: int, *, done: int = 0) -> None:
        """Give the learner its streams, others after each number of joint steps ``done`` before.

        ``build`` or ``load`` makes the algorithm.
        """
        self.name = seat.name
        self.spec = spec
        self.seat = seat
        seat.bootstrap = spec.bootstrap
        self._seed = derived_seed(seed, seat.name, done)
        self.boundary = CheckpointBarrier(seat)
        self._begun = 0
        self.was_stacked: bool | None = None
        self.shown = False
        noisy = spec.parameters.get("action_noise") is not None
        self.streams = Streams(self._seed, keep_gaussian=noisy)

    def build(self) -> Learner:
        """Make a fresh algorithm; a ``RecipeError`` names the learner if the algorithm refuses its parameters."""
        spec = self.spec
        self.env = wrap_in_normaliser(self.seat, spec)
        parameters = dict(spec.parameters)
        if issubclass(algorithm_class(spec.algorithm), ARS):
            parameters.setdefault("n_eval_episodes", self.seat.num_envs)
        with self.streams.active():
            try:
                self.model = build(spec.algorithm, spec.policy, self.env, parameters, seed=self._seed, device="cpu")
            except RecipeError as error:
                raise RecipeError(f"{self.seat.title}: {error}") from error
        frequency = getattr(self.model, "train_freq", None)
        if self.seat.num_envs > 1 and isinstance(frequency, TrainFreq) and frequency.unit is TrainFrequencyUnit.EPISODE:
            raise RecipeError(
                f"{self.seat.title}: parameters.train_freq: {spec.algorithm} learns after whole episodes in a single "
                f"environment only, not in {self.seat.num_envs}; give a number of steps"
            )
        return self

    def load(self, folder: Path) -> Learner:
        """Make the algorithm, and go on with what it knew when it had learnt enough.

        Raises:
            RunError: if a file is missing, cannot be read, or is of another learner.
        """
        self.build()
        told = read_tree(folder, f"{self.name}.state")
        with self._naming(folder):
            self._set(told)
        self.model._last_obs = None  # the episode that was under way is over
        self._begun = self.model.num_timesteps
        return self

    def go_on(self, folder: Path) -> Learner:
        """Make the algorithm, and go on to the bit from where it was saved in the middle of a training.

        One of a stack is brought into its state at once, one that learns by itself at its first boundary.

        Raises:
            RunError: if a file is missing, cannot be read, or is of another learner.
        """
        self.build()
        told, noted = read_tree(folder, f"{self.name}.state"), read_tree(folder, f"{self.name}.journal")

        def read() -> None:
            with self._naming(folder):
                self._set(told)
                self.streams.go_on(told["streams"], active=not self.was_stacked)

        with self._naming(folder):
            self.was_stacked = told["stacked"]
            self._begun = told["model"]["values"]["_num_timesteps_at_start"]
            self.model.num_timesteps = self._begun
            self.boundary.again = [(action, StepResult(**handed)) for action, handed in noted]
            self.boundary.begins_at(read, StepResult(**told["handed"]), told["acting"])
            if self.was_stacked:
                read()
                self.boundary.begins_at(lambda: None, StepResult(**told["handed"]), told["acting"])
        return self

    @contextmanager
    def _naming(self, folder: Path) -> Iterator[None]:
        """Say of what cannot be read which file it is."""
        try:
            yield
        except (*UNREADABLE, RuntimeError, AssertionError) as error:
            path = folder / f"{self.name}.state.json"
            raise RunError(f"{path}: cannot be read: {error}; it holds what {self.seat.title} knew") from error

    def _set(self, told: Mapping[str, Any]) -> None:
        set_model_state(self.model, told["model"])
        if isinstance(self.env, VecNormalize):
            if self.spec.start is not None and self.env.norm_obs:
                freeze_statistics(self.env)
            set_normaliser_state(self.env, told["normaliser"])
        buffer = getattr(self.model, "replay_buffer", None)
        if buffer is not None and told["buffer"] is not None:
            set_buffer_state(buffer, told["buffer"])

    def write_state(self, folder: Path, more: Mapping[str, Any], *, stacked: bool = False, last: bool = False) -> None:
        """Write all that the learner goes on from, with its policy, between two rollouts.

        Args:
            folder: of the checkpoint.
            more: what else belongs to the state.
            stacked: whether it is one of a stack, whose streams are put away, as they are at the end.
            last: whether the training is over, of which no replay buffer is kept.
        """
        self.save(folder)
        kept = None if last else getattr(self.model, "replay_buffer", None)
        told = {
            "model": model_state(self.model),
            "normaliser": normaliser_state(self.env) if isinstance(self.env, VecNormalize) else None,
            "buffer": None if kept is None else buffer_state(kept),
            "streams": self.streams.told(active=not stacked and not last),
            "stacked": stacked,
        }
        write_tree(folder, f"{self.name}.state", {**told, **more})

    def write_journal(self, folder: Path) -> None:
        """Write what came after the state that it wrote."""
        noted = self.boundary.noted or []
        write_tree(folder, f"{self.name}.journal", [(action, handed.told()) for action, handed in noted])

    def budget(self, steps: int) -> int:
        """Joint steps after which it is stopped; only ARS, which may be in mid-update then, does not stop by itself."""
        if isinstance(self.model, ARS):
            return math.ceil(self.spec.steps_of(steps) / self.seat.copies)
        return 2**62

    @property
    def demonstrations(self) -> int:
        """Number of the learner's own steps by which its demonstrations are over; 0 if it needs none, or no more."""
        asked = self.spec.demonstrations
        joint = 0 if asked is None else math.ceil(asked.steps / self.seat.copies)
        steps = joint * steps_counted(self.model, self.seat.num_envs)
        return steps if steps > self.model.num_timesteps else 0

    def learn(self, steps: int, callback: BaseCallback | None) -> None:
        """Run the algorithm's own ``learn()`` up to its share of ``steps``, counting what it had learnt before.

        A shared policy makes one step of its own for each of its agents. Demonstrations come first, and count.
        """
        if self.boundary.acting is not None:
            return
        if self.demonstrator is not None and not self.boundary.resuming:
            leader, view = self.demonstrator, self.seat.view
            self.shown = True
            demonstrate(self.model, self.demonstrations, lambda: view.join(leader.act()))
            self.shown, self._begun = False, self.model.num_timesteps
        rows = self.seat.num_envs // self.seat.copies
        total = self.spec.steps_of(steps) * rows - self._begun
        if isinstance(self.model, ARS):
            # It counts each step of its copies once for every copy, and schedules by this number, done before or not.
            total = self.budget(steps) * steps_counted(self.model, self.seat.num_envs)
        self._learn(total, callback)

    def learn_on(self, steps: int, callback: BaseCallback | None) -> None:
        """Run the algorithm's own ``learn()`` for so many steps more, from what its seat shows now."""
        self._begun, self.model._last_obs = self.model.num_timesteps, None
        counted = steps_counted(self.model, self.seat.num_envs) if isinstance(self.model, ARS) else self.seat.num_envs
        self._learn(math.ceil(steps / self.seat.copies) * counted, callback)

    def _learn(self, total: int, callback: BaseCallback | None) -> None:
        """Run the algorithm's own ``learn()`` for ``total`` steps as it counts them, or until it is stopped."""
        if total > 0:
            callbacks = [each for each in (AtRollouts(self.boundary), callback) if each is not None]
            try:
                with at_updates(self.model, self.boundary):
                    self.model.learn(total, callback=callbacks, reset_num_timesteps=self._begun == 0)
            except BudgetSpent:
                if callback is not None:
                    callback.on_training_end()

    def act(self) -> None:
        """Act for ever by the learnt policy, learning nothing."""
        known = self.boundary.acting or {"memory": None, "starts": np.ones(self.seat.num_envs, dtype=bool)}
        state, done = known["memory"], known["starts"]
        while True:
            self.boundary.reached({"memory": state, "starts": done})
            observation = self.seat.reset()
            if isinstance(self.env, VecNormalize):
                observation = self.env.normalize_obs(observation)  # type: ignore[arg-type]
            action, state = predict_action(self.model, observation, state, done, self.seat)
            _, _, done, _ = self.seat.step(action)

    def save(self, folder: Path) -> None:
        """Write what acts: policy and normaliser, and a learnt entropy coefficient for who starts from it."""
        told = {
            "algorithm": self.spec.algorithm,
            "policy": dict(self.model.policy.state_dict()),
            "variables": variables(self.model),
            "normaliser": normaliser_state(self.env) if isinstance(self.env, VecNormalize) else None,
        }
        write_tree(folder, self.name, told)

    def take(self, folder: Path) -> Learner:
        """Take over what ``save`` wrote.

        Raises:
            RunError: if a file is missing, cannot be read, or is of another learner.
        """
        told, path = read_tree(folder, self.name), folder / f"{self.name}.json"
        try:
            if told["algorithm"] != self.spec.algorithm:
                raise RunError(f"it is of {told['algorithm']}, not {self.spec.algorithm}")
            self.model.policy.load_state_dict(told["policy"])
            set_variables(self.model, told["variables"])
            keep_parameters(self.model)
            if isinstance(self.env, VecNormalize):
                set_normaliser_state(self.env, told["normaliser"], returns=False)
        except (RunError, RuntimeError) as error:
            message = f"{path}: '{self.name}' is for other observations or actions: {error}"
            raise RunError(message) from error
        except UNREADABLE as error:
            raise RunError(f"{path}: cannot be read: {error!r}") from error
        return self


def predict_action(
    model: BaseAlgorithm, observation: Any, memory: Any, starts: Any, env: VecEnv, *, deterministic: bool = True
) -> tuple[Any, Any]:
    """Return what a policy does and remembers; only what is legal if it knows of masks and ``env`` has some."""
    masks: dict[str, Any] = {}
    if isinstance(model, MaskablePPO) and is_masking_supported(env):
        masks = {"action_masks": get_action_masks(env)}
    return model.predict(observation, memory, starts, deterministic=deterministic, **masks)


def load_acting_learner(folder: Path, group: Group, env: MultiAgentVectorEnv) -> Learner:
    """Return a learner that acts by what a checkpoint holds of ``group``, and is not made to learn."""
    parameters = {key: value for key, value in group.spec.parameters.items() if key in ACTING_PARAMETERS}
    if has_replay_buffer(group.spec.algorithm):
        parameters["buffer_size"] = 1
    spec = group.spec.model_copy(update={"parameters": parameters})
    return Learner(AgentVecEnv(env, group.name, group.view(env), wait), spec, 0).build().take(folder)


class AtRollouts(BaseCallback):
    """Tells of the beginning of every rollout of an algorithm that collects them."""

    def __init__(self, boundary: CheckpointBarrier) -> None:
        """Tell ``boundary``."""
        super().__init__()
        self._boundary = boundary

    def _on_rollout_start(self) -> None:
        if not isinstance(self.model, ARS):
            self._boundary.reached()

    def _on_step(self) -> bool:
        return True


class _ScheduleAtUpdates:
    """A schedule that ARS asks for at the beginning of every update, before it draws; it is saved as it was."""

    def __init__(self, schedule: Schedule, model: ARS, boundary: CheckpointBarrier) -> None:
        self._schedule, self._model, self._boundary = schedule, model, boundary

    def __call__(self, _remaining: float) -> float:
        self._boundary.reached()
        return self._schedule(self._model._current_progress_remaining)

    def __reduce__(self) -> tuple[Any, ...]:
        return _itself, (self._schedule,)


def _itself(value: Any) -> Any:
    return value


@contextmanager
def at_updates(model: BaseAlgorithm, boundary: CheckpointBarrier) -> Iterator[None]:
    """Tell ``boundary`` of the beginning of every update of ARS, which draws its candidates before its rollouts."""
    if not isinstance(model, ARS):
        yield
        return
    schedule = model.delta_std_schedule
    model.delta_std_schedule = _ScheduleAtUpdates(schedule, model, boundary)  # type: ignore[assignment]
    try:
        yield
    finally:
        model.delta_std_schedule = schedule


def wrap_in_normaliser(env: VecEnv, spec: LearnerSettings, keys: list[str] | None = None) -> VecEnv:
    """Return ``env`` behind the normaliser that the settings ask for, if they do; of a dict ``keys`` are normalised."""
    normalise = spec.normalise
    if not normalise.any:
        return env
    return VecNormalize(
        env,
        norm_obs=normalise.observation,
        norm_reward=normalise.reward,
        clip_obs=normalise.clip_observation,
        clip_reward=normalise.clip_reward,
        gamma=spec.parameters.get("gamma", 0.99),
        norm_obs_keys=keys,
    )
