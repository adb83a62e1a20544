"""A cell of a sweep: a training run and its evaluation, in a folder whose name follows from what they are."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.definitions.writer import fingerprint
from cirl_marl.errors import RunError
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.statistics import SHARE, over_episodes
from cirl_marl.jobs import Tell
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network.declarations import frozen_record
from cirl_marl.records.files import write_json
from cirl_marl.sweeps.reading import SweepEvaluation, SweepFile

if TYPE_CHECKING:
    from cirl_marl.learners.trainer import Progress

DIGITS = 12
"""Of the hash in the name of a cell."""


def plain_name(words: str) -> str:
    """Return words as part of a file name."""
    return re.sub(r"[^\w-]", "_", words)[:100]


@frozen_record
class Cell:
    """A training run of a sweep and its evaluation."""

    address: Annotated[str, "of the network, as ``load_network`` takes it"]
    network: str
    scenario: str
    recipe: Recipe
    seed: int
    options: Annotated[tuple[tuple[str, Any], ...], "of ``train``, by name"]
    definition_sha256: Annotated[str, "of the network under its scenario, data files included"]
    origins: Annotated[str, "hashes of the policies with which learners begin"] = ""

    @property
    def steps(self) -> int:
        """Environment steps of the training, summed over the copies."""
        return int(dict(self.options).get("steps", self.recipe.run.steps))

    @property
    def content(self) -> dict[str, Any]:
        """All that its result depends on, as resolved and ready for JSON."""
        own_options = dict(self.options)
        run = self.recipe.run.model_dump(mode="json")
        run |= {key: own_options.pop(key) for key in tuple(own_options) if key in run}
        environment = {key: value for key, value in self.recipe.environment.items() if key != "scenario"} | own_options
        return {
            "network": self.network,
            "scenario": self.scenario,
            "seed": self.seed,
            "recipe": self.recipe.model_dump(mode="json") | {"run": run, "environment": environment},
            "definition_sha256": self.definition_sha256,
            "origins": self.origins,
        }

    @property
    def name(self) -> str:
        """Name of its folder: what it is in words, and the hash of its content."""
        words = f"{self.network}-{self.scenario}-{self.recipe.name}-seed{self.seed}"
        text = json.dumps(self.content, sort_keys=True)
        return f"{plain_name(words)}-{hashlib.sha256(text.encode()).hexdigest()[:DIGITS]}"


def cells_of(file: SweepFile) -> list[Cell]:
    """Return the cells of a sweep: seeds vary last, so that what is compared comes to its end together.

    Raises:
        CirlError: for a combination that cannot be trained, before anything is written.
    """
    from cirl_marl.learners.interface import default_recipe, prepare  # they need torch

    cells = []
    lists = {key: values for key, values in file.options.model_dump().items() if values is not None}
    scenarios: list[str | None] = [*file.scenarios] if file.scenarios is not None else [None]
    recipes = {
        (address, scenario): [
            load_recipe(name) for name in file.recipes or [default_recipe(load_network(address, scenario=scenario))]
        ]
        for address in file.networks
        for scenario in scenarios
    }
    for seed, address, scenario, number, *values in itertools.product(
        file.seeds, file.networks, scenarios, range(len(file.recipes or [""])), *lists.values()
    ):
        recipe = recipes[address, scenario][number]
        options = dict(zip(lists, values, strict=True))
        network = load_network(address, scenario=scenario or recipe.environment.get("scenario"))
        begins = any(learner.start is not None for _, learner in recipe.learners())
        origins = ""
        if begins or seed == file.seeds[0]:
            training = prepare(address, recipe, seed=seed, scenario=network.scenario_name, **options)
            training.stackable({})
            read = {name: origin.sha256 for name, origin in training.config.origins.items()}
            origins = hashlib.sha256(json.dumps(read, sort_keys=True).encode()).hexdigest() if read else ""
        names: dict[str, str] = {"address": address, "network": network.name, "scenario": network.scenario_name}
        names |= {"definition_sha256": fingerprint(network), "origins": origins}
        cells.append(Cell(recipe=recipe, seed=seed, options=tuple(options.items()), **names))
    return cells


@dataclass(frozen=True, slots=True)
class CellJob:
    """The work on a cell, in a folder of a sweep."""

    cell: Cell
    folder: Path
    evaluation: SweepEvaluation
    checkpoint_every: float | None

    @property
    def name(self) -> str:
        """Name of the cell."""
        return self.cell.name

    @property
    def run_directory(self) -> RunDirectory:
        """The training run."""
        return RunDirectory(self.folder / "run")

    @property
    def result(self) -> Path:
        """The file that is there when the cell is done."""
        return self.folder / "result.json"

    def is_done(self) -> bool:
        """Return whether it is trained and evaluated."""
        return self.result.is_file()

    def run(self, tell: Tell) -> None:
        """Train, or go on training, and evaluate."""
        from cirl_marl.learners.interface import complete_run  # it needs torch

        cell = self.cell
        directory = load_network(cell.address, scenario=cell.scenario)
        if fingerprint(directory) != cell.definition_sha256:
            raise RunError(f"{cell.address}: was edited while the sweep was running; start the sweep again")
        options = {**dict(cell.options), "scenario": cell.scenario, "seed": cell.seed}
        options |= {"report": self._report(tell), "checkpoint_every": self.checkpoint_every}
        run = complete_run(self.run_directory.path, cell.address, cell.recipe, **options)
        asked = self.evaluation.model_dump()
        comparison = compare(
            [run], ["neutral"], **asked, progress=lambda activity, share: tell("evaluating", share, 1.0)
        )
        entry = next(entry_of_run for entry_of_run in comparison.entries if entry_of_run.run is not None)
        gap = None if entry.gap is None else over_episodes(entry.gap, (0.0, np.inf)).as_dict()
        figures = {
            "circularity": over_episodes(entry.circularity).as_dict(),
            "service": over_episodes(entry.service, SHARE).as_dict(),
            "gap": gap,
            "no_bound": comparison.baseline.reason,
            "unit": comparison.network.mass_unit,
            "checkpoint": entry.checkpoint,
            "evaluation": asked,
        }
        tell("evaluated", 1, 1, lambda: {"gap": None if gap is None else gap["value"]})
        write_json(self.result, figures)

    def _report(self, tell: Tell) -> Callable[[Progress], None]:
        """Return what tells how far the training is, and what the policies reach that are the best so far."""
        steps = self.cell.steps

        def checkpoint() -> dict[str, float]:
            best = self.run_directory.status["best"]
            return {} if best is None else {name: best["figures"][name] for name in ("circularity", "service")}

        return lambda now: tell("training", steps - now.total + now.env_steps, steps, checkpoint)
