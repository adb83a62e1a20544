# %% [markdown]
# # Independent, shared and joint learners, against the bound
#
# One network, three ways to learn it, the same fresh episodes, and an upper bound that nobody can exceed. The network
# is `carbo_net`: carbon dioxide of a city, with capture from the air.

# %%
from pathlib import Path

from IPython.display import Image
from rich import print as show

import cirl_marl

network = cirl_marl.load_network("carbo_net")
print(f"{len(network.compartments)} compartments, {len(network.agents)} agents: {', '.join(network.agents)}")

# %% [markdown]
# ## Who learns
#
# - *independent*: a learner for each compartment, which sees its own compartment and sets what that sets.
# - *shared*: one policy for all, which acts by the observation of one compartment at a time.
# - *joint*: one learner that sees all observations and acts for all.
#
# Each recipe is trained for a small part of its steps, so that this page is made in a minute or two; the study repeats
# it in full, with five seeds: [study.md](../../docs/study.md). The budgets differ, so nothing follows about which
# algorithm is better.

# %%
budgets = {"independent_ars": 1_000_000, "shared_ppo": 60_000, "joint_ppo": 200_000}
for recipe, steps in budgets.items():
    training = cirl_marl.train(network, recipe, directory=f"runs/{recipe}", steps=steps, seed=0)
    print(f"{recipe}: {len(training.learners)} learners, {steps:,} environment steps")

# %% [markdown]
# ## What came of it
#
# Everyone plays the same 16 episodes, whose seeds no training draws. The gap is taken episode by episode, at the
# service that was delivered. One training seed has no interval.

# %%
comparison = cirl_marl.compare([Path("runs") / recipe for recipe in budgets], ("neutral", "random"), episodes=16)
show(cirl_marl.summarise(comparison))

# %%
Image(cirl_marl.draw("comparison.png", comparison))

# %% [markdown]
# The line is the bound. Whoever is below it and to the right serves well and could still do better.
