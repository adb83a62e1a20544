# %% [markdown]
# # The paper's environments
#
# *CiRL: Open-Source Environments for Reinforcement Learning in Circular Economy and Net Zero* (Zocco, Corti, Malvezzi,
# arXiv 2505.21536) has eight environments of one agent. Here they are ordinary Gymnasium environments with the paper's
# equations, bounds, observations and rewards. Each is one compartment of a network; the others hold neutral control.

# %%
import gymnasium
import numpy as np
from matplotlib import pyplot
from stable_baselines3 import A2C

import cirl_marl

NAMES = ("CopperNet", "CarboNet", "CO2MicroalgaeMonod", "CO2MicroalgaeDroop", "TransportTruck", "Incinerator")
NAMES += ("Reacher", "FetchWasteSorting")
for name in NAMES:
    env = gymnasium.make(f"cirl_marl/{name}-v0")
    print(f"{name:20} action {env.action_space.shape}, network {env.unwrapped.network.name}")

# %% [markdown]
# ## The light of microalgae
#
# In `CO2MicroalgaeMonod` the agent sets the light of a culture that takes up carbon dioxide. An action of −1 is
# darkness, 1 is full light. The published response to light has a peculiarity: less light gives more growth.


# %%
def mean_return(act, name="CO2MicroalgaeMonod", episodes=10):
    """Return the mean return of a policy over episodes with seeds of their own."""
    env, returns = gymnasium.make(f"cirl_marl/{name}-v0"), []
    for seed in range(1000, 1000 + episodes):
        seen, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            seen, reward, terminated, truncated, _ = env.step(act(seen))
            total, over = total + reward, terminated or truncated
        returns.append(total)
    return float(np.mean(returns))


for light in (-1.0, 0.0, 1.0):
    print(f"action {light:4.1f}: mean return {mean_return(lambda seen, light=light: np.array([light])):.2f}")

# %% [markdown]
# ## An algorithm as the paper runs it
#
# A2C of Stable-Baselines3 with the settings of the library, as in the paper, for a tenth of its steps.

# %%
env = gymnasium.make("cirl_marl/CO2MicroalgaeMonod-v0")
model = A2C("MlpPolicy", env, seed=0).learn(20_000)
print(f"trained: mean return {mean_return(lambda seen: model.predict(seen, deterministic=True)[0]):.2f}")

# %% [markdown]
# The paper's best training ends at 143.1, over its last 100 episodes; which runs were repeated, and what came of them,
# stands in [paper_tables.md](../../docs/paper_tables.md). From the command line, the whole run:
# `cirl paper CO2MicroalgaeMonod A2C`.

# %%
episodes = [each["r"] for each in model.ep_info_buffer]
pyplot.figure(figsize=(8, 3))
pyplot.plot(episodes)
pyplot.axhline(143.1, color="grey", linestyle=":", label="the paper's best")
pyplot.xlabel("episode, the last hundred of the training")
pyplot.ylabel("return")
pyplot.legend()
pyplot.show()

# %% [markdown]
# ## One compartment of a sound network
#
# The same agent in the network `net_zero` as it should be, with units kept and a service owed: any compartment of any
# network is such an environment.

# %%
env = cirl_marl.single_agent_env("net_zero", agent="microalgae")
seen, _ = env.reset(seed=0)
print(dict(zip(env.observation_names["microalgae"], seen.round(3).tolist(), strict=True)))
_, reward, _, _, infos = env.step(env.action_space.sample())
print(f"reward {reward:.3f}, λ = {infos['circularity']:.3f} kg, service level {infos['service_level']:.2f}")
