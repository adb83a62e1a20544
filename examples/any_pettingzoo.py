"""A learner of its own for every agent of any PettingZoo environment: three predators by SAC, their prey by PPO."""

from functools import partial

from mpe2 import simple_tag_v3
from rich import print
from stable_baselines3 import PPO, SAC

import cirl_marl

make_env = partial(simple_tag_v3.parallel_env, max_cycles=25, continuous_actions=True)
predators = partial(SAC, learning_starts=100, batch_size=64)
team = cirl_marl.independent(make_env, PPO, overrides={"adversary_*": predators}, num_envs=4, seed=0)
team.learn(600)
summary = f"paid per episode: { {agent: float(paid.mean()) for agent, paid in team.evaluate(8).items()} }"
print(summary)
print(type(team["agent_0"]), type(team["adversary_0"]))  # plain models: team["agent_0"].save("prey")
