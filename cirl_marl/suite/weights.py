"""Weights of rows: one safetensors file each, with a description, from which whoever acted acts again."""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from cirl_marl.controllers.basic import Controller, Neutral
from cirl_marl.errors import RunError
from cirl_marl.optimum.blind import Replay
from cirl_marl.optimum.mpc import MPC
from cirl_marl.records.files import sha256_of, write_atomically
from cirl_marl.suite.tasks import BenchmarkTask, load_task

LARGEST_FILE = 64_000
"""Bytes of a file of weights, at most: policies of the suite are small."""
DESCRIPTION = "cirl_marl"
"""Key of the description among the metadata of a file, which is JSON."""


def write_weights(path: Path, arrays: Mapping[str, NDArray[Any]], description: Mapping[str, Any]) -> str:
    """Write a file, and return its SHA-256.

    Raises:
        RunError: if it is larger than ``LARGEST_FILE``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {DESCRIPTION: json.dumps(description, sort_keys=True)}
    write_atomically(path, lambda place: save_file(dict(arrays), place, metadata))
    if (size := path.stat().st_size) > LARGEST_FILE:
        path.unlink()
        raise RunError(f"{path}: would have {size:,} bytes, more than {LARGEST_FILE:,}; take smaller policies")
    return sha256_of(path)


def read_weights(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return arrays and description of a file; a ``RunError`` if it is missing or something else."""
    try:
        with safe_open(path, framework="numpy") as file:
            description = json.loads((file.metadata() or {})[DESCRIPTION])
            return {key: np.asarray(file.get_tensor(key)) for key in file.keys()}, description
    except FileNotFoundError:
        raise RunError(f"{path}: no such file of weights") from None
    except (OSError, KeyError, ValueError, SafetensorError) as error:
        raise RunError(f"{path}: is no file of weights: {error!r}") from error


def controller_of(
    task: BenchmarkTask, algorithm: str, path: Path | None, folder: Path | None = None
) -> tuple[Controller, dict[str, Any]]:
    """Return who acted in a row, and as options of the environment for which agents.

    Args:
        task: the task, or a variant of it.
        algorithm: name of the learner or controller.
        path: the file of weights; None if there is none.
        folder: where the run of a learner is rebuilt; None: where it is removed when Python ends.

    Raises:
        RunError: if the file is missing, damaged, or of other learners.
    """
    if path is None:
        return Neutral(), {}
    arrays, description = read_weights(path)
    try:
        if "actions" in arrays:
            return Replay(arrays["actions"].astype(np.float64)), {}
        if "margin" in description:
            window = {"horizon": description["horizon"], "margin": np.asarray(description["margin"], dtype=float)}
            return MPC(min_service=task.min_service, **window), {}
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{path}: is not what {algorithm} acts by: {error!r}") from error
    from cirl_marl.learners.acting_weights import rebuild_run  # it needs torch
    from cirl_marl.learners.interface import Trained

    if folder is None:
        folder = Path(tempfile.mkdtemp(prefix="cirl_marl-")) / f"{task.name}-{algorithm}"
        atexit.register(shutil.rmtree, folder.parent, ignore_errors=True)
    try:
        run = rebuild_run(folder, arrays, description, load_task(task.name).network())
    except RunError as error:
        raise RunError(f"{path}: {error}") from error
    return Trained(run), {"agents": run.config.agents}
