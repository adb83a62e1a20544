"""A sweep on disk: what was asked for, a folder for each cell, and the table of results.

::

    SWEEP/
      asked.json       networks, recipes, options, seeds and evaluation, as resolved; the names of the cells
      cells/CELL/      cell.json: what it is; run/: its training; result.json: there when it is done
      bounds/          what is proved of each network, for the gaps that are shown meanwhile
      jobs/            CELL.log, CELL.json: what its last worker said, and how far it was; locks
      sweep.csv        a row for each cell
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock

from cirl_marl.errors import RunError
from cirl_marl.jobs.work import JobFiles
from cirl_marl.records.files import PARTIAL, read_record, refuse_links, write_json, write_table
from cirl_marl.sweeps.cells import Cell
from cirl_marl.sweeps.reading import SweepFile, SweepOptions

INTERVALS = ("circularity", "service", "gap")
MISMATCHES_SHOWN = 5
"""Differences between two sweeps that are named."""


@dataclass(frozen=True, slots=True)
class SweepFolder:
    """The folder of a sweep."""

    path: Path

    def claim(self, request: SweepFile, cells: Sequence[Cell]) -> None:
        """Say what the folder is for, if it is new, or was for a part of this sweep.

        Raises:
            RunError: if the folder holds another sweep, with what differs, or something else.
        """
        if self.path.exists() and not self.path.is_dir():
            raise RunError(f"{self.path}: is a file, not a folder")
        if self.path.is_dir() and not self._request_path.is_file() and any(self._strangers()):
            stored = ", ".join(sorted(self._strangers())[:MISMATCHES_SHOWN])
            raise RunError(f"{self.path}: holds something else than a sweep ({stored}); choose another folder")
        refuse_links(self.path)
        now = self._description(request, cells)
        self.path.mkdir(parents=True, exist_ok=True)
        with self._lock():
            if self._request_path.is_file():
                self._check(now, self._stored_request())
            for cell in cells:
                file = self.cell(cell.name) / "cell.json"
                if file.is_file() and read_record(file) != json.loads(json.dumps(cell.content)):
                    raise RunError(f"{file}: is not what the cell of this name is")
                if not file.is_file():
                    file.parent.mkdir(parents=True, exist_ok=True)
                    write_json(file, cell.content)
            write_json(self._request_path, now)

    def cell(self, name: str) -> Path:
        """Return the folder of a cell."""
        return self.path / "cells" / name

    @property
    def bounds(self) -> Path:
        """The folder of what is proved of the networks."""
        return self.path / "bounds"

    @property
    def jobs(self) -> Path:
        """The folder of what workers said."""
        return self.path / "jobs"

    @property
    def table(self) -> Path:
        """The table of results."""
        return self.path / "sweep.csv"

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each cell: what it is, and its figures with their 95 % intervals, None where not known."""
        return [self.row(name) for name in self._stored_request()["cells"]]

    def write_table(self) -> list[dict[str, Any]]:
        """Write the table of results, and return its rows; whoever comes last has seen the results of all."""
        with self._lock():
            rows = self.rows()
            write_table(self.table, list(rows[0]), ([row[key] for key in rows[0]] for row in rows))
        return rows

    def _lock(self) -> FileLock:
        """Return the lock of whoever writes what is not of one cell."""
        return FileLock(self.path / ".asked.lock")

    def row(self, name: str) -> dict[str, Any]:
        """Return the row of a cell."""
        content = read_record(self.cell(name) / "cell.json")
        run, environment = content["recipe"]["run"], content["recipe"]["environment"]
        file = self.cell(name) / "result.json"
        result = _result(file) if file.is_file() else {}
        row: dict[str, Any] = {"cell": name, "state": "done" if result else "missing"}
        row |= {key: content[key] for key in ("network", "scenario")}
        row |= {"recipe": content["recipe"]["name"], "seed": content["seed"]}
        row |= {key: run[key] for key in ("steps", "envs", "engine", "min_service")}
        row |= {column: environment.get(key) for key, column in _ENVIRONMENT.items()}
        for figure in INTERVALS:
            interval = result.get(figure) or {}
            row |= {figure: interval.get("value")} | {f"{figure}_{end}": interval.get(end) for end in ("low", "high")}
        row |= {key: result.get(key) or None for key in ("unit", "no_bound", "checkpoint")}
        return row | {"cpu_seconds": JobFiles(self.jobs, name).figures().get("cpu_seconds")}

    @property
    def _request_path(self) -> Path:
        return self.path / "asked.json"

    def _stored_request(self) -> dict[str, Any]:
        return read_record(self._request_path)

    def _strangers(self) -> Iterator[str]:
        names = {"cells", "bounds", "jobs", ".asked.lock"}
        return (name for name in os.listdir(self.path) if name not in names and not PARTIAL.match(name))

    def _description(self, request: SweepFile, cells: Sequence[Cell]) -> dict[str, Any]:
        """Return what is asked for as JSON has it."""
        plain = request.model_dump(mode="json")
        plain["options"] = {key: values for key, values in plain["options"].items() if values is not None}
        plain["networks"] = list(dict.fromkeys(cell.network for cell in cells))
        plain["definitions"] = {f"{cell.network}, {cell.scenario}": cell.definition_sha256 for cell in cells}
        plain["recipes"] = {cell.recipe.name: cell.recipe.model_dump(mode="json") for cell in cells}
        return {**plain, "cells": [cell.name for cell in cells]}

    def _check(self, now: dict[str, Any], content: dict[str, Any]) -> None:
        """Refuse to make another sweep of the one that is kept; one may add cells to it."""
        cells = content.get("cells")
        if not isinstance(cells, list) or not all(isinstance(cell, str) for cell in cells):
            raise RunError(f"{self._request_path}: is not what a sweep asks for: it names no cells")
        missing_cells = set(cells) - set(now["cells"])
        if not missing_cells and now["evaluation"] == content.get("evaluation"):
            return
        mismatches = [name for key in now if key != "cells" for name in _differences(now[key], content.get(key), key)]
        more = f" and {len(mismatches) - MISMATCHES_SHOWN} more" if len(mismatches) > MISMATCHES_SHOWN else ""
        other = f"holds another sweep ({'; '.join(mismatches[:MISMATCHES_SHOWN])}{more})"
        count = f"of which {len(missing_cells)} of {len(cells)} cells are none of this one"
        raise RunError(f"{self.path}: {other}, {count}; choose another folder. Nothing was changed")


