"""Results on disk: written whole or not at all, with everything that they depend on."""

from __future__ import annotations

import csv
import hashlib
import os
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from cirl_marl.learners.run import RunDirectory
from cirl_marl.machine import versions
from cirl_marl.network import Network
from cirl_marl.writing import definition_of


@contextmanager
def published(folder: Path) -> Iterator[Path]:
    """Yield an empty folder; its files move to ``folder`` if all goes well, and are forgotten if not."""
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=folder, prefix=".partial-"))
    try:
        yield partial
        for file in sorted(partial.iterdir()):
            os.replace(file, folder / file.name)
    finally:
        shutil.rmtree(partial)
        if made and not any(folder.iterdir()):
            folder.rmdir()


def write_table(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file; None becomes an empty cell."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(["" if cell is None else cell for cell in row] for row in rows)


def provenance(network: Network, runs: Sequence[RunDirectory] = (), **options: Any) -> dict[str, Any]:
    """Return what a result depends on, ready for JSON.

    Args:
        network: under its scenario.
        runs: training runs that it draws on.
        **options: what else was asked for.
    """
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "versions": versions(),
        "network": {
            "name": network.name,
            "scenario": network.scenario_name,
            "file_sha256": network.source_sha256,
            "definition_sha256": fingerprint(network),
        },
        "options": options,
        "runs": [_run(run) for run in runs],
    }


def fingerprint(network: Network) -> str:
    """Return a hash of the network under its scenario, of its definition with every default, its name as the title."""
    return _hash(definition_of(replace(network, title=network.name)).encode())


def _run(run: RunDirectory) -> dict[str, Any]:
    config, status = run.config, run.status
    return {
        "directory": str(run.path),
        "recipe": config.recipe.name,
        "seed": config.seed,
        "state": status["state"],
        "joint_steps": status["joint_steps"],
        "config_sha256": _hash((run.path / "config.json").read_bytes()),
        "network_sha256": _hash((run.path / "network.toml").read_bytes()),
        "policies_sha256": {
            group.name: _hash((run.checkpoint / f"{group.name}.zip").read_bytes()) for group in run.groups()
        },
    }


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
