"""What no policy of a network exceeds, by the service that it delivers: for the gaps that are shown while cells train.

It is proved for the middle of the initial ranges alone, so these gaps are a little off. Results have their own bounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.errors import RunError
from cirl_marl.jobs import Tell
from cirl_marl.optimum import NoCertificate, bound, gap
from cirl_marl.optimum.bounds import highest_service
from cirl_marl.records.files import read_record, write_json
from cirl_marl.sweeps.cells import DIGITS, Cell, plain_name

DEMAND = 0.9
"""Part of the highest service that the program of the front demands; its multipliers prove what holds elsewhere."""


@dataclass(frozen=True, slots=True)
class FrontJob:
    """The work on the front of a network under a scenario."""

    address: str
    network: str
    scenario: str
    horizon: int | None
    definition_sha256: str
    folder: Path

    @classmethod
    def of(cls, cell: Cell, folder: Path) -> FrontJob:
        """Return the work on the front to which a cell is held; cells share it."""
        horizon = dict(cell.options).get("horizon", cell.recipe.environment.get("horizon"))
        return cls(cell.address, cell.network, cell.scenario, horizon, cell.definition_sha256, folder)

    @property
    def name(self) -> str:
        """Name of its file and of the job."""
        words = plain_name(f"bound-{self.network}-{self.scenario}")
        return f"{words}{'' if self.horizon is None else f'-{self.horizon}'}-{self.definition_sha256[:DIGITS]}"

    @property
    def file(self) -> Path:
        """Where the front is kept."""
        return self.folder / f"{self.name}.json"

    def is_done(self) -> bool:
        """Return whether it is known what is proved."""
        return self.file.is_file()

    def run(self, tell: Tell) -> None:
        """Prove what can be proved."""
        network = load_network(self.address, scenario=self.scenario)
        if self.horizon is not None:
            network = network.with_options(episode={"horizon": self.horizon})
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            most = highest_service(network)
            tell("bound", 1, 3)
            solution = bound(network, min_service=DEMAND * most)
            tell("bound", 2, 3)
            levels = np.linspace(0.0, most, 3)
            points = solution.at(min_service=levels[:, None])
        except NoCertificate as missing:
            write_json(self.file, {"levels": [], "proved": [], "reason": str(missing)})
            return
        write_json(self.file, {"levels": levels.tolist(), "proved": points.tolist(), "reason": ""})

    def gap(self, figures: Mapping[str, Any]) -> float | None:
        """Return how far policies with these figures are from the front, about; None if that is not known."""
        if not self.is_done() or "circularity" not in figures:
            return None
        front = read_record(self.file)
        try:
            levels, proved = (np.array(front[name], dtype=float) for name in ("levels", "proved"))
            points = np.interp(figures["service"], levels, proved) if levels.size else None
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(f"{self.file}: is not what is proved of a network: {error!r}; delete it") from error
        if points is None:
            return None
        return max(0.0, float(gap(points, figures["circularity"])))
