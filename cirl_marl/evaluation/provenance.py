"""What a result depends on: command, versions, network and runs."""

from __future__ import annotations

import hashlib
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cirl_marl.definitions.writing import fingerprint
from cirl_marl.learners.run import RunDirectory
from cirl_marl.network import Network
from cirl_marl.records.machine import versions


def provenance(network: Network, runs: Sequence[RunDirectory] = (), **options: Any) -> dict[str, Any]:
    """Return what a result depends on, ready for JSON: network, training runs, and what else was asked for."""
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
