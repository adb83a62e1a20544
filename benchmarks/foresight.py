"""What policies reach that do not know the future, held against the bound for them and against perfect information.

``python benchmarks/foresight.py`` prints a table for each of WORLDS, ``--network NAME --scenario NAME`` of another.
"""

from __future__ import annotations

import time
from typing import Annotated

import typer
from rich.console import Console

from cirl_marl import Network, bound, load_network
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.statistics import Aggregate
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.uncertain_bound import UncertainBound

SERVICE = 0.99
WORLDS = {"copper_net": "outages", "carbo_net": "weather"}
"""Scenarios in which something happens that nobody foresees."""
console = Console(width=140)


def main(
    network: Annotated[list[str] | None, typer.Option(help="Networks; default: all of WORLDS.")] = None,
    scenario: Annotated[str | None, typer.Option(help="Their scenario; default: that of WORLDS.")] = None,
    draws: Annotated[int, typer.Option(help="Futures of which the bound is the mean.")] = 200,
    fit_draws: Annotated[int, typer.Option(help="Further ones, to which prices are fitted.")] = 32,
    horizon: Annotated[int | None, typer.Option(help="Decisions per episode; default: those of the network.")] = None,
    degree: Annotated[int, typer.Option(help="Degree of the test polynomials.")] = 1,
    controllers: Annotated[str, typer.Option(help="Who is held against it.")] = "neutral,scripted,optimum",
    workers: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Print a table for each network."""
    for name in network or [*WORLDS]:
        definition = load_network(name, scenario=scenario or WORLDS.get(name))
        if horizon is not None:
            definition = definition.with_options(episode={"horizon": horizon})
        began = time.process_time()
        place = {"on": "local", "workers": workers} if workers > 1 else {}
        sampling = Sampling(draws=draws, fit_draws=fit_draws, numbers=False, **place)  # type: ignore[arg-type]
        found = bound(definition, min_service=SERVICE, degree=degree, uncertain=sampling)
        seconds = time.process_time() - began
        console.print(f"{found}; half-width {found.half_width / found.scale:.2%} of the scale, {seconds:.0f} CPU s")
        _table(definition, found, controllers.split(","))


def _table(network: Network, found: UncertainBound, controllers: list[str]) -> None:
    comparison = compare((), controllers, network=network, min_service=SERVICE, bounds=False, uncertain_bound=found)
    console.print("| who | mean λ̄ | expected level of each service | gap | gap to perfect information |\n|-|-|-|-|-|")
    for row in comparison.rows:
        levels = ", ".join(f"{level.value:.4f}" for level in row.levels())
        gaps = [row.figure(name) for name in ("expected_gap", "foresight_gap")]
        cells = [row.name, _figure(row.figure("circularity")), levels, *map(_percent, gaps)]
        console.print(f"| {' | '.join(cells)} |", soft_wrap=True)


def _figure(figure: Aggregate | None) -> str:
    return "" if figure is None else f"{figure.value:.5g}"


def _percent(figure: Aggregate | None) -> str:
    return "" if figure is None else f"{100 * figure.value:.2f} % [{100 * figure.low:.2f}, {100 * figure.high:.2f}]"


if __name__ == "__main__":
    typer.run(main)
