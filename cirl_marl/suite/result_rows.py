"""Rows of results: ``results.csv``, which anybody extends with rows of their own, and the weights beside it."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from filelock import FileLock

from cirl_marl.controllers.basic import Controller
from cirl_marl.errors import CirlError, RunError, check_names, whole_number
from cirl_marl.network.declarations import KeptRecord, frozen_record
from cirl_marl.records.files import sha256_of, write_table
from cirl_marl.suite.tasks import (
    CONTROLLERS,
    PACKAGE_DATA,
    BenchmarkTask,
    Figures,
    algorithms,
    load_algorithm,
    load_task,
    tasks,
)
from cirl_marl.suite.weights import controller_of

if TYPE_CHECKING:
    from cirl_marl.learners.interface import Trained

KEPT_RESULTS = PACKAGE_DATA / "results.csv"
FORMS = {"circularity": "{:.6g}", "service": "{:.5f}", "gap": "{:.5f}", "gap_low": "{:.5f}", "gap_high": "{:.5f}"}
"""How figures are written; a rerun must give the same digits."""
HALF_A_DIGIT = 0.6
"""By how much of the last digit a rerun may differ: half of it is rounding, the rest that of other processors."""
OTHER_VERTEX = 2e-4
"""By how much of a figure, or of 1, a rerun of MPC may differ: on another processor its programs may end at another of
several optima."""


@frozen_record
class ResultRow(KeptRecord):
    """What a policy reached on a task."""

    task: str
    variant: Annotated[int, "0, or the held-out variant"] = 0
    algorithm: Annotated[str, "of the suite, or a name of its own"]
    seed: Annotated[int | None, "of the training; None of controllers"] = None
    steps: Annotated[int, "environment steps of the training; 0 of controllers"] = 0
    episodes: Annotated[int, "of the evaluation, its first"]
    circularity: Annotated[float, "λ̄, mass"] = math.nan
    service: Annotated[float, "mean level of the service that lacks most"] = math.nan
    gap: Annotated[float, "to the bound, with each service at its price; its 95 % interval over episodes follows"] = (
        math.nan
    )
    gap_low: float = math.nan
    gap_high: float = math.nan
    weights: Annotated[str, "file, from the folder of the table; empty of neutral control"] = ""
    sha256: Annotated[str, "its hash"] = ""
    version: Annotated[str, "of cirl-marl"] = ""
    contributor: Annotated[str, "who adds it"] = ""

    @property
    def id(self) -> str:
        """``TASK/ALGORITHM/SEED``, or ``TASK/ALGORITHM`` of what is not trained."""
        return "/".join([self.task, self.algorithm, *([] if self.seed is None else [str(self.seed)])])

    @property
    def score(self) -> float:
        """Score of the policy; see ``BenchmarkTask``."""
        return load_task(self.task).score(self.gap, self.service)


def columns_of(figures: Figures) -> dict[str, float]:
    """Return figures by the names of their columns."""
    gap = figures.gap
    values = (figures.circularity.value, figures.service.value, gap.value, gap.low, gap.high)
    return dict(zip(FORMS, values, strict=True))


def key_of(row: ResultRow) -> tuple[str, int]:
    """Return by what rows are told apart: id and variant."""
    return row.id, row.variant


def read_rows(path: Path = KEPT_RESULTS) -> list[ResultRow]:
    """Return the rows of a table.

    Raises:
        RunError: for what is no such table; it names file, row and value.
    """
    names = [field.name for field in fields(ResultRow)]
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets begin files with a mark
            header, *lines = list(csv.reader(file)) or [[]]
    except FileNotFoundError:
        raise RunError(f"{path}: no such table of results") from None
    except (OSError, ValueError, csv.Error) as error:
        raise RunError(f"{path}: is no table of results: {error}") from error
    if header != names:
        raise RunError(f"{path}: has the columns {', '.join(header)}; a table of results has {', '.join(names)}")
    rows: dict[tuple[str, int], ResultRow] = {}
    for number, line in enumerate(lines, 2):
        place = f"{path}: row {number}"
        if len(line) != len(names):
            raise RunError(f"{place}: has {len(line)} cells, not {len(names)}")
        row = ResultRow(**{name: _cell(place, name, text) for name, text in zip(names, line, strict=True)})
        check_names("task", [row.task], tasks(), f"{place}: ", RunError)
        with _error_place(place):
            task_of(row)
        if not row.algorithm.strip():
            raise RunError(f"{place}: algorithm is empty; name one of the suite, or your own")
        if row.algorithm in CONTROLLERS and row.seed is not None:
            raise RunError(f"{place}: seed {row.seed}: '{row.algorithm}' is not trained; leave it empty")
        if row.algorithm in CONTROLLERS and row.steps:
            raise RunError(f"{place}: steps {row.steps}: '{row.algorithm}' is not trained; write 0")
        if (weights := Path(row.weights)).is_absolute() or ".." in weights.parts:
            raise RunError(f"{place}: weights '{row.weights}' are not below the folder of the table")
        if rows.setdefault(key_of(row), row) is not row:
            raise RunError(f"{place}: '{row.id}', variant {row.variant}, is there already")
    return [*rows.values()]


NUMBERS: Mapping[str, Callable[[str], Any]] = {
    "variant": int,
    "seed": lambda text: int(text) if text else None,
    "steps": int,
    "episodes": int,
    **dict.fromkeys(FORMS, float),
}
LEAST = {"seed": 0, "steps": 0, "episodes": 1}


@contextmanager
def _error_place(place: str) -> Iterator[None]:
    """Say where what cannot be used stands."""
    try:
        yield
    except CirlError as error:
        raise RunError(f"{place}: {error}") from error


def _cell(place: str, name: str, text: str) -> Any:
    try:
        value = NUMBERS.get(name, str)(text)
    except ValueError:
        raise RunError(f"{place}: {name} '{text}' is no number") from None
    if name in LEAST and value is not None:
        with _error_place(place):
            whole_number(name, value, LEAST[name])
    if name in ("circularity", "service", "gap") and not math.isfinite(value):
        raise RunError(f"{place}: {name} is {text}")
    return value


def add_rows(path: Path, more: Sequence[ResultRow]) -> None:
    """Add rows to a table, or begin it; rows of the same id and variant are replaced."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock")):
        rows = {key_of(row): row for row in [*(read_rows(path) if path.is_file() else []), *more]}
        order = sorted(rows.values(), key=_order)
        write_table(path, [field.name for field in fields(ResultRow)], map(_cells, order))


