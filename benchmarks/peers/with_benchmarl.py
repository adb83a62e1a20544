"""Independent PPO with BenchMARL, in our batched environment as a task of its own."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from typing import Any

import torch
from benchmarl.algorithms import IppoConfig
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from benchmarks.peers.problem import Acting, Array, Scaling
from benchmarks.peers.settings import ENVIRONMENT, NETWORK, SETTINGS
from benchmarks.peers.torchrl_env import ScaledEnv
from benchmarks.peers.watch import TimeIsUp, Watch
from cirl_marl.adapters.benchmarl import NetworkTask
from cirl_marl.adapters.torchrl import GROUP


class ScaledTask(NetworkTask):
    """Our network, scaled."""

    def __init__(self, scaling: Scaling) -> None:
        """Make environments that scale by ``scaling``."""
        super().__init__(NETWORK, **ENVIRONMENT)
        self._scaling = scaling

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], ScaledEnv]:
        """Return what makes a batched environment."""
        return partial(ScaledEnv, num_envs, seed or 0, self._scaling)


class Laps(Callback):  # type: ignore[misc]
    """Tells the watch of every update, and sets the learning rate of the next."""

    def __init__(self, watch: Watch, scaling: Scaling) -> None:
        """``watch`` takes the time."""
        super().__init__()
        self._watch, self._scaling = watch, scaling

    def on_train_end(self, training_td: Any, group: str) -> None:
        """Note a lap; frames are counted before the update."""
        steps = self.experiment.total_frames
        for optimiser in self.experiment.optimizers[group].values():
            for parameters in optimiser.param_groups:
                parameters["lr"] = SETTINGS.rate_after(steps)
        self._watch.after(steps, lambda: Acting(self._act, self._scaling))

    def _act(self, seen: Array) -> Any:
        batch, agents, _ = seen.shape
        group = TensorDict({"observation": torch.as_tensor(seen)}, batch_size=(batch, agents))
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            acted = self.experiment.policy(TensorDict({GROUP: group}, batch_size=(batch,)))
        return acted[GROUP, "action"].numpy()


def run(watch: Watch, seed: int, scaling: Scaling, envs: int, threads: int) -> None:
    """Train until time is up."""
    torch.set_num_threads(threads)
    versions = {name: version(name) for name in ("benchmarl", "torchrl", "torch")}
    watch.record.setup = {"envs": envs, "threads": threads, **versions}
    with tempfile.TemporaryDirectory() as folder:
        experiment = Experiment(
            task=ScaledTask(scaling),
            algorithm_config=_algorithm(),
            model_config=MlpConfig(num_cells=list(SETTINGS.layers), layer_class=nn.Linear, activation_class=nn.Tanh),
            seed=seed,
            config=_settings(envs, folder),
            callbacks=[Laps(watch, scaling)],
        )
        watch.begin()
        try:
            experiment.run()
        except TimeIsUp:
            return


def _algorithm() -> Any:
    return IppoConfig(
        share_param_critic=False,
        clip_epsilon=SETTINGS.clip,
        entropy_coef=0.0,
        critic_coef=SETTINGS.value_weight,
        loss_critic_type="l2",
        lmbda=SETTINGS.trace,
        scale_mapping=f"biased_softplus_{math.exp(SETTINGS.log_std):.4f}_0.01",
        use_tanh_normal=False,
        minibatch_advantage=False,
    )


def _settings(envs: int, folder: str) -> Any:
    config = ExperimentConfig.get_from_yaml()
    config.share_policy_params = False
    config.gamma, config.lr, config.adam_eps = SETTINGS.discount, SETTINGS.learning_rate, SETTINGS.epsilon
    config.clip_grad_norm, config.clip_grad_val = True, SETTINGS.gradient
    config.max_n_iters, config.max_n_frames = 10**6, None
    config.on_policy_collected_frames_per_batch = envs * SETTINGS.steps
    config.on_policy_n_envs_per_worker = envs
    config.on_policy_n_minibatch_iters = SETTINGS.epochs
    config.on_policy_minibatch_size = SETTINGS.minibatch
    config.evaluation, config.render = False, False
    config.loggers, config.create_json = [], False
    config.save_folder, config.checkpoint_interval, config.checkpoint_at_end = folder, 0, False
    return config
