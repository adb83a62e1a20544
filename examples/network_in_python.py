"""A network built in Python: glass bottles of a town, which a deposit scheme keeps from disposal.

Shows the parts of a network, what λ is made of, and a question asked by snapshot and restore: what would circularity be
if the deposit scheme did nothing?
"""

import numpy as np
from rich import print

from cirl_marl import Arc, Control, ControlKind, Episode, Network, Node, Objective, Role, Service, parallel_env

valve = Control(kind=ControlKind.RATE, low=0.2, neutral=1.0, high=1.2)
network = Network(
    name="bottles",
    mass_unit="t",
    time_unit="day",
    nodes=(
        Node(id="quarry", role=Role.NONRENEWABLE_RESERVOIR, initial=(10_000.0, 10_000.0), scale=10_000.0),
        Node(id="households", initial=(80.0, 120.0), set_point=100.0, scale=100.0),
        Node(id="landfill", role=Role.LANDFILL, scale=100.0),
    ),
    arcs=(
        Arc(id="glassworks", donor="quarry", recipient="households", rate=5e-4, control=valve, scale=5.0),
        Arc(id="disposal", donor="households", recipient="landfill", rate=0.05, control=valve, scale=5.0),
    ),
    services=(
        Service(id="bottles", provider="households", quantity="stock", low=95.0, owed_by=("glassworks", "disposal")),
    ),
    episode=Episode(control_interval=1.0, horizon=60),
    objective=Objective(circularity_scale=10.0),
)

env = parallel_env(network)
env.reset(seed=0)
act = {"glassworks": np.array([-0.6]), "disposal": np.array([-1.0])}
for _ in range(30):
    env.step(act)

here = env.snapshot()
acting = env.step(act)[4]["disposal"]["circularity"]
env.restore(here)
idle = env.step(act | {"disposal": env.neutral_action["disposal"]})[4]["disposal"]["circularity"]

summary = f"λ = {acting:.2f} t with the deposit scheme, {idle:.2f} t without it on that day"
print(summary)