def _order(row: ResultRow) -> tuple[Any, ...]:
    place = CONTROLLERS.index(row.algorithm) if row.algorithm in CONTROLLERS else len(CONTROLLERS)
    return tasks().index(row.task), place, row.algorithm, row.seed or 0, row.variant


def _cells(row: ResultRow) -> list[object]:
    return [FORMS[name].format(value) if name in FORMS else value for name, value in row.as_dict().items()]


def task_of(row: ResultRow) -> BenchmarkTask:
    """Return the task of a row, or its variant."""
    task = load_task(row.task)
    return task.held_out(row.variant) if row.variant else task


def verify(path: Path = KEPT_RESULTS, ids: Sequence[str] = (), *, variants: bool = False) -> list[str]:
    """Rerun the policies of rows from their weights, and return what was found as it is digits, row by row.

    Args:
        path: the table.
        ids: of the rows; empty: all.
        variants: whether rows of held-out variants are rerun as well.

    Raises:
        CirlError: for an id that the table does not have.
        RunError: for a table without such rows, weights that are missing or others than the row's, another seed,
            algorithm or number of steps than theirs, or figures that a rerun does not give; it names file, row, column
            and both values.
    """
    rows = [row for row in read_rows(path) if variants or not row.variant]
    if not rows:
        raise RunError(f"{path}: has no rows{'' if variants else ' but those of held-out variants'} to rerun")
    check_names("row", ids, [row.id for row in rows], f"{path}: ")
    selection = [row for row in rows if not ids or row.id in ids]
    for row in selection:
        _verify(path, row)
    return [row.id for row in selection]


