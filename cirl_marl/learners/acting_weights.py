"""What of a run is needed to act, as named arrays and a description, and the run that is rebuilt from them.

Critics, optimisers and what is known of rewards are left out: a run that is rebuilt acts to the same bits, and one that
starts from it begins with fresh critics.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cirl_marl.errors import RunError
from cirl_marl.learners import checkpoint
from cirl_marl.learners.checkpoint import CRITICS
from cirl_marl.learners.interface import create_run
from cirl_marl.learners.learner import acting_learner
from cirl_marl.learners.run_directory import RunConfig, RunDirectory
from cirl_marl.network import Network

NORMALISER = "normaliser"


def acting_weights(run: RunDirectory) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays of the checkpoint that acts, ``LEARNER/PARAMETER``, and a description that is plain JSON.

    Raises:
        RunError: if the run is incomplete, or a file of it cannot be read.
    """
    arrays: dict[str, NDArray[Any]] = {}
    for group in run.groups():
        state = checkpoint.read_tree(run.acting_checkpoint, group.name)
        for name, tensor in state["policy"].items():
            if not name.startswith(CRITICS):
                arrays[f"{group.name}/{name}"] = tensor.numpy()
        observations = {} if state["normaliser"] is None else state["normaliser"]["observations"]
        for key, moments in observations.items():
            mean_and_variance = [np.asarray(moments[name]["values"]) for name in ("mean", "var")]
            arrays[f"{group.name}/{NORMALISER}.{key}"] = np.array(mean_and_variance)
    status, config = run.status, run.config.model_copy(update={"origins": {}})
    best = status["best"] or {"joint_steps": status["joint_steps"], "figures": {}}
    description = {"config": config.model_dump(mode="json"), "joint_steps": status["joint_steps"]}
    return arrays, description | {"best": {"joint_steps": best["joint_steps"], "figures": best["figures"]}}


def rebuild_run(
    directory: Path, arrays: Mapping[str, NDArray[Any]], description: Mapping[str, Any], network: Network
) -> RunDirectory:
    """Return a complete run in a new directory that acts as the one did of which the weights are.

    Raises:
        RunError: if arrays are missing, or do not fit the learners that are described.
    """
    try:
        config = RunConfig.model_validate(description["config"])
        best = description["best"]
        name = f"{best['joint_steps']:09d}-best"
        with create_run(directory, config, network) as run, torch.random.fork_rng():
            env = run.make_env(1)
            folder = run.begin_checkpoint(f"{name}.partial")
            for group in run.groups():
                learner = acting_learner(group, env)
                policy = learner.model.policy
                state = {
                    key: torch.from_numpy(np.array(arrays[f"{group.name}/{key}"]))
                    for key in policy.state_dict()
                    if not key.startswith(CRITICS)
                }
                policy.load_state_dict({**policy.state_dict(), **state})
                if learner.normaliser is not None:
                    moments = checkpoint.normaliser_state(learner.normaliser)
                    for key, statistics in moments["observations"].items():
                        mean, var = arrays[f"{group.name}/{NORMALISER}.{key}"].tolist()
                        statistics["mean"]["values"], statistics["var"]["values"] = mean, var
                    checkpoint.set_normaliser_state(learner.normaliser, moments, returns=False)
                learner.save(folder)
        folder.rename(folder.with_name(name))
        run.set_status("complete", best["joint_steps"], name, {"checkpoint": name, **best})
    except (RuntimeError, *checkpoint.UNREADABLE) as error:
        if isinstance(error, RunError):
            raise
        raise RunError(f"weights do not fit the learners that they describe: {error!r}") from error
    return run
