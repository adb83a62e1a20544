# %% [markdown]
# # Any PettingZoo environment
#
# The learners of this library take agents of other people's environments too: every agent of a PettingZoo environment
# gets a Stable-Baselines3 learner of its own. Here we write a small environment that has nothing to do with material
# flows, and two agents learn it with two different algorithms.

# %%
from functools import partial

import numpy as np
from gymnasium.spaces import Box
from matplotlib import pyplot
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO, SAC

import cirl_marl

# %% [markdown]
# ## An environment of one's own
#
# Two heaters stand in two rooms with a thin wall between them. Each agent sees its room's temperature and how cold it
# is outside. It is paid for warmth near 20 °C, less what it burns. Heat leaks from one room to the other, so each agent
# lives with what the other does.


# %%
class Rooms(ParallelEnv):
    """Two rooms, a degree of the other's heat through the wall, half an hour a step."""

    outside, leak, wall, power = 5.0, 0.1, 0.2, 4.0

    def __init__(self):
        """Name the agents and what they see and do."""
        self.metadata, self.possible_agents = {"name": "rooms"}, ["north", "south"]
        self.observation_spaces = {agent: Box(-5.0, 5.0, (2,), np.float32) for agent in self.possible_agents}
        self.action_spaces = {agent: Box(-1.0, 1.0, (1,), np.float32) for agent in self.possible_agents}

    def observation_space(self, agent):
        """Return temperatures, as tens of degrees from 20 °C."""
        return self.observation_spaces[agent]

    def action_space(self, agent):
        """Return the range of the heater, from off to full power."""
        return self.action_spaces[agent]

    def reset(self, seed=None, options=None):
        """Begin with cold rooms."""
        self.agents, self.steps = list(self.possible_agents), 0
        self.rooms = np.random.default_rng(seed).uniform(10.0, 16.0, 2)
        return self.seen(), {agent: {} for agent in self.agents}

    def seen(self):
        """Return what each agent sees."""
        return {
            agent: np.array([(degrees - 20.0) / 10.0, self.outside / 10.0], dtype=np.float32)
            for agent, degrees in zip(self.possible_agents, self.rooms, strict=True)
        }

    def step(self, actions):
        """Heat for half an hour."""
        burnt = np.array([(1.0 + float(actions[agent][0])) / 2 for agent in self.possible_agents])
        through = self.wall * (self.rooms[::-1] - self.rooms)
        self.rooms = self.rooms + self.power * burnt + through - self.leak * (self.rooms - self.outside)
        self.steps += 1
        paid = -0.1 * (self.rooms - 20.0) ** 2 - 0.5 * burnt
        rewards = dict(zip(self.possible_agents, paid.tolist(), strict=True))
        over = dict.fromkeys(self.possible_agents, self.steps >= 40)
        observations = self.seen()
        self.agents = [] if self.steps >= 40 else self.agents
        none = dict.fromkeys(self.possible_agents, False)
        return observations, rewards, none, over, {agent: {} for agent in self.possible_agents}


# %% [markdown]
# ## Is it sound?
#
# PettingZoo's own tests let much pass. This one is stricter: seeds, spaces, types, endings, snapshots if there are any.

# %%
cirl_marl.check_parallel_env(Rooms)
print("no complaints")

# %% [markdown]
# ## Two learners side by side
#
# `north` learns by PPO, `south` by SAC. Neither is modified; both learn at the same time, in the same rooms.

# %%
team = cirl_marl.independent(
    Rooms,
    partial(PPO, n_steps=80, batch_size=80, learning_rate=3e-3, gamma=0.95),
    overrides={"south": partial(SAC, learning_starts=400, train_freq=4, gamma=0.95)},
    num_envs=4,
    seed=0,
)
before = {agent: paid.mean() for agent, paid in team.evaluate(20).items()}
team.learn(6_000)
after = {agent: paid.mean() for agent, paid in team.evaluate(20).items()}
for agent in before:
    print(f"{agent}: paid {before[agent]:8.1f} an episode before, {after[agent]:6.1f} after")
print(type(team["north"]).__name__, type(team["south"]).__name__)

# %% [markdown]
# ## What they do
#
# `team["north"]` is an ordinary model of Stable-Baselines3.

# %%
env = Rooms()
observations, _ = env.reset(seed=1)
degrees = [env.rooms]
while env.agents:
    actions = {agent: team[agent].predict(seen, deterministic=True)[0] for agent, seen in observations.items()}
    observations = env.step(actions)[0]
    degrees.append(env.rooms)
pyplot.figure(figsize=(8, 3.5))
pyplot.plot(np.array(degrees), label=env.possible_agents)
pyplot.axhline(20.0, color="grey", linestyle=":")
pyplot.xlabel("step")
pyplot.ylabel("°C")
pyplot.legend()
pyplot.show()

# %% [markdown]
# Agents that die, action masks, other observations, saving: [pettingzoo.md](../../docs/pettingzoo.md).
