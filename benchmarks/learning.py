"""How close a recipe comes, as it stands, on generated cycles that nobody tuned it for, held against the bound.

python -m benchmarks.learning                           # ten networks, the default recipe; what is known is not trained
python -m benchmarks.learning --recipe independent_ars --first 900 --networks 5
python -m benchmarks.learning --table                   # writes the table of what is kept in results/learning.json

Networks are those of ``benchmarks.yearly`` with three to forty agents and one to three services, without lifetimes and
with them; every other two of them have days in place of years, with four decisions a day. Left out are those of which a
decision takes more than so many terms of the solver's series, as they would train for hours.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.document import measured_table, write_sections
from benchmarks.yearly import Family
from benchmarks.yearly import yearly_network as generated_network
from cirl_marl import Network, bound, train
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.learners.validation import Score
from cirl_marl.optimum import gap
from cirl_marl.records.files import write_json

DOCUMENT = Path(__file__).parent.parent / "docs" / "study.md"
RESULTS = Path(__file__).parent / "results" / "learning.json"
RECIPE, FIRST_SEED, NETWORKS = "exact_gradients", 2000, 10
"""No tuning looked at networks of the first seed or later ones."""
TERMS = 25
"""Most terms of the solver's series in a decision."""
AGENTS, SERVICES = range(3, 41), range(1, 4)
PLAIN = Family(years=(10, 40), regions=(1, 4), products=(1, 3))
LIVES = Family(
    years=(10, 40), regions=(1, 3), products=(1, 4), lifetimes=(1, 8), prolonged=0.05, supplied=0.3, idle=0.3
)


def network_of(seed: int) -> Network:
    """Return the network of a seed."""
    network = generated_network(seed, PLAIN if seed % 2 else LIVES)
    if seed % 4 < 2:
        return network
    episode = network.episode
    daily = replace(episode, control_interval=episode.control_interval / 4, horizon=4 * episode.horizon)
    return replace(network, name=f"daily_{seed}", time_unit="day", episode=daily)


def fitting(first: int) -> Iterator[tuple[int, Network]]:
    """Yield the networks that fit, from a seed on."""
    for seed in itertools.count(first):
        network = network_of(seed)
        if len(network.default_agents) in AGENTS and len(network.services) in SERVICES:
            dynamics = Dynamics(network)
            if dynamics.terms * dynamics.substeps <= TERMS:
                yield seed, network


def measured(seed: int, network: Network, recipe: str) -> dict[str, Any]:
    """Train, and return what the acting checkpoint reaches."""
    begun = time.process_time()
    with TemporaryDirectory() as folder:  # as users train: what a kept run lacks at the end is made good
        training = train(network, recipe, seed=1, directory=Path(folder) / "run")
    seconds, score = time.process_time() - begun, training.best
    demanded = training.config.recipe.run.min_service
    assert isinstance(score, Score) and demanded is not None
    certain = bound(network, min_service=demanded)
    certain.verify()
    size = {"agents": len(network.default_agents), "services": len(network.services)}
    size |= {"decisions": network.episode.horizon}
    figures = {"bound": certain.objective, "circularity": score.circularity, "service": score.service}
    distance = float(gap(certain.objective, score.circularity))
    steps = training.config.steps
    return {"seed": seed, "recipe": recipe, **size, **figures, "gap": distance, "steps": steps, "seconds": seconds}


def table(rows: list[dict[str, Any]]) -> str:
    """Return what was measured as a table, and its summary."""
    columns = ("network", "recipe", "agents", "services", "decisions", "gap to the bound", "lowest service", "CPU s")
    cells, sentences = [], []
    for row in sorted(rows, key=lambda row: (row["recipe"], row["seed"])):
        numbers = [str(row[name]) for name in ("agents", "services", "decisions")]
        figures = [f"{row['gap']:.2%}", f"{row['service']:.4f}", f"{row['seconds']:.0f}"]
        cells.append(
            [f"{'years' if row['seed'] % 4 < 2 else 'days'}, {row['seed']}", row["recipe"], *numbers, *figures]
        )
    for recipe in sorted({row["recipe"] for row in rows}):
        gaps, services = (np.array([r[name] for r in rows if r["recipe"] == recipe]) for name in ("gap", "service"))
        sentences.append(
            f"`{recipe}`: median gap {np.median(gaps):.2%}, largest {gaps.max():.2%}, lowest service "
            f"{services.min():.4f} of {len(gaps)} networks."
        )
    return f"{' '.join(sentences)}\n\n{measured_table(columns, cells)}"


def main(
    recipe: Annotated[str, typer.Option(help="Name in the catalogue, or file.")] = RECIPE,
    first: Annotated[int, typer.Option(help="First seed of the networks.")] = FIRST_SEED,
    networks: Annotated[int, typer.Option(help="How many.")] = NETWORKS,
    table_only: Annotated[bool, typer.Option("--table", help="Train nothing.")] = False,
) -> None:
    """Train on generated networks, and write the table."""
    rows = json.loads(RESULTS.read_text()) if RESULTS.is_file() else []
    known = {(row["seed"], row["recipe"]) for row in rows}
    for seed, network in itertools.islice(fitting(first), 0 if table_only else networks):
        if (seed, recipe) not in known:
            rows.append(measured(seed, network, recipe))
            write_json(RESULTS, rows)
            typer.echo(json.dumps(rows[-1]))
    write_sections(DOCUMENT, {"generated": table(rows)})


if __name__ == "__main__":
    typer.run(main)
