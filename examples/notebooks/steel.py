# %% [markdown]
# # From a table of flows to a plan for 2050
#
# A material flow analysis ends with a table: how much went from which process to which, year by year. We make a network
# of such a table, see that it gives the table back, and then ask what Japan could do about its steel until 2050.
#
# Data: Watari et al. 2025, Resources, Conservation and Recycling 220, 108363, doi 10.5281/zenodo.15344957 (MIT licence,
# © 2024 Takuma Watari).

# %%
from pathlib import Path

from IPython.display import Image
from rich import print as show

import cirl_marl

checkout = Path(cirl_marl.__file__).parent.parent
flows = checkout / "benchmarks" / "data" / "steel_flows_2000_2024.csv"
print(*flows.read_text().splitlines()[:4], sep="\n")

# %% [markdown]
# ## The table becomes a network
#
# Processes become nodes. Those that balance store nothing and share out what enters. What sources and sinks are, we
# have to say. The network is simulated, and its flows are held against the table.

# %%
report = cirl_marl.import_flows(
    flows,
    Path("steel.toml"),
    regions=["Japan"],
    roles={"landfill": ["Losses"], "technosphere": ["Imports of *", "Exports of *"]},
    stores=["Use phase"],
    title="Iron and steel as reported",
    source="Watari et al. 2025",
)
print(f"{len(report.table.pairs)} flows, {report.table.years[0]} to {report.table.years[-1]}")
print(f"simulated, no flow is further than {report.largest_error:.2g} {report.table.unit} from the table")

# %% [markdown]
# The definition is a text file beside a data file. `cirl check` and `cirl show` take it, and so does the library.

# %%
reported = cirl_marl.load_network("steel.toml:japan")
run = cirl_marl.rollout(cirl_marl.vector_env(reported, num_envs=1), cirl_marl.Neutral())
into_use = [k for k, arc in enumerate(reported.arcs) if arc.recipient == "use_phase"]
print(f"{len(reported.nodes)} nodes, {len(reported.arcs)} arcs")
print(f"into use in 2000 and 2024: {run.flow[[0, -1]][:, into_use].sum(axis=1).round()} kt/year")

# %% [markdown]
# ## What the future needs
#
# A table of the past has nothing to decide. For 2050 somebody has to say what people will want, how long things last,
# and what can be done. `steel_japan` of the catalogue says it, with a source for each number: demand is a stock in use,
# lifetimes are by sector, agents collect, sort, lose less and trade. The page of the network lists them.

# %%
network = cirl_marl.load_network("steel_japan")
print(network.title, "|", len(network.compartments), "compartments |", ", ".join(network.agents))
for service in network.services:
    print(f"service '{service.id}': {service.quantity} of {' and '.join(service.providers)}")

# %% [markdown]
# ## A plan, and a proof of how good it is
#
# The bound is a linear program. Its multipliers prove that nobody can do better with every service in full; the plan is
# carried out in the simulator. λ counts what is extracted and lost in a year.

# %%
best = cirl_marl.bound(network, min_service=1.0)
print(best)
better = cirl_marl.improve_plan(best)
episode = cirl_marl.simulate_plan(better)
usual = cirl_marl.rollout(cirl_marl.vector_env(network, num_envs=1), cirl_marl.Neutral())
print(f"as usual λ̄ = {usual.episode_circularity[0] / 1e3:.1f} Mt")
print(f"plan     λ̄ = {episode.episode_circularity[0] / 1e3:.1f} Mt, lowest service {episode.least_service[0]:.4f}")
print(f"the plan is at most {cirl_marl.gap(best.objective, episode.episode_circularity[0]):.2%} from the best there is")

# %% [markdown]
# ## What to do, and when
#
# The levers that differ most from business as usual, in words and as a picture.

# %%
plan = cirl_marl.plan(network, cirl_marl.Plan(better))
show(cirl_marl.summarise(plan))

# %%
Image(cirl_marl.draw("plan.png", plan, title="Steel of Japan: the plan beside business as usual"))

# %% [markdown]
# The same from the command line, with workbook and report for the browser:
# `cirl plan steel_japan --control optimum --min-service 1 --html plan.html`. What it could mean:
# [japan.md](../../docs/japan.md); what is weak in the data: [data.md](../../docs/data.md).
