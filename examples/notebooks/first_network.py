# %% [markdown]
# # A first network
#
# A town keeps glass bottles in use. They are made from sand, break or are thrown away, and a deposit scheme makes them
# live longer. We describe this as a network, watch it, ask how good it could be, and let agents learn it.

# %%
from IPython.display import Image
from matplotlib import pyplot

import cirl_marl
from cirl_marl import Arc, Control, ControlKind, Episode, Network, Node, Objective, Role, Service

# %% [markdown]
# ## Describe it
#
# Nodes store material, arcs move it. The role of a node decides what counts: what leaves the quarry or enters the
# landfill lowers the circularity λ. A control lets an agent act; here both are valves. The service says what the
# network is there for, and its weight how dear it is to learners to miss it. Without a service, stopping everything
# would be the best policy.

# %%
making = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=1.2)
deposit = Control(kind=ControlKind.RATE, low=0.2, neutral=1.0, high=1.0)
network = Network(
    name="bottles",
    mass_unit="t",
    time_unit="day",
    nodes=(
        Node(id="quarry", role=Role.NONRENEWABLE_RESERVOIR, initial=(10_000.0, 10_000.0), scale=10_000.0),
        Node(id="households", initial=(80.0, 120.0), scale=100.0),
        Node(id="landfill", role=Role.LANDFILL, scale=100.0),
    ),
    arcs=(
        Arc(id="glassworks", donor="quarry", recipient="households", rate=5e-4, control=making, scale=5.0),
        Arc(id="disposal", donor="households", recipient="landfill", rate=0.05, control=deposit, scale=5.0),
    ),
    services=(
        Service(
            id="bottles",
            provider="households",
            quantity="stock",
            low=95.0,
            weight=10.0,
            owed_by=("glassworks", "disposal"),
        ),
    ),
    episode=Episode(control_interval=1.0, horizon=60),
    objective=Objective(circularity_scale=10.0),
)

# %% [markdown]
# ## Watch it
#
# The network is a PettingZoo environment. An action is a number between −1 and 1 for each agent. Here nobody changes
# anything for ten days.

# %%
env = cirl_marl.parallel_env(network, render_mode="rgb_array")
env.reset(seed=0, options={"initial_state": {"households": 100.0}})
for _ in range(10):
    infos = env.step(env.neutral_action)[-1]
print(f"λ = {infos['disposal']['circularity']:.2f} t, service level {infos['disposal']['service_level']:.2f}")
pyplot.figure(figsize=(9, 6))
pyplot.imshow(env.render())
pyplot.axis("off")
pyplot.show()

# %% [markdown]
# ## Ask how good it could be
#
# No actions from this start can exceed the bound while they serve as well. Its plan comes close to it in the simulator.

# %%
best = cirl_marl.bound(network, {"households": 100.0}, min_service=1.0)
plan = cirl_marl.simulate_plan(cirl_marl.improve_plan(best))
print(best)
print(f"in the simulator the plan reaches {plan.episode_circularity[0]:.3f} t", end=", ")
print(f"{cirl_marl.gap(best.objective, plan.episode_circularity[0]):.2%} from the bound")

# %% [markdown]
# ## Let agents learn it
#
# Each of the two agents gets a small policy of its own, which climbs derivatives of the simulator: the recipe
# `exact_gradients`. It acts by what its agent observes, and by nothing else.

# %%
cirl_marl.train(network, directory="runs/bottles", steps=400_000, seed=0)
evaluation = cirl_marl.evaluate("runs/bottles", episodes=16, seed=1)
print(evaluation)

# %% [markdown]
# λ over time, as a mean over the 16 episodes. The service must be read beside it, always.

# %%
Image(cirl_marl.draw("circularity.png", evaluation))

# %% [markdown]
# Next: the same as a TOML file, where every number has a unit and a source, in
# [getting_started.md](../../docs/getting_started.md).
