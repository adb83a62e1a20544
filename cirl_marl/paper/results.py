"""Results of the paper's runs on disk: a directory with one JSON file per row.

A file is written whole or not at all, and holds everything that the row's figures depend on. A row whose file is there
is done; an interrupted one has none.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from cirl_marl.errors import RunError
from cirl_marl.records.files import read_record, write_atomically

CURVE_POINTS = 500
WINDOW = 100
"""Training episodes over which r_s and r_e are means, as in the paper."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperRow:
    """One training run: environment and algorithm as the paper calls them, and environment steps over all copies.

    Settings are ``published``, the paper's own, or ``tuned``, those of ``agents/paper_*.toml``. The algorithm of a
    tuned row is that of its recipe, with ``-HER`` where it learns in hindsight.
    """

    environment: str
    algorithm: str
    settings: str = "published"
    steps: int
    seed: int = 0

    def __str__(self) -> str:
        """Name the row in a line of text."""
        return f"{self.environment} {self.algorithm} ({self.settings}, {self.steps:,} steps, seed {self.seed})"

    @property
    def stem(self) -> str:
        """Name of its files."""
        return f"{self.environment}-{self.algorithm}-{self.settings}-{self.steps}-seed{self.seed}"


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationFigures:
    """The final policy, deterministic, on fresh episodes: mean and standard deviation of their returns.

    ``success`` is the share with a success at any step, percent; None if the environment knows no success.
    """

    episodes: int
    mean: float
    deviation: float
    success: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What a finished row measured, and what it depends on.

    Attributes:
        steps_done: environment steps done; on-policy learners finish their last rollout, and a learner whose weights
            became NaN did no more.
        seconds: wall time of training, without evaluation.
        episodes: training episodes that ended.
        start_return: r_s, mean return of the first 100 of them.
        end_return: r_e, mean return of the last 100.
        curve: (steps, mean return) of consecutive training episodes, at most 500 points.
        evaluation: of the final policy; None if its weights became NaN, and there is none.
        settings: hyperparameters that differ from the library's defaults, copies, the environment's id and arguments.
        versions: of Python and the packages.
        machine: processors and their model, torch threads, load at the end.
        finished: when, UTC.
        cpu_seconds: processor time of training, which other work on the machine does not lengthen; None if not known.
        published_ends: of the final policy where episodes end as the published class ends them; None if that is as
            here, or not known.
    """

    row: PaperRow
    steps_done: int
    seconds: float
    episodes: int
    start_return: float
    end_return: float
    curve: list[tuple[int, float]]
    evaluation: EvaluationFigures | None
    settings: dict[str, Any]
    versions: dict[str, str]
    machine: dict[str, Any]
    finished: str
    cpu_seconds: float | None = None
    published_ends: EvaluationFigures | None = None

    @property
    def gain(self) -> float:
        """ζ = r_e − r_s."""
        return self.end_return - self.start_return

    @property
    def window(self) -> int:
        """Episodes over which r_s and r_e are means: 100, or half of those that there were."""
        return max(1, min(WINDOW, self.episodes // 2))

    @property
    def has_diverged(self) -> bool:
        """Whether the weights became NaN, so that the training ended before its time and left no policy."""
        return self.evaluation is None

    @property
    def gain_per_step(self) -> float:
        """ψ = ζ / steps done."""
        return self.gain / self.steps_done


class Results:
    """A directory of results."""

    def __init__(self, path: str | Path) -> None:
        """Refer to a directory; it is made when the first result is written."""
        self.path = Path(path)

    def file(self, row: PaperRow) -> Path:
        """Return where the result of ``row`` is kept."""
        return self.path / f"{row.stem}.json"

    def has(self, row: PaperRow) -> bool:
        """Return whether ``row`` is done."""
        return self.file(row).is_file()

    def read(self, row: PaperRow) -> Result:
        """Return the result of ``row``; a ``RunError`` if it is not done, or its file is not a result."""
        return _read(self.file(row))

    def prepare(self) -> None:
        """Make the directory; a ``RunError`` if the path cannot be one."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"{self.path}: results need a directory: {error.strerror}") from error

    def write(self, result: Result) -> None:
        """Keep a result, in one step."""
        self.prepare()
        figures = {"gain": result.gain, "gain_per_step": result.gain_per_step}
        text = _one_line_each(asdict(result) | figures)
        write_atomically(self.file(result.row), lambda partial: partial.write_text(text))

    def read_all(self) -> list[Result]:
        """Return every result in the directory, by file name."""
        return [_read(path) for path in sorted(self.path.glob("*.json")) if not path.name.startswith(".")]


def _one_line_each(plain: dict[str, Any]) -> str:
    """Return JSON with a line for each key, so that a learning curve is one line and not a thousand.

    >>> print(_one_line_each({"episodes": 2, "curve": [(50, -2.0), (100, -1.0)]}), end="")
    {
      "episodes": 2,
      "curve": [[50, -2.0], [100, -1.0]]
    }
    """
    lines = (f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in plain.items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _read(path: Path) -> Result:
    try:
        plain = read_record(path)
        plain["row"].setdefault("settings", plain["row"].pop("recipe", "published"))  # what files of 0.1 call it
        return TypeAdapter(Result).validate_python(plain)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RunError(f"{path}: is not the result of a row: {error!r}; delete it to run the row again") from error


def thin_out(ends: Sequence[int], returns: Sequence[float]) -> list[tuple[int, float]]:
    """Return at most 500 points of a learning curve: means of consecutive episodes, at the step where the last ended.

    >>> thin_out([50, 100], [-2.0, -1.0])
    [(50, -2.0), (100, -1.0)]
    """
    parts = np.array_split(np.arange(len(returns)), min(CURVE_POINTS, len(returns)))
    values = np.asarray(returns, dtype=float)
    return [(int(ends[part[-1]]), float(values[part].mean())) for part in parts]
