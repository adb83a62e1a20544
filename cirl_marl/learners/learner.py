"""One learner: algorithm, normaliser, random streams; how it learns, goes on acting, is saved and loaded."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from sb3_contrib import ARS, MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RecipeError, RunError
from cirl_marl.learners import checkpoint
from cirl_marl.learners.agent_env import AgentVecEnv, StepResult
from cirl_marl.learners.algorithms import algorithm_class, build, has_replay_buffer
from cirl_marl.learners.barrier import BarrierCallback, CheckpointBarrier, barrier_at_updates
from cirl_marl.learners.demonstrations import Demonstrator, demonstrate, keep_parameters, steps_counted
from cirl_marl.learners.lockstep import BudgetSpent, Streams
from cirl_marl.learners.policies import Policy
from cirl_marl.learners.recipe import Group, LearnerSettings

ACTING_PARAMETERS = ("policy_kwargs", "use_sde", "ent_coef", "gamma")
"""Parameters that shape the policy; the others matter to training only."""

TENSORBOARD_ADVICE = "pip install 'cirl-marl[tensorboard]'"


def has_tensorboard() -> bool:
    """Return whether learning curves can be written: TensorBoard is an extra."""
    return find_spec("tensorboard") is not None


def derived_seed(seed: int, *names: str | int) -> int:
    """Return a seed below 2³¹ that depends on ``seed`` and ``names`` only, not on who else learns.

    Up to three names, zeros at the end do not count, so that what begins at step 0 needs no number.

    >>> derived_seed(0, "mine") == derived_seed(0, "mine", 0) != derived_seed(0, "use")
    True
    """
    keys = [name if isinstance(name, int) else zlib.crc32(name.encode()) for name in names]
    return int(np.random.SeedSequence([seed, *keys]).generate_state(1)[0] >> 1)


class Learner:
    """An algorithm of Stable-Baselines3 and all that belongs to it, in one agent's view of the joint environment.

    Attributes:
        spec: its part of the recipe.
        agent_env: its view of the joint environment, from which it has its name.
        env: ``agent_env``, behind ``VecNormalize`` if the recipe normalises.
        model: the algorithm, as Stable-Baselines3 made it.
        demonstrator: the controller that it follows before it acts itself; None if there is none.
        barrier: where it can be saved.
        was_in_stack: of a resumed learner: whether it was one of a stack; None of others.
        follows_demonstrator: whether the controller acts in its place now.
    """

    model: BaseAlgorithm
    env: VecEnv
    demonstrator: Demonstrator | None = None

    def __init__(self, agent_env: AgentVecEnv, spec: LearnerSettings, seed: int, *, done: int = 0) -> None:
        """Give the learner its streams, others after each number of joint steps ``done`` before.

        ``build`` or ``load`` makes the algorithm.
        """
        self.name = agent_env.name
        self.spec = spec
        self.agent_env = agent_env
        agent_env.bootstrap, agent_env.centre_rewards = spec.bootstrap, spec.centre_rewards
        self._seed = derived_seed(seed, agent_env.name, done)
        self.barrier = CheckpointBarrier(agent_env)
        self._first_timestep = 0
        self.was_in_stack: bool | None = None
        self.follows_demonstrator = False
        noisy = spec.parameters.get("action_noise") is not None
        self.streams = Streams(self._seed, keep_gaussian=noisy)

    @property
    def normaliser(self) -> VecNormalize | None:
        """The normaliser of what it observes and is paid; None if it takes things as they are."""
        return self.env if isinstance(self.env, VecNormalize) else None

    @property
    def policy(self) -> Policy:
        """What acts, for ``Policies``."""
        return Policy(self.model, self.normaliser, self.agent_env.view)

    def build(self) -> Learner:
        """Make a fresh algorithm; a ``RecipeError`` names the learner if the algorithm refuses its parameters."""
        spec = self.spec
        self.env = wrap_in_normaliser(self.agent_env, spec)
        parameters = dict(spec.parameters)
        if issubclass(algorithm_class(spec.algorithm), ARS):
            parameters.setdefault("n_eval_episodes", self.agent_env.num_envs)
        with self.streams.active():
            try:
                self.model = build(spec.algorithm, spec.policy, self.env, parameters, seed=self._seed, device="cpu")
            except RecipeError as error:
                raise RecipeError(f"{self.agent_env.title}: {error}") from error
        frequency, rows = getattr(self.model, "train_freq", None), self.agent_env.num_envs
        if rows > 1 and isinstance(frequency, TrainFreq) and frequency.unit is TrainFrequencyUnit.EPISODE:
            raise RecipeError(
                f"{self.agent_env.title}: parameters.train_freq: {spec.algorithm} learns after whole episodes in a "
                f"single environment only, not in {rows}; give a number of steps"
            )
        return self

    def load(self, folder: Path) -> Learner:
        """Make the algorithm, and load the state that it had at the end of a training; errors as ``take`` has them."""
        self.build()
        state = checkpoint.read_tree(folder, f"{self.name}.state")
        with self._errors_name_file(folder):
            self._set(state)
        self.model._last_obs = None  # the episode that was under way is over
        self._first_timestep = self.model.num_timesteps
        return self

    def restore(self, folder: Path) -> Learner:
        """Make the algorithm, and resume, to the bit, from where it was saved in the middle of a training.

        A learner of a stack loads its state at once, one that learns by itself at its first barrier. Errors are those
        of ``take``.
        """
        self.build()
        state, log = (checkpoint.read_tree(folder, f"{self.name}.{part}") for part in ("state", "journal"))

        def load() -> None:
            with self._errors_name_file(folder):
                self._set(state)
                self.streams.load_state_dict(state["streams"], active=not self.was_in_stack)

        def load_at_barrier() -> None:
            self.agent_env.last_step = last_step
            if not self.was_in_stack:
                load()

        with self._errors_name_file(folder):
            self.was_in_stack = state["stacked"]
            self._first_timestep = state["model"]["values"]["_num_timesteps_at_start"]
            self.model.num_timesteps = self._first_timestep
            steps = ((np.array(action, np.float32), StepResult.from_dict(step)) for action, step in log)
            self.barrier.replay_log = list(steps)
            if self.was_in_stack:
                load()
            last_step = StepResult.from_dict(state["handed"])
            self.barrier.load, self.barrier.loaded_acting_state = load_at_barrier, state["acting"]
        return self

    @contextmanager
    def _errors_name_file(self, folder: Path) -> Iterator[None]:
        """Name the file in errors that reading the state raises."""
        try:
            yield
        except (*checkpoint.UNREADABLE, RuntimeError, AssertionError) as error:
            path = folder / f"{self.name}.state.json"
            raise RunError(f"{path}: cannot be read: {error}; it holds what {self.agent_env.title} knew") from error

    def _set(self, state: Mapping[str, Any]) -> None:
        checkpoint.set_model_state(self.model, state["model"])
        if self.normaliser is not None:
            if self.spec.start is not None and self.normaliser.norm_obs:
                checkpoint.freeze_statistics(self.normaliser, self.spec.start.frozen_statistics)
            checkpoint.set_normaliser_state(self.normaliser, state["normaliser"])
        buffer = getattr(self.model, "replay_buffer", None)
        if buffer is not None and state["buffer"] is not None:
            checkpoint.set_buffer_state(buffer, state["buffer"])

    def write_state(self, folder: Path, more: Mapping[str, Any], *, in_stack: bool = False, last: bool = False) -> None:
        """Write policy and state, from which the learner resumes; at a barrier or at the end.

        Args:
            folder: of the checkpoint.
            more: further entries of the state.
            in_stack: whether the learner is one of a stack; its random streams are not the active ones then.
            last: whether the training is over: no replay buffer is kept, and the streams are not active.
        """
        self.save(folder)
        buffer = None if last else getattr(self.model, "replay_buffer", None)
        state = {
            "model": checkpoint.model_state(self.model),
            "normaliser": None if self.normaliser is None else checkpoint.normaliser_state(self.normaliser),
            "buffer": None if buffer is None else checkpoint.buffer_state(buffer),
            "streams": self.streams.state_dict(active=not in_stack and not last),
            "stacked": in_stack,
        }
        checkpoint.write_tree(folder, f"{self.name}.state", {**state, **more})

    def write_journal(self, folder: Path) -> None:
        """Write the steps since the state was written: the replay log."""
        log = [(action, step.as_dict()) for action, step in self.barrier.log or []]
        checkpoint.write_tree(folder, f"{self.name}.journal", log)

    def budget(self, steps: int) -> int:
        """Joint steps after which it is stopped; only ARS, which may be in mid-update then, does not stop by itself."""
        if isinstance(self.model, ARS):
            return math.ceil(self.spec.steps_of(steps) / self.agent_env.copies)
        return 2**62

    @property
    def demonstrations(self) -> int:
        """Number of the learner's own steps by which its demonstrations are over; 0 if it needs none, or no more."""
        settings = self.spec.demonstrations
        joint = 0 if settings is None else math.ceil(settings.steps / self.agent_env.copies)
        steps = joint * steps_counted(self.model, self.agent_env.num_envs)
        return steps if steps > self.model.num_timesteps else 0

    def log_to_tensorboard(self, folder: Path) -> None:
        """Write learning curves to a folder."""
        self.model.set_logger(configure(str(folder), ["tensorboard"]))

    def learn(self, steps: int, callback: BaseCallback | None) -> None:
        """Run the algorithm's own ``learn()`` up to its share of ``steps``, counting what it had learnt before.

        A shared policy makes one step of its own for each of its agents. Demonstrations come first, and count.
        """
        if self.barrier.acting_state is not None:
            return
        if (controller := self.demonstrator) is not None and not self.barrier.is_restoring:
            self.follows_demonstrator = True
            demonstrate(self.model, self.demonstrations, lambda: self.agent_env.view.join(controller.act()))
            self.follows_demonstrator, self._first_timestep = False, self.model.num_timesteps
        rows = self.agent_env.num_envs // self.agent_env.copies
        total = self.spec.steps_of(steps) * rows - self._first_timestep
        if isinstance(self.model, ARS):
            # It counts each step of its copies once for every copy, and schedules by this number, done before or not.
            total = self.budget(steps) * steps_counted(self.model, self.agent_env.num_envs)
        self._learn(total, callback)

    def learn_on(self, steps: int, callback: BaseCallback | None) -> None:
        """Run the algorithm's own ``learn()`` for so many steps more, from the present observation."""
        self._first_timestep, self.model._last_obs = self.model.num_timesteps, None
        joint_steps = math.ceil(steps / self.agent_env.copies)
        self._learn(joint_steps * steps_counted(self.model, self.agent_env.num_envs), callback)

    def _learn(self, total: int, callback: BaseCallback | None) -> None:
        """Run the algorithm's own ``learn()`` for ``total`` steps as it counts them, or until it is stopped."""
        if total > 0:
            callbacks = [hook for hook in (BarrierCallback(self.barrier), callback) if hook is not None]
            try:
                with barrier_at_updates(self.model, self.barrier):
                    self.model.learn(total, callback=callbacks, reset_num_timesteps=self._first_timestep == 0)
            except BudgetSpent:
                if callback is not None:
                    callback.on_training_end()

    def act(self) -> None:
        """Act by the learnt policy until the training ends, learning nothing."""
        fresh = {"memory": None, "starts": np.ones(self.agent_env.num_envs, dtype=bool)}
        state = dict(self.barrier.acting_state or fresh)
        while True:
            self.barrier.arrive(dict(state))
            observation = self.agent_env.reset()
            if self.normaliser is not None:
                observation = self.normaliser.normalize_obs(observation)  # type: ignore[arg-type]
            action, state["memory"] = predict_action(self.model, observation, **state, env=self.agent_env)
            _, _, state["starts"], _ = self.agent_env.step(action)

    def save(self, folder: Path) -> None:
        """Write policy, normaliser and a learnt entropy coefficient: enough to act, and to start another run from."""
        state = {
            "algorithm": self.spec.algorithm,
            "policy": dict(self.model.policy.state_dict()),
            "variables": checkpoint.variables(self.model),
            "normaliser": None if self.normaliser is None else checkpoint.normaliser_state(self.normaliser),
        }
        checkpoint.write_tree(folder, self.name, state)

    def take(self, folder: Path) -> Learner:
        """Load what ``save`` wrote.

        Raises:
            RunError: if a file is missing, cannot be read, or is of another learner.
        """
        state, path = checkpoint.read_tree(folder, self.name), folder / f"{self.name}.json"
        try:
            if state["algorithm"] != self.spec.algorithm:
                raise RunError(f"it is of {state['algorithm']}, not {self.spec.algorithm}")
            self.model.policy.load_state_dict(state["policy"])
            checkpoint.set_variables(self.model, state["variables"])
            keep_parameters(self.model)
            if self.normaliser is not None:
                checkpoint.set_normaliser_state(self.normaliser, state["normaliser"], returns=False)
        except (RunError, RuntimeError) as error:
            raise RunError(f"{path}: '{self.name}' is for other observations or actions: {error}") from error
        except checkpoint.UNREADABLE as error:
            raise RunError(f"{path}: cannot be read: {error!r}") from error
        return self


