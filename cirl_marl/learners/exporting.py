"""Trained learners as files of Stable-Baselines3, for people who want them elsewhere. Nothing here reads such files."""

from __future__ import annotations

from pathlib import Path

from stable_baselines3.common.vec_env import VecNormalize

from cirl_marl.errors import RunError
from cirl_marl.learners.learner import Learner
from cirl_marl.learners.lockstep import wait
from cirl_marl.learners.run import RunDirectory
from cirl_marl.learners.seat import Seat
from cirl_marl.records.files import published


def export(run: str | Path | RunDirectory, folder: str | Path) -> list[Path]:
    """Write the policies that a run has chosen as ``LEARNER.zip``, and normalisers as ``LEARNER.normaliser.pkl``.

    ``stable_baselines3.PPO.load`` and ``VecNormalize.load`` read them, and run whatever code such files contain: load
    only what you wrote yourself. Optimisers and replay buffers are not in them.

    Raises:
        RunError: if the run is incomplete, or ``folder`` exists and is no folder.
    """
    found = run if isinstance(run, RunDirectory) else RunDirectory(run)
    if (target := Path(folder)).exists() and not target.is_dir():
        raise RunError(f"{target}: is no folder")
    env, written = found.make_env(found.config.envs), list[Path]()
    with published(target) as partial:
        for group in found.groups():
            learner = Learner(Seat(env, group.name, group.view(env), wait), group.spec, found.config.seed).build()
            learner.take(found.chosen).model.save(partial / f"{group.name}.zip")
            written.append(target / f"{group.name}.zip")
            if isinstance(learner.env, VecNormalize):
                learner.env.save(str(partial / f"{group.name}.normaliser.pkl"))
                written.append(target / f"{group.name}.normaliser.pkl")
    return written
