"""A policy of its own for every agent of copper_net, learnt by RLlib."""

from ray.rllib.algorithms.ppo import PPOConfig
from rich import print

from cirl_marl.adapters.rllib import RLlibEnv

options = {"network": "copper_net", "reward": "team", "horizon": 40}
agents = RLlibEnv(options).possible_agents
config = (
    PPOConfig()
    .environment(RLlibEnv, env_config=options, clip_actions=True)
    .env_runners(num_env_runners=0, num_envs_per_env_runner=2)
    .multi_agent(policies=agents, policy_mapping_fn=lambda agent, *_, **__: agent)
    .training(train_batch_size_per_learner=160, minibatch_size=80, num_epochs=2)
    .debugging(seed=0)
)
algorithm = config.build_algo()
for _ in range(2):
    results = algorithm.train()["env_runners"]
print(f"{results['num_env_steps_sampled_lifetime']} steps, paid {results['episode_return_mean']:.3f} per episode")
algorithm.stop()
