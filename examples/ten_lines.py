"""Ten lines: the copper network as a multi-agent environment, every compartment acting at random for one episode."""

import numpy as np
from rich import print

import cirl_marl

env = cirl_marl.parallel_env("copper_net", circularity="mean")
observations, infos = env.reset(seed=0)
circularity = []
while env.agents:
    actions = {agent: env.action_space(agent).sample() for agent in env.agents}
    observations, rewards, terminations, truncations, infos = env.step(actions)
    circularity.append(infos["mine"]["circularity"])
summary = f"λ̄ = {np.mean(circularity):.1f} {env.network.mass_unit}, service level {infos['mine']['service_level']:.2f}"
print(summary)
