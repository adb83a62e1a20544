"""One learner: algorithm, normaliser, random streams; how it learns, goes on acting, is saved and loaded."""

from __future__ import annotations

import gzip
import io
import math
import pickle
import warnings
import zlib
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from sb3_contrib import ARS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from cirl_marl.errors import RecipeError, RunError
from cirl_marl.learners.algorithms import algorithm_class, build
from cirl_marl.learners.demonstrations import Demonstrator, demonstrate, steps_counted
from cirl_marl.learners.lockstep import BudgetSpent
from cirl_marl.learners.recipe import LearnerSettings
from cirl_marl.learners.seat import Seat
from cirl_marl.learners.streams import Streams, global_streams_kept

UNREADABLE = (
    OSError, EOFError, zlib.error, pickle.UnpicklingError, ImportError,
    AssertionError, AttributeError, IndexError, TypeError, ValueError,
)  # fmt: skip
"""What a damaged file, or one of something else, raises when it is unpickled."""


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
    """

    model: BaseAlgorithm
    env: VecEnv
    demonstrator: Demonstrator | None = None

    def __init__(self, seat: Seat, spec: LearnerSettings, seed: int, *, done: int = 0) -> None:
        """Give the learner its streams, others after each number of joint steps ``done`` before.

        ``build`` or ``load`` makes the algorithm.
        """
        self.name = seat.name
        self.spec = spec
        self.seat = seat
        seat.bootstrap = spec.bootstrap
        self._seed = derived_seed(seed, seat.name, done)
        noisy = spec.parameters.get("action_noise") is not None
        self.streams = Streams(self._seed, keep_gaussian=noisy)

    def build(self) -> Learner:
        """Make a fresh algorithm; a ``RecipeError`` names the learner if the algorithm refuses its parameters."""
        spec = self.spec
        self.env = normalised(self.seat, spec)
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
        """Go on with the algorithm saved in ``folder``, and what it has seen.

        A rollout that was under way is lost, so its steps are not behind the learner but before it.

        Raises:
            RunError: if a file is missing, cannot be read, or is of another learner.
        """
        with self.streams.active():
            self.env = load_normaliser(folder, self.name, self.spec, self.seat) or self.seat
            self.model = load_model(folder, self.name, self.spec.algorithm, env=self.env)
            self.model.action_space.seed(self._seed)  # loading seeds it as at the beginning of the run
            if isinstance(self.model, OnPolicyAlgorithm):
                self.model.num_timesteps -= self.model.num_timesteps % (self.model.n_steps * self.seat.num_envs)
            if isinstance(self.model, OffPolicyAlgorithm):
                self._load_replay_buffer(self.model, folder / f"{self.name}.replay.pkl.gz")
        return self

    def _load_replay_buffer(self, model: OffPolicyAlgorithm, path: Path) -> None:
        try:
            with gzip.open(path, "rb") as packed, io.BufferedReader(packed) as file:
                model.load_replay_buffer(file)
        except UNREADABLE as error:
            raise RunError(f"{path}: cannot be read: {error}; it holds what '{self.name}' saw") from error
        buffer = model.replay_buffer
        assert buffer is not None
        found = (buffer.observation_space, buffer.action_space.shape, buffer.n_envs)
        if found != (self.env.observation_space, self.env.action_space.shape, self.seat.num_envs):
            raise RunError(f"{path}: holds what another learner saw: {buffer.observation_space}, {buffer.n_envs} rows")
        if isinstance(buffer, NStepReplayBuffer) and buffer.size():
            # episodes are fresh after loading, so that no return of n steps may go on from the last one kept
            buffer.timeouts[buffer.pos - 1] = np.logical_not(buffer.dones[buffer.pos - 1])

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
        if self.demonstrator is not None:
            leader, view = self.demonstrator, self.seat.view
            demonstrate(self.model, self.demonstrations, lambda: view.join(leader.act()))
        done = self.model.num_timesteps
        rows = self.seat.num_envs // self.seat.copies
        total = self.spec.steps_of(steps) * rows - done
        if isinstance(self.model, ARS):
            # It counts each step of its copies once for every copy, and schedules by this number, done before or not.
            total = self.budget(steps) * steps_counted(self.model, self.seat.num_envs)
        if total > 0:
            try:
                self.model.learn(total, callback=callback, reset_num_timesteps=done == 0)
            except BudgetSpent:
                if callback is not None:
                    callback.on_training_end()

    def act(self) -> None:
        """Act for ever by the learnt policy, learning nothing."""
        state: tuple[NDArray[Any], ...] | None = None
        done = np.ones(self.seat.num_envs, dtype=bool)
        while True:
            observation = self.seat.reset()
            if isinstance(self.env, VecNormalize):
                observation = self.env.normalize_obs(observation)  # type: ignore[arg-type]
            action, state = self.model.predict(observation, state, done, deterministic=True)  # type: ignore[arg-type]
            _, _, done, _ = self.seat.step(action)

    def save(self, folder: Path, *, replay: bool) -> None:
        """Save policy, optimiser and normaliser, and the replay buffer if learning may go on."""
        self.model.save(folder / f"{self.name}.zip")
        if isinstance(self.env, VecNormalize):
            self.env.save(str(folder / f"{self.name}.normaliser.pkl"))
        if replay and isinstance(self.model, OffPolicyAlgorithm) and self.model.replay_buffer is not None:
            path = folder / f"{self.name}.replay.pkl.gz"  # packed, as a buffer has room for much more than it holds
            with gzip.open(path, "wb", compresslevel=1) as packed, io.BufferedWriter(packed) as file:
                self.model.save_replay_buffer(file)


def normalised(env: VecEnv, spec: LearnerSettings, keys: list[str] | None = None) -> VecEnv:
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


def load_model(folder: Path, name: str, algorithm: str, env: VecEnv | None = None) -> BaseAlgorithm:
    """Load the policy that the learner ``name`` learnt; the global random streams are left as they were."""
    path = folder / f"{name}.zip"
    with global_streams_kept(), warnings.catch_warnings():
        # of learners with returns of n steps: the library saved the buffer's class, and takes it for one of the user's
        warnings.filterwarnings("ignore", message=r"`n_steps=\d+` is ignored because a custom")
        try:
            return algorithm_class(algorithm).load(path, env=env, device="cpu")
        except (*UNREADABLE, KeyError, RuntimeError) as error:
            raise RunError(f"{path}: cannot be read: {error}") from error


def load_normaliser(folder: Path, name: str, spec: LearnerSettings, seat: Seat | None = None) -> VecNormalize | None:
    """Load the normaliser saved with a policy; None if its recipe does not normalise."""
    if not spec.normalise.any:
        return None
    path = folder / f"{name}.normaliser.pkl"
    try:
        if seat is not None:
            return VecNormalize.load(str(path), seat)
        with path.open("rb") as file:
            return cast(VecNormalize, pickle.load(file))
    except UNREADABLE as error:
        raise RunError(f"{path}: cannot be read: {error}; without it the policy of '{name}' is useless") from error
