"""A learner of its own for every agent of any PettingZoo environment: different algorithms, unequal spaces, deaths."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from rich.progress import Progress as Bar
from sb3_contrib import ARS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.preprocessing import is_image_space

from cirl_marl.errors import CirlError, RecipeError, RunError, path_of, unknown_name, whole_number
from cirl_marl.learners.algorithms import RESERVED_PARAMETERS, every_algorithm
from cirl_marl.learners.checkpoint import read_tree, write_tree
from cirl_marl.learners.learner import TENSORBOARD_ADVICE, Learner, derived_seed, has_tensorboard, predict_action
from cirl_marl.learners.lockstep import Lockstep, Participant, Streams, World, global_streams_claimed
from cirl_marl.learners.recipe import LearnerSettings, Normalisation
from cirl_marl.learners.teams.copies import Copies, MakeEnv, copies_number
from cirl_marl.learners.teams.presence import TeamVecEnv, leave_out_absent
from cirl_marl.learners.trainer import one_torch_thread
from cirl_marl.records.files import refuse_links

Algorithm = Callable[..., BaseAlgorithm]
"""A class of Stable-Baselines3 or sb3-contrib, or one with parameters: ``functools.partial(PPO, n_steps=128)``."""


def independent(
    make_env: MakeEnv,
    algorithm: Algorithm,
    *,
    overrides: Mapping[str, Algorithm] | None = None,
    num_envs: int = 1,
    seed: int = 0,
    normalise: bool = False,
    tensorboard_log: str | Path | None = None,
) -> Team:
    """Give every agent of an environment a Stable-Baselines3 learner of its own.

    Args:
        make_env: makes a PettingZoo ``ParallelEnv``, or an ``AECEnv``, which PettingZoo converts.
        algorithm: of everybody who has no override, such as ``PPO`` or ``partial(PPO, "MlpPolicy", n_steps=128)``.
            Without a policy it is the one for the agent's observations.
        overrides: algorithms of some agents, by name or pattern such as ``"archer_*"``; the first that fits counts.
        num_envs: copies of the environment.
        seed: from which all streams derive: the same arguments give the same weights, bit for bit.
        normalise: whether each learner sees and is paid through a ``VecNormalize`` of its own.
        tensorboard_log: folder for learning curves, one below it for each agent.

    Raises:
        CirlError: for a pattern that fits nobody, an algorithm or parameter that there is not, a space that the
            algorithm cannot take, or something else than an environment.
    """
    copies = Copies(make_env, copies_number(num_envs))
    settings = {}
    for pattern in overrides or {}:
        if not any(fnmatchcase(agent, pattern) for agent in copies.agents):
            raise CirlError(f"overrides: {unknown_name('agent', pattern, copies.agents)}")
    for agent in copies.agents:
        fit = (kind for pattern, kind in (overrides or {}).items() if fnmatchcase(agent, pattern))
        settings[agent] = _settings(agent, next(fit, algorithm), copies.observation_spaces[agent], normalise)
    return Team(make_env, copies, settings, whole_number("seed", seed, 0), tensorboard_log)


class Team:
    """Independent learners of one environment, by agent.

    ``team["archer_0"]`` is an ordinary model of Stable-Baselines3.

    Attributes:
        agents: their names.
        world: the copies in which they learn.
        learners: what each agent learns with.
    """

    def __init__(
        self,
        make_env: MakeEnv,
        copies: Copies,
        settings: Mapping[str, LearnerSettings],
        seed: int,
        tensorboard_log: str | Path | None = None,
    ) -> None:
        """Make a learner for each of ``settings``; ``independent`` is the way to write it."""
        self._make_env, self._settings, self.seed = make_env, dict(settings), seed
        self._copies, self._log = copies, tensorboard_log
        if tensorboard_log is not None and not has_tensorboard():
            raise CirlError(f"tensorboard_log={str(tensorboard_log)!r} needs TensorBoard: {TENSORBOARD_ADVICE}")
        self.agents = copies.agents
        agent_envs = {agent: TeamVecEnv(copies, agent) for agent in copies.agents}
        seeds = [derived_seed(seed, "copies", i) for i in range(copies.num_envs)]
        self.world = World(copies, seeds, agent_envs)
        self.learners: dict[str, Learner] = {}
        with one_torch_thread():
            for agent, agent_env in agent_envs.items():
                learner = Learner(agent_env, settings[agent], seed).build()
                agent_env.at_first_gap(partial(leave_out_absent, learner.model, learner.env, agent_env))
                self.learners[agent] = learner

    def __getitem__(self, agent: str) -> BaseAlgorithm:
        """Return the model of an agent; a ``CirlError`` names the nearest if there is none."""
        if str(agent) not in self.learners:
            raise CirlError(unknown_name("agent", str(agent), self.agents))
        return self.learners[str(agent)].model

    def __iter__(self) -> Iterator[str]:
        """Yield the names of the agents."""
        return iter(self.agents)

    def learn(
        self, total_timesteps: int, *, callbacks: Mapping[str, BaseCallback] | None = None, progress_bar: bool = False
    ) -> Team:
        """Let everybody learn by their own, unmodified ``learn()``; called again, they learn on.

        An agent that was absent makes fewer steps of its own: it stops learning when the joint steps are done.

        Args:
            total_timesteps: environment steps, summed over the copies.
            callbacks: Stable-Baselines3 callbacks by agent, each of its own.
            progress_bar: whether to show how far it is.

        Raises:
            LearnerError: if a learner fails, or the environment tells of others than it promised.
        """
        whole_number("total_timesteps", total_timesteps, 1)
        for agent in callbacks or {}:
            if agent not in self.learners:
                raise CirlError(f"callbacks: {unknown_name('agent', agent, self.agents)}")
        joint = self.world.joint_steps + math.ceil(total_timesteps / self._copies.num_envs)
        with global_streams_claimed(), one_torch_thread(), Bar(disable=not progress_bar) as bar:
            task = bar.add_task(f"{len(self.agents)} learners", total=joint - self.world.joint_steps)
            participants = [self._participant(agent, total_timesteps, joint, callbacks or {}) for agent in self.agents]
            try:
                Lockstep([self.world], participants).run([lambda _infos, _over: bar.advance(task)])
            finally:
                for learner in self.learners.values():
                    learner.model.logger.close()
        return self

    def _participant(self, agent: str, steps: int, joint: int, callbacks: Mapping[str, BaseCallback]) -> Participant:
        learner, agent_env = self.learners[agent], self.world.agent_envs[agent]
        assert isinstance(agent_env, TeamVecEnv)
        missed_before = agent_env.missed_steps
        if self._log is not None:
            learner.log_to_tensorboard(Path(self._log) / agent)

        def budget() -> int:
            return joint if isinstance(learner.model, ARS) or agent_env.missed_steps > missed_before else 2**62

        learn, absent = partial(learner.learn_on, steps, callbacks.get(agent)), lambda: agent_env.absent
        return Participant(agent_env.title, learn, learner.act, learner.streams, budget=budget, absent=absent)

    def evaluate(
        self, episodes: int = 10, *, seed: int = 0, deterministic: bool = True
    ) -> dict[str, NDArray[np.floating]]:
        """Return what each agent is paid in each of some fresh episodes, shape (episodes,); 0 where it never was.

        Args:
            episodes: played in copies of their own, which begin with seeds that no training has.
            seed: from which theirs derive.
            deterministic: whether policies do what they think best, or draw.
        """
        whole_number("episodes", episodes, 1)
        whole_number("seed", seed, 0)
        with (
            closing(Copies(self._make_env, min(episodes, self._copies.num_envs))) as copies,
            Streams(derived_seed(seed, "evaluation")).active(),
            one_torch_thread(),
        ):
            return self._play(copies, episodes, seed, deterministic)

    def _play(self, copies: Copies, episodes: int, seed: int, deterministic: bool) -> dict[str, NDArray[np.floating]]:
        count = copies.num_envs
        agent_envs = {agent: TeamVecEnv(copies, agent) for agent in self.agents}
        observations = copies.reset(seed=[derived_seed(seed, "evaluation", i) for i in range(count)])
        starts = {agent: np.ones(count, dtype=bool) for agent in self.agents}
        memory: dict[str, Any] = dict.fromkeys(self.agents)
        returns, episode_returns = np.zeros((len(self.agents), count)), np.zeros((len(self.agents), episodes))
        places = np.arange(count)  # of the episode that runs in each copy; copy i plays i, i + B, i + 2 B …
        while (places < episodes).any():
            actions = {}
            for agent, learner in self.learners.items():
                if copies.present[agent].any():
                    rows: Any = observations[agent]
                    if learner.normaliser is not None:
                        rows = learner.normaliser.normalize_obs(rows)
                    state = (memory[agent], starts[agent], agent_envs[agent])
                    actions[agent], memory[agent] = predict_action(
                        learner.model, rows, *state, deterministic=deterministic
                    )
            before = copies.present
            observations, rewards, terminations, truncations, _ = copies.step(actions)
            returns += list(rewards.values())
            for agent in self.agents:
                starts[agent] = terminations[agent] | truncations[agent] | ~before[agent]
            for i in np.flatnonzero(copies.new_episode):
                if places[i] < episodes:
                    episode_returns[:, places[i]] = returns[:, i]
                places[i] += count
                returns[:, i] = 0.0
        return dict(zip(self.agents, episode_returns, strict=True))

    def save(self, folder: str | Path) -> None:
        """Write settings, policies, optimisers, normalisers and streams to a new folder, without replay buffers.

        No file in it can hold code. ``team[agent].save(…)`` writes an ordinary file of Stable-Baselines3 instead.

        Raises:
            RunError: if the folder is there already, or an agent or a parameter cannot be written.
        """
        path = path_of("team", folder)
        if path.exists():
            raise RunError(f"{path}: is there already; choose another folder")
        for agent in self.agents:
            if PurePath(agent).name != agent or agent.startswith("."):
                raise RunError(f"{path}: agent '{agent}': its name cannot be that of a file")
        partial_folder = path.with_name(f".{path.name}.partial")
        shutil.rmtree(partial_folder, ignore_errors=True)
        partial_folder.mkdir(parents=True)
        specs = {agent: spec.model_dump() for agent, spec in self._settings.items()}
        try:
            for learner in self.learners.values():
                learner.write_state(partial_folder, {}, last=True)
            write_tree(partial_folder, "team", {"seed": self.seed, "num_envs": self._copies.num_envs, "agents": specs})
        except TypeError as error:
            shutil.rmtree(partial_folder)
            raise RunError(f"{path}: parameters that are no plain values cannot be kept: {error}") from error
        partial_folder.replace(path)

    @classmethod
    def load(cls, folder: str | Path, make_env: MakeEnv, *, tensorboard_log: str | Path | None = None) -> Team:
        """Return a team as ``Team.save`` wrote it, in fresh episodes of the environment.

        Raises:
            RunError: if a file is missing, cannot be read, or is of another environment.
        """
        path = path_of("team", folder)
        refuse_links(path)
        state = read_tree(path, "team")
        try:
            settings = {agent: LearnerSettings.model_validate(spec) for agent, spec in state["agents"].items()}
            count, seed = copies_number(state["num_envs"]), whole_number("seed", state["seed"], 0)
        except (KeyError, TypeError, ValueError, AttributeError, CirlError) as error:
            raise RunError(f"{path / 'team.json'}: is not what a team wrote: {error}") from error
        copies = Copies(make_env, count)
        if set(settings) != set(copies.agents):
            raise RunError(f"{path}: is of the agents {sorted(settings)}, the environment has {sorted(copies.agents)}")
        team = cls(make_env, copies, settings, seed, tensorboard_log)
        for learner in team.learners.values():
            learner.load(path)
        return team

    def close(self) -> None:
        """Close the copies of the environment."""
        self._copies.close()


def _settings(agent: str, algorithm: Algorithm, space: spaces.Space[Any], normalise: bool) -> LearnerSettings:
    """Return what an algorithm, with parameters or without, says of the learner of an agent."""
    bound_algorithm = algorithm if isinstance(algorithm, partial) else partial(algorithm)
    name = getattr(bound_algorithm.func, "__name__", repr(bound_algorithm.func))
    classes = every_algorithm()
    if classes.get(name) is not bound_algorithm.func:
        hint = unknown_name("algorithm of stable_baselines3 or sb3_contrib", name, classes)
        raise RecipeError(f"agent '{agent}': {hint}")
    parameters = dict(bound_algorithm.keywords)
    policy_names = [*bound_algorithm.args, *([parameters.pop("policy")] if "policy" in parameters else [])]
    if len(policy_names) > 1 or not all(isinstance(policy, str) for policy in policy_names):
        raise RecipeError(
            f"agent '{agent}': {name}: give a policy by its name and parameters by theirs, got {policy_names}"
        )
    if fixed_names := sorted(set(parameters) & set(RESERVED_PARAMETERS)):
        raise RecipeError(f"agent '{agent}': {name}: {', '.join(fixed_names)}: the team sees to that")
    prefix = "MultiInput" if isinstance(space, spaces.Dict) else "Cnn" if is_image_space(space) else "Mlp"
    policies = [alias for alias in classes[name].policy_aliases if alias.startswith(prefix)]
    policy = [*policy_names, *policies, f"{prefix}Policy"][0]
    normalisation = Normalisation(observation=normalise, reward=normalise)
    return LearnerSettings(algorithm=name, policy=policy, parameters=parameters, normalise=normalisation)
