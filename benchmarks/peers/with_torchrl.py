"""Independent PPO with TorchRL: networks of all agents evaluated at once, in our batched environment."""

from __future__ import annotations

from functools import partial
from importlib.metadata import version
from typing import Any

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import MarlGroupMapType, ParallelEnv, PettingZooWrapper, SerialEnv
from torchrl.modules import IndependentNormal, MultiAgentMLP, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from benchmarks.peers.problem import Acting, Array, Lone, Scaling
from benchmarks.peers.settings import SETTINGS
from benchmarks.peers.torchrl_env import ScaledEnv
from benchmarks.peers.watch import TimeIsUp, Watch
from cirl_marl.adapters.torchrl import GROUP

SEEN, LOCATION, SCALE = (GROUP, "observation"), (GROUP, "loc"), (GROUP, "scale")


def batched(watch: Watch, seed: int, scaling: Scaling, envs: int, threads: int) -> None:
    """Train in our batched environment."""
    _train(watch, ScaledEnv(envs, seed, scaling), seed, scaling, envs, threads)


def lone(watch: Watch, seed: int, scaling: Scaling, envs: int, threads: int) -> None:
    """Train in PettingZoo environments, which ``threads`` processes step one by one."""
    serial = partial(SerialEnv, envs // threads, partial(_one, scaling))
    env = serial() if threads == 1 else ParallelEnv(threads, serial)
    env.set_seed(seed)
    _train(watch, env, seed, scaling, envs, threads)


def _one(scaling: Scaling) -> Any:
    return PettingZooWrapper(Lone(scaling), group_map=MarlGroupMapType.ALL_IN_ONE_GROUP, use_mask=False)


def _train(watch: Watch, env: Any, seed: int, scaling: Scaling, envs: int, threads: int) -> None:
    """Train until time is up."""
    torch.manual_seed(seed)
    torch.set_num_threads(threads)
    versions = {name: version(name) for name in ("torchrl", "tensordict", "torch")}
    watch.record.setup = {"envs": envs, "threads": threads, **versions}
    actor, critic = _actor(env), TensorDictModule(_network(env), in_keys=[SEEN], out_keys=[(GROUP, "state_value")])
    loss = _loss(actor, critic)
    optimiser = torch.optim.Adam(loss.parameters(), lr=SETTINGS.learning_rate, eps=SETTINGS.epsilon)
    frames = envs * SETTINGS.steps
    collector = Collector(env, actor, frames_per_batch=frames, total_frames=-1)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(frames), sampler=SamplerWithoutReplacement(), batch_size=SETTINGS.minibatch
    )
    means = actor[0]

    def act(seen: Array) -> Any:
        with torch.no_grad():
            return means[0](torch.as_tensor(seen))[0].numpy()

    steps = 0
    watch.begin()
    try:
        for batch in collector:
            for group in optimiser.param_groups:
                group["lr"] = SETTINGS.rate_after(steps)
            _update(batch, loss, optimiser, buffer, actor, critic)
            steps += frames
            watch.after(steps, lambda: Acting(act, scaling))
    except TimeIsUp:
        collector.shutdown()


def _network(env: Any) -> Any:
    agents, entries = env.observation_spec[SEEN].shape[-2:]
    return MultiAgentMLP(
        entries, 1, agents, centralized=False, share_params=False, num_cells=SETTINGS.layers, activation_class=nn.Tanh
    )


def _actor(env: Any) -> Any:
    """Return an actor whose deviation does not depend on what is seen, as that of Stable-Baselines3."""
    shape = env.action_spec[GROUP, "action"].shape[-2:]
    deviation = AddStateIndependentNormalScale(shape, scale_mapping="exp")
    nn.init.constant_(deviation.state_independent_scale, SETTINGS.log_std)
    module = TensorDictModule(nn.Sequential(_network(env), deviation), in_keys=[SEEN], out_keys=[LOCATION, SCALE])
    return ProbabilisticActor(
        TensorDictSequential(module),
        in_keys={"loc": LOCATION, "scale": SCALE},
        out_keys=[(GROUP, "action")],
        distribution_class=IndependentNormal,
        return_log_prob=True,
        log_prob_key=(GROUP, "log_prob"),
    )


def _loss(actor: Any, critic: Any) -> Any:
    loss = ClipPPOLoss(
        actor_network=actor,
        critic_network=critic,
        clip_epsilon=SETTINGS.clip,
        entropy_bonus=False,
        critic_coeff=SETTINGS.value_weight,
        loss_critic_type="l2",
        normalize_advantage=True,
        normalize_advantage_exclude_dims=(1,),
    )
    names = ("reward", "action", "advantage", "value_target", "done", "terminated")
    loss.set_keys(value=(GROUP, "state_value"), sample_log_prob=(GROUP, "log_prob"), **{n: (GROUP, n) for n in names})
    loss.make_value_estimator(ValueEstimators.GAE, gamma=SETTINGS.discount, lmbda=SETTINGS.trace)
    return loss


def _update(batch: Any, loss: Any, optimiser: Any, buffer: Any, actor: Any, critic: Any) -> None:
    """Estimate advantages and go through the rollout, as TorchRL's example of multi-agent PPO does."""
    shape = batch["next", GROUP, "reward"].shape
    for flag in ("done", "terminated"):
        batch["next", GROUP, flag] = batch["next", flag].unsqueeze(-1).expand(shape)
    with torch.no_grad():
        loss.value_estimator(batch, params=loss.critic_network_params, target_params=loss.target_critic_network_params)
    buffer.empty()
    buffer.extend(batch.reshape(-1))
    for _ in range(SETTINGS.epochs):
        for _ in range(batch.numel() // SETTINGS.minibatch):
            found = loss(buffer.sample())
            optimiser.zero_grad()
            (found["loss_objective"] + found["loss_critic"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), SETTINGS.gradient)
            optimiser.step()
