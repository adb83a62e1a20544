"""Does independent learning raise circularity? Several seeds of one recipe on each network, with confidence intervals.

Run it with ``python benchmarks/learning.py``; finished seeds are kept, so it can be stopped and started again.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from cirl_marl.learners import RunDirectory, load_recipe, train
from cirl_marl.learners.run import write_json
from cirl_marl.report.run import evaluate_run
from cirl_marl.statistics import Estimate, estimate

console = Console(width=140)
CONTROLLERS = ("trained", "neutral", "random")


def main(
    networks: Annotated[list[str] | None, typer.Argument(help="Networks; default: copper_net carbo_net.")] = None,
    recipe: str = "independent_ppo",
    seeds: int = 5,
    steps: Annotated[int | None, typer.Option(help="Environment steps; default: the recipe's.")] = None,
    out: Path = Path("runs/study"),
    markdown: Annotated[Path | None, typer.Option(help="Also write the table here.")] = None,
) -> None:
    """Train ``recipe`` with seeds 0, 1, … on each network and compare with neutral and random control."""
    lines = [
        f"`{recipe}`, {seeds} seeds, {steps or load_recipe(recipe).run.steps:,} environment steps each; 64 fresh "
        "episodes per seed; mean over seeds ± half-width of the 95 % confidence interval (Student's t over seeds).",
        "",
        "| network | controller | λ̄ | gain over neutral | service level | minutes per seed |",
        "|-|-|-|-|-|-|",
    ]
    for network in networks or ["copper_net", "carbo_net"]:
        results = [_seed(network, recipe, seed, steps, out / f"{network}-{recipe}-{seed}") for seed in range(seeds)]
        minutes = float(np.mean([result["seconds"] for result in results])) / 60
        for controller in CONTROLLERS:
            row = [
                _over_seeds(results, controller, figure)
                for figure in ("circularity", "circularity_gain", "service_level")
            ]
            spent = f"{minutes:.1f}" if controller == "trained" else ""
            lines.append(
                f"| {network} | {controller} | {row[0].mean:.2f} ± {row[0].half_width:.2f} {results[0]['unit']} "
                f"| {row[1].mean:+.1%} ± {row[1].half_width:.1%} "
                f"| {row[2].mean:.4f} ± {row[2].half_width:.4f} | {spent} |"
            )
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)
    if markdown is not None:
        markdown.write_text("\n".join(lines) + "\n")


def _seed(network: str, recipe: str, seed: int, steps: int | None, directory: Path) -> dict[str, Any]:
    """Train and evaluate one seed, unless its result is there."""
    result = directory / "study.json"
    if result.is_file():
        found: dict[str, Any] = json.loads(result.read_text())
        return found
    began = time.perf_counter()
    train(network, recipe, directory=directory, seed=seed, steps=steps)
    seconds = time.perf_counter() - began
    figures, _, _ = evaluate_run(RunDirectory(directory), seed=seed)
    figures["seconds"] = seconds
    write_json(result, figures)
    trained = figures["controllers"]["trained"]
    console.print(
        f"{network} seed {seed}: {seconds:.0f} s, λ̄ {trained['circularity']['mean']:.2f}, "
        f"service {trained['service_level']['mean']:.4f}"
    )
    return figures


def _over_seeds(results: list[dict[str, Any]], controller: str, figure: str) -> Estimate:
    return estimate(np.array([result["controllers"][controller][figure]["mean"] for result in results]))


if __name__ == "__main__":
    typer.run(main)
