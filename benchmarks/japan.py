"""One question answered from end to end, for ``docs/japan.md``: what Japan can do by 2050 to cut ore and losses.

python -m benchmarks.japan             # levers and their order, and how sure it is (a quarter of an hour)
python -m benchmarks.japan --run RUN   # with agents trained by cirl train steel_japan, as well
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from benchmarks.document import write_sections
from cirl_marl import Levers, MultiAgentVectorEnv, levers, load_network
from cirl_marl.controllers import Constant, Neutral
from cirl_marl.controllers.rollout import episode_start, rollout
from cirl_marl.evaluation import Comparison, compare
from cirl_marl.evaluation.sampling import sample_episodes, sensitivities
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Floats, Network
from cirl_marl.optimum import gap
from cirl_marl.report.decisions import savings
from cirl_marl.report.lever_chart import save_levers

DOCUMENT = Path(__file__).parent.parent / "docs" / "japan.md"
NAME = "steel_japan"
SAMPLES, EPISODES = 500, 8
TOGETHER = {"what is exported, steel or goods": ("semis_exports", "long_exports", "flat_exports", "goods_exports")}
"""Agents of one decision: what Japan exports, whatever its form."""


def question(result: Levers) -> Iterator[str]:
    """Yield what is taken and lost, as usual and as planned."""
    yield "| 2025–2050, Mt | as usual | plan | saved |"
    yield "|-|-|-|-|"
    for what, with_plan, without in savings(result.network, result.together.run, result.usual.run):
        yield f"| {what} | {without / 1e3:.0f} | {with_plan / 1e3:.0f} | {(without - with_plan) / without:.0%} |"
    yield ""
    limit = result.plan.verify().bound
    off = float(gap(limit, result.together.circularity))
    yield f"The bound is λ̄ = {limit / 1e3:.2f} Mt/a; the plan is {off:.2%} from it, at full service."


def order(result: Levers) -> Iterator[str]:
    """Yield the levers in the order in which each adds most to those before it."""
    yield "| lever | alone, Mt/a | with those above, Mt/a | without it, Mt/a | all so far |"
    yield "|-|-|-|-|-|"
    for place, row in enumerate(result.rows):
        changes = " | ".join(f"{change / 1e3:+.2f}" for change in result.changes(place))
        yield f"| {row.name} | {changes} | {result.share(place):.0%} |"
    trials = [trial for row in result.rows for trial in (row.alone, row.added, row.without)]
    least, most = min(trial.service for trial in trials), max(trial.gap or 0.0 for trial in trials)
    yield ""
    yield f"The lowest service of these {len(trials)} episodes is {least:.4f}, the largest gap to a bound {most:.1%}."


def lives() -> Iterator[str]:
    """Yield what longer lives are worth, by themselves and on top of what agents do until then."""
    network = load_network(NAME, scenario="longer_lives")
    env = MultiAgentVectorEnv(network, num_envs=1)
    begun = episode_start(env)
    neutral = {agent: float(action[0, 0]) for agent, action in env.neutral_action.items()}
    usual = rollout(env, Neutral(), seed=begun.seed, start=begun.initial_state)
    yield "| a quarter longer by 2050 | λ̄, Mt/a | from as usual | lowest service |"
    yield "|-|-|-|-|"
    sectors = ("vehicles", "machinery", "construction", "other_products")
    for name, held in {**{each: (each,) for each in sectors}, "all four": sectors}.items():
        run = rollout(
            env, Constant({**neutral, **dict.fromkeys(held, 1.0)}), seed=begun.seed, start=begun.initial_state
        )
        label = name if name not in network.compartments else network.compartments[name].label.lower()
        change = float(run.episode_circularity[0] - usual.episode_circularity[0])
        least = run.levels[0].mean(axis=1).min()
        yield f"| {label} | {run.episode_circularity[0] / 1e3:.2f} | {change / 1e3:+.2f} | {least:.3f} |"


def spread(network: Network) -> Iterator[str]:
    """Yield how λ̄ as usual spreads, and which number causes it."""
    found = sample_episodes(network, samples=SAMPLES)
    mean = found.circularity.mean(axis=1) / 1e3
    low, high = np.quantile(mean, (0.025, 0.975)).tolist()
    (cause, *_) = sensitivities(found)
    yield f"As usual, {SAMPLES} draws: λ̄ = {mean.mean():.1f} Mt/a, 95 % in [{low:.1f}, {high:.1f}]."
    yield ""
    yield "| number | share of the spread |"
    yield "|-|-|"
    for i in np.argsort(-cause.shares).tolist():
        yield f"| `{found.names[i]}` | {max(0.0, cause.shares[i]):.0%} ± {cause.margins[i]:.0%} |"


def under_uncertainty(run: Path | None) -> Iterator[str]:
    """Yield who comes how far if nobody knows the numbers exactly."""
    runs = [] if run is None else [RunDirectory(run)]
    certain = compare(runs, ("neutral", "optimum", "mpc"), network=NAME, episodes=2, min_service=1.0, uncertain=False)
    drawn = compare(
        runs, ("neutral", "optimum", "mpc"), network=NAME, episodes=EPISODES, min_service=1.0, uncertain=True
    )
    yield f"| who | λ̄, Mt/a, numbers known | gap | λ̄, {EPISODES} draws | lowest service | bound | gap |"
    yield "|-|-|-|-|-|-|-|"
    exact = _figures(certain)
    for name, (circularity, service, best, off) in _figures(drawn).items():
        known = exact[name]
        yield (
            f"| {name} | {known[0] / 1e3:.2f} | {known[3]:.1%} | {circularity / 1e3:.2f} | {service:.4f} "
            f"| {best / 1e3:.2f} | {off:.1%} |"
        )


def _figures(found: Comparison) -> Mapping[str, tuple[float, float, float, float]]:
    """Return λ̄, the lowest service, the bound and the gap of each row, means over the episodes."""
    figures = {}
    for row in found.rows:
        entry = row.entries[0]
        assert entry.bound is not None and entry.gap is not None
        least: Floats = entry.rollout.least_service
        means = [float(np.mean(each)) for each in (entry.circularity, least, entry.bound, entry.gap)]
        figures[row.name] = (means[0], means[1], means[2], means[3])
    return figures


def main() -> None:
    """Write the measured parts of the document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="agents trained by cirl train steel_japan")
    asked = parser.parse_args()
    network = load_network(NAME)
    result = levers(network, groups=TOGETHER)
    save_levers(DOCUMENT.parent / "pictures" / "japan_levers.png", result)
    parts = {
        "saved": question(result),
        "levers": order(result),
        "lives": lives(),
        "spread": spread(network),
        "known": under_uncertainty(asked.run),
    }
    for name, lines in parts.items():
        write_sections(DOCUMENT, {name: "\n".join(lines)})


if __name__ == "__main__":
    main()
