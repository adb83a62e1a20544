"""Policy gradients on copper_net, with TorchRL's networks in the batched environment: a policy for every agent."""

import torch
from rich import print
from tensordict.nn import TensorDictModule
from torchrl.modules import MultiAgentMLP, NormalParamExtractor, ProbabilisticActor, TanhNormal

from cirl_marl.adapters.torchrl import TorchRLEnv

env = TorchRLEnv("copper_net", num_envs=32, seed=0, reward="team", horizon=40)
torch.manual_seed(0)
agents, entries = env.observation_spec["agents", "observation"].shape[-2:]
means = MultiAgentMLP(entries, 2, agents, centralized=False, share_params=False)
networks = TensorDictModule(
    torch.nn.Sequential(means, NormalParamExtractor()),
    in_keys=[("agents", "observation")],
    out_keys=[("agents", "loc"), ("agents", "scale")],
)
keys = {"in_keys": networks.out_keys, "out_keys": [env.action_key], "log_prob_key": ("agents", "log_prob")}
policy = ProbabilisticActor(networks, distribution_class=TanhNormal, return_log_prob=True, **keys)
optimiser = torch.optim.Adam(policy.parameters(), lr=1e-3)
for _ in range(3):
    episodes = env.rollout(40, policy)
    paid = episodes["next", "agents", "reward"].sum(dim=1)
    log_prob = policy.log_prob(episodes.detach()).sum(dim=1).unsqueeze(-1)
    optimiser.zero_grad()
    (-(paid - paid.mean(dim=0)).detach() * log_prob).mean().backward()
    optimiser.step()
    print(f"paid per episode: {float(paid.mean()):.3f}")