def predict_action(
    model: BaseAlgorithm, observation: Any, memory: Any, starts: Any, env: VecEnv, *, deterministic: bool = True
) -> tuple[Any, Any]:
    """Return actions and recurrent state of a policy; legal actions only if it takes masks and ``env`` has some."""
    masks: dict[str, Any] = {}
    if isinstance(model, MaskablePPO) and is_masking_supported(env):
        masks = {"action_masks": get_action_masks(env)}
    return model.predict(observation, memory, starts, deterministic=deterministic, **masks)


def load_acting_learner(folder: Path, group: Group, env: MultiAgentVectorEnv) -> Learner:
    """Return the learner of ``group`` with the policy of a checkpoint, to act only."""
    return acting_learner(group, env).take(folder)


def acting_learner(group: Group, env: MultiAgentVectorEnv) -> Learner:
    """Return the learner of ``group`` with a fresh policy, to act only."""
    parameters = {key: value for key, value in group.spec.parameters.items() if key in ACTING_PARAMETERS}
    if has_replay_buffer(group.spec.algorithm):
        parameters["buffer_size"] = 1
    spec = group.spec.model_copy(update={"parameters": parameters})
    return Learner(AgentVecEnv(env, group.name, group.view(env)), spec, 0).build()


def wrap_in_normaliser(env: VecEnv, spec: LearnerSettings, keys: list[str] | None = None) -> VecEnv:
    """Return ``env`` behind the normaliser that the settings ask for, if they do; of a dict ``keys`` are normalised."""
    normalise = spec.normalise
    if not normalise.is_on:
        return env
    return VecNormalize(
        env,
        norm_obs=normalise.observation,
        norm_reward=normalise.reward,
        clip_obs=normalise.clip_observation,
        clip_reward=normalise.clip_reward,
        gamma=spec.parameters.get("gamma", 0.99),
        epsilon=normalise.epsilon,
        norm_obs_keys=keys,
    )
