"""What the CiRL paper published: its environments, numbers of steps, returns and training times.

The figures are in ``published.toml``. All but the optima are those of Zocco, Corti, Malvezzi, CiRL, arXiv 2505.21536.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Annotated

from pydantic import TypeAdapter

from cirl_marl.definitions.reader import read_toml
from cirl_marl.errors import check_names
from cirl_marl.network.declarations import frozen_record

SOURCE = "Zocco, Corti, Malvezzi: CiRL, arXiv 2505.21536"
HARDWARE = "Tesla T4"
BOX_ALGORITHMS = ("A2C", "ARS", "DDPG", "PPO", "SAC")
GOAL_ALGORITHMS = ("DDPG-HER", "SAC-HER", "TD3-HER", "TQC-HER")
ALGORITHMS = BOX_ALGORITHMS + GOAL_ALGORITHMS


@frozen_record
class PublishedRun:
    """One run of the paper; None where its figure is not known."""

    start_return: Annotated[float | None, "r_s, mean return of the first 100 training episodes"] = None
    end_return: Annotated[float | None, "r_e, mean return of the last 100"] = None
    time: Annotated[timedelta | None, "training time on a Tesla T4"] = None
    success: Annotated[float | None, "s, share of evaluation episodes with a success, percent"] = None

    @property
    def minutes(self) -> float | None:
        """Training time."""
        return None if self.time is None else self.time / timedelta(minutes=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class BestKnown:
    """The best return that is known of an environment, how it was computed, and for which start."""

    value: float
    how: str


@frozen_record
class PaperEnvironment:
    """One environment of the paper, in which every algorithm was trained for ``steps``."""

    name: str
    steps: int
    runs: Mapping[str, PublishedRun]
    optima: tuple[BestKnown, ...] = ()
    success_episodes: Annotated[int, "evaluation episodes over which successes count; 0 if there is no success"] = 0
    published_ends: Annotated[bool, "whether the published class ends episodes as ``legacy_episode=True`` does"] = False
    comparable: Annotated[bool, "whether returns may be set against the paper's"] = True
    remark: Annotated[str, "in what the environment may differ from the published one; empty if in nothing"] = ""

    @property
    def id(self) -> str:
        """Gymnasium id."""
        return f"cirl_marl/{self.name}-v0"

    @property
    def has_goals(self) -> bool:
        """Whether it is a task with goals, which the paper's learners relabel in hindsight."""
        return all(algorithm in GOAL_ALGORITHMS for algorithm in self.runs)


_TABLES = read_toml(Path(__file__).with_name("published.toml"))
ENVIRONMENTS: Mapping[str, PaperEnvironment] = TypeAdapter(dict[str, PaperEnvironment]).validate_python(
    {name: {"name": name, **table} for name, table in _TABLES.items()}
)
"""By name, in the paper's order."""


def environment_of(name: str) -> PaperEnvironment:
    """Return the environment of the paper called ``name``.

    Raises:
        CirlError: if there is none; names the nearest.

    >>> environment_of("CopperNet").steps
    200000
    """
    check_names("environment of the paper", [name], ENVIRONMENTS)
    return ENVIRONMENTS[name]
