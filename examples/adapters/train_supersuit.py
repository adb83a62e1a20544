"""One policy for all sixteen agents of copper_net: plain PPO of Stable-Baselines3, through SuperSuit's wrappers."""

from rich import print
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from cirl_marl.adapters.supersuit import SharedPolicyEnv

env = VecMonitor(SharedPolicyEnv("copper_net", copies=2, reward="team", horizon=40))
model = PPO("MlpPolicy", env, n_steps=80, batch_size=640, learning_rate=1e-3, seed=0, device="cpu")
model.learn(80 * env.num_envs * 3)
rewards = [episode["r"] for episode in model.ep_info_buffer or ()]
print(f"{len(rewards)} episodes of agents, paid {sum(rewards) / len(rewards):.3f} on average")