_ENVIRONMENT = {key: key for key in ("reward", "observe", "countdown", "circularity_weight", "horizon", "uncertain")}
_ENVIRONMENT |= {"circularity": "circularity_in_reward"}  # circularity itself is a result
OPTION_COLUMNS = tuple(_ENVIRONMENT.get(name, name) for name in SweepOptions.model_fields)
"""Columns of the options of a sweep file, in its order."""


def _result(file: Path) -> dict[str, Any]:
    """Return what came of a cell; a ``RunError`` if the file is something else."""
    result = read_record(file)
    if not result:
        raise RunError(f"{file}: says nothing of what came of a cell; delete it to evaluate anew")
    for name in (*INTERVALS, "unit", "no_bound", "checkpoint"):
        value = result.get(name)
        fits = value is None or (
            isinstance(value, dict) and all(isinstance(part, int | float | None) for part in value.values())
            if name in INTERVALS
            else isinstance(value, str)
        )
        if not fits:
            raise RunError(f"{file}: is not what came of a cell: {name} is {value!r:.80}; delete it to evaluate anew")
    return result


def _differences(request: Any, content: Any, prefix: str) -> Iterator[str]:
    """Yield where two JSON values differ."""
    if isinstance(request, dict) and isinstance(content, dict):
        for key in dict.fromkeys((*request, *content)):
            yield from _differences(request.get(key), content.get(key), f"{prefix}.{key}")
    elif request != content:
        yield f"{prefix}: {json.dumps(request)}, there {json.dumps(content)}"
