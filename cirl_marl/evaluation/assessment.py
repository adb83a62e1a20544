"""Evaluation of a training run: its policies beside neutral and random control, in the same fresh episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RunError
from cirl_marl.evaluation.comparison import Comparison, compare
from cirl_marl.evaluation.figures import summary
from cirl_marl.evaluation.statistics import over_episodes
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum.aims import aims_of
from cirl_marl.records.files import read_record, write_json

CONTROLLERS = ("neutral", "random")
"""Whom a run is compared with."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What came of the policies of a run, and of neutral and random control, in the same episodes.

    Attributes:
        run: the run whose policies acted.
        comparison: all episodes, and the bounds that they are held against.
        has_bounds: whether bounds were asked for.
        figures: means over episodes with their 95 % confidence intervals, ready for JSON.
        env: environment of the run, with as many copies as there were episodes.
    """

    run: RunDirectory
    comparison: Comparison
    has_bounds: bool
    figures: Mapping[str, Any]
    env: MultiAgentVectorEnv

    @property
    def rollouts(self) -> dict[str, Rollout]:
        """The episodes of ``trained``, ``neutral`` and ``random``."""
        entries = zip(("trained", *CONTROLLERS), self.comparison.entries, strict=True)
        return {name: entry.rollout for name, entry in entries}

    def __str__(self) -> str:
        """Say for each controller what λ̄, service level and gap were."""
        lines, unit = [], self.figures["unit"]
        for name, figures in self.figures["controllers"].items():
            line = f"{name}: λ̄ {figures['circularity']['value']:.5g} {unit}"
            line += f", service level {figures['service_level']['value']:.4f}"
            if self.comparison.network.disturbed:
                worst = [f"λ̄ {figures['worst_circularity']['value']:.5g} {unit}"]
                worst += [f"{id_} {level['value']:.4f}" for id_, level in figures["worst_service_levels"].items()]
                line += f"; of the 5 % worst episodes {', '.join(worst)}"
            gap = figures.get("gap", {}).get("value")
            lines.append(line + (f", gap to the bound {gap:.1%}" if gap is not None else ""))
        return "\n".join([*lines, acting_checkpoint(self.run)])

    def write(self, path: str | Path | None = None) -> Path:
        """Write the figures as JSON and return the path, that of ``evaluation.json`` in the run unless one is given.

        The file in the run is left as it is if this evaluation has no bounds and the file is of the same checkpoint in
        the same episodes, as it may have them.
        """
        own_path = self.run.path / "evaluation.json"
        if path is not None or self.has_bounds or not self._is_kept(own_path):
            write_json(own_path if path is None else Path(path), self.figures)
        return own_path if path is None else Path(path)

    def _is_kept(self, path: Path) -> bool:
        try:
            content = read_record(path) if path.is_file() else {}
        except RunError as error:
            raise RunError(f"{error}; delete it to evaluate anew") from error
        return all(content.get(name) == self.figures[name] for name in ("checkpoint", "episodes", "first_seed"))


def evaluate(
    run: str | Path | RunDirectory,
    *,
    episodes: int | None = None,
    seed: int = 0,
    bounds: bool = True,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> Evaluation:
    """Compare the trained policies of a run with neutral and random control on fresh episodes.

    Args:
        run: directory of a training run.
        episodes: how many, at least 2; None: 64, or of a disturbed network as many as ``compare`` takes.
        seed: different seeds share no episode.
        bounds: whether to hold the episodes against the best possible, which takes longer than the episodes.
        progress: called with what is being done and the share of all that is done.

    Raises:
        CirlError: if ``episodes`` or ``seed`` cannot be used.
        RunError: if the run is incomplete.
    """
    run = run if isinstance(run, RunDirectory) else RunDirectory(run)
    comparison = compare([run], CONTROLLERS, episodes=episodes, seed=seed, bounds=bounds, progress=progress)
    entries = dict(zip(("trained", *CONTROLLERS), comparison.entries, strict=True))
    env = run.make_env(comparison.episodes)
    figures = summary(env, {name: entry.rollout for name, entry in entries.items()})
    for name, entry in entries.items():
        if entry.bound is not None and entry.gap is not None:
            figures["controllers"][name] |= {
                "bound": over_episodes(entry.bound).as_dict(),
                "gap": over_episodes(entry.gap, (0.0, np.inf)).as_dict(),
            }
    if comparison.baseline.reason:
        figures["no_bound"] = comparison.baseline.reason
    config = run.config
    figures |= {"network": config.network, "recipe": config.recipe.name, "first_seed": comparison.first_seed}
    figures["checkpoint"] = entries["trained"].checkpoint
    return Evaluation(run, comparison, bounds, figures, env)


def acting_checkpoint(run: RunDirectory) -> str:
    """Say which checkpoint of a run acts, and by what it was chosen."""
    status, config, network = run.status, run.config, run.network()
    best = status["best"]
    if best is None:
        return f"who acts: the last checkpoint, after {status['joint_steps'] * config.envs:,} environment steps"
    figures, demand = best["figures"], config.recipe.run.min_service
    sentence = (
        f"who acts: the checkpoint after {best['joint_steps'] * config.envs:,} environment steps, the best of "
        f"{run.evaluations()} evaluations (λ̄ {figures['circularity']:.4g} {network.mass_unit}, "
        f"lowest service {figures['service']:.4f})"
    )
    if demand is not None and figures["assured"] < demand:
        sentence += f"; none assured the service of {demand:g} that the recipe demands"
        lacks = sorted((level, service) for service, level in figures.get("levels", {}).items() if level < demand)
        sentence += f" ({', '.join(f'{service} {level:.4f}' for level, service in lacks)})" if lacks else ""
    if config.recipe.run.at_most:
        network, amounts = run.make_env(1).network, figures.get("accounts", {})
        budgets = aims_of(network, CIRCULARITY, config.recipe.run.at_most).budgets
        excess = [f"{b.text(network)}: {amounts[b.name]:.6g}" for b in budgets if amounts.get(b.name, -np.inf) > b.most]
        sentence += f"; it does not keep the budgets of the recipe ({'; '.join(excess)})" if excess else ""
    return sentence