def _verify(path: Path, row: ResultRow) -> None:
    place, task = f"{path}: row '{row.id}'" + (f", variant {row.variant}" if row.variant else ""), task_of(row)
    if not row.weights and row.algorithm != "neutral":
        raise RunError(f"{place}: names no weights, without which nothing can be rerun")
    weights = path.parent / row.weights if row.weights else None
    if weights is not None:
        if not weights.is_file():
            raise RunError(f"{place}: its weights are missing: {weights}")
        if (actual := sha256_of(weights)) != row.sha256:
            raise RunError(f"{place}: {weights} has another SHA-256, {actual}, than the row, {row.sha256}")
    with _error_place(place):
        controller, options = controller_of(task, row.algorithm, weights)
        figures = columns_of(task.measure(controller, episodes=row.episodes, **options))
        _check_training(row, controller)
    for name, now in figures.items():
        if not is_reproduced(row, name, now):
            digits, rerun = (FORMS[name].format(figure) for figure in (getattr(row, name), now))
            raise RunError(f"{place}: {name} is {digits}, a rerun gives {rerun}")


def _check_training(row: ResultRow, controller: Controller) -> None:
    """Refuse a row that says something else of how its policies were trained than they do."""
    run, is_of_suite = getattr(controller, "run", None), row.algorithm in algorithms()
    if run is None and not is_of_suite:
        return
    actual = {"seed": None, "steps": 0} if run is None else {"seed": run.config.seed, "steps": run.config.steps}
    if is_of_suite:
        actual |= {"algorithm": "" if run is None else run.config.recipe.name}
    for name, value in actual.items():
        if (claim := getattr(row, name)) != value:
            raise RunError(f"{name} is {claim}, but that of the policies {value}")
    if is_of_suite and row.steps != (budget := load_algorithm(row.algorithm).steps(load_task(row.task))):
        raise RunError(f"steps are {row.steps:,}, where '{row.algorithm}' has {budget:,}: give it another name")


def is_reproduced(row: ResultRow, name: str, now: float) -> bool:
    """Return whether a rerun gives a figure of a row."""
    value = getattr(row, name)
    allowed = HALF_A_DIGIT * last_digit(FORMS[name].format(value))
    if row.algorithm == "mpc":
        allowed = max(allowed, OTHER_VERTEX * max(abs(value), 1.0))
    return abs(now - value) <= allowed or (math.isnan(now) and math.isnan(value))


def last_digit(digits: str) -> float:
    """Return what one more in the last digit of a number adds.

    >>> last_digit("-15.405"), last_digit("1.5e+03")
    (0.001, 100.0)
    """
    digits, _, power = digits.partition("e")
    return 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))


def pretrained(id: str, folder: str | Path | None = None, *, results: str | Path = KEPT_RESULTS) -> Trained:
    """Return the policies of a row of the benchmark, as those of a trained run.

    >>> pretrained("copper_net-v0/exact_gradients/401").run.config.network  # doctest: +SKIP
    'copper_net'

    Its ``run`` is an ordinary run directory, which ``compare`` and ``evaluate`` take; critics in it are fresh ones.

    Args:
        id: ``TASK/ALGORITHM/SEED``.
        folder: new directory of the run; None: one that is removed when Python ends.
        results: table of results, beside which the weights are; the one that comes with the package unless another is
            given.

    Raises:
        CirlError: if there is no such row of a learner; it names the nearest.
        RunError: if the weights are missing, or others than the row's.
    """
    path = Path(results)
    rows = {row.id: row for row in read_rows(path) if row.seed is not None and row.weights and not row.variant}
    check_names("policy", [id], rows)
    row, weights = rows[id], path.parent / rows[id].weights
    if weights.is_file() and sha256_of(weights) != row.sha256:
        raise RunError(f"{weights}: is not the file of row '{id}' in {path}: another SHA-256")
    controller, _ = controller_of(load_task(row.task), row.algorithm, weights, None if folder is None else Path(folder))
    from cirl_marl.learners.interface import Trained  # it needs torch

    if not isinstance(controller, Trained):
        raise RunError(f"{weights}: holds no policies of learners")
    return controller
