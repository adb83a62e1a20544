"""Independent PPO with RLlib: a module for each agent, copies stepped one by one by one or more processes."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from torch import nn

from benchmarks.peers.problem import Acting, Array, Lone, Scaling
from benchmarks.peers.settings import SETTINGS
from benchmarks.peers.watch import TimeIsUp, Watch
from cirl_marl.adapters.rllib import RLlibEnv


class LoneEnv(RLlibEnv):
    """Our network, scaled."""

    @staticmethod
    def _make_env(**config: Any) -> Lone:
        return Lone(**config)


class Module(DefaultPPOTorchRLModule):  # type: ignore[misc]
    """RLlib's own, which begins with the deviation of the settings."""

    def setup(self) -> None:
        """Make the networks."""
        super().setup()
        nn.init.constant_(self.pi.log_std, SETTINGS.log_std)


def run(watch: Watch, seed: int, scaling: Scaling, envs: int, threads: int) -> None:
    """Train until time is up; with one process the learner samples itself."""
    runners = 0 if threads == 1 else threads
    watch.record.setup = {"envs": envs, "env runners": runners, "ray": version("ray"), "torch": version("torch")}
    ray.init(num_cpus=threads + 1, include_dashboard=False, log_to_driver=False)
    agents = list(Lone(scaling).possible_agents)
    algorithm = _config(scaling, agents, seed, envs, runners).build_algo()
    modules = [algorithm.get_module(agent) for agent in agents]

    def act(seen: Array) -> Any:
        with torch.no_grad():
            outputs = [m.forward_inference({"obs": torch.as_tensor(seen[:, i])}) for i, m in enumerate(modules)]
        return torch.stack([output["action_dist_inputs"][:, :1] for output in outputs], dim=1).numpy()

    watch.begin()
    try:
        while True:
            result = algorithm.train()
            watch.after(int(result["env_runners"]["num_env_steps_sampled_lifetime"]), lambda: Acting(act, scaling))
    except TimeIsUp:
        algorithm.stop()
        ray.shutdown()


def _config(scaling: Scaling, agents: list[str], seed: int, envs: int, runners: int) -> Any:
    layers = {"fcnet_hiddens": list(SETTINGS.layers), "fcnet_activation": "tanh", "vf_share_layers": False}
    model = DefaultModelConfig(**layers, free_log_std=True, head_fcnet_hiddens=[])
    spec = RLModuleSpec(module_class=Module, model_config=model)
    rate = [[0, SETTINGS.learning_rate], [SETTINGS.schedule, SETTINGS.last_rate]]
    return (
        PPOConfig()
        .environment(
            LoneEnv,
            env_config={"scaling": scaling},
            clip_actions=True,
            normalize_actions=False,
            disable_env_checking=True,
        )
        .env_runners(
            num_env_runners=runners,
            num_envs_per_env_runner=envs // max(1, runners),
            sample_timeout_s=600.0,  # of a minute, the default, a rollout on a busy machine may take more
        )
        .multi_agent(policies=agents, policy_mapping_fn=lambda agent, *_, **__: agent)
        .rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=dict.fromkeys(agents, spec)))
        .debugging(seed=seed, log_level="ERROR")
        .training(
            train_batch_size_per_learner=envs * SETTINGS.steps,
            minibatch_size=SETTINGS.minibatch,
            num_epochs=SETTINGS.epochs,
            gamma=SETTINGS.discount,
            lambda_=SETTINGS.trace,
            lr=rate,
            clip_param=SETTINGS.clip,
            vf_clip_param=float("inf"),
            vf_loss_coeff=SETTINGS.value_weight,
            entropy_coeff=0.0,
            use_kl_loss=False,
            grad_clip=SETTINGS.gradient,
            grad_clip_by="global_norm",
        )
    )
