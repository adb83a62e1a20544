"""Trainings of every kind that are killed at random instants, taken up again, and compared with some that were not.

python tests/kill.py 100      # so many SIGKILLs, from a new seed, which is printed; a second number is the seed
"""

from __future__ import annotations

import multiprocessing
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from crowds import Shifts
from stable_baselines3 import A2C, PPO
from test_exact_resumption import CASES, files, recipe
from test_teams import PAIR, SMALL

import cirl_marl
from cirl_marl.learners.interface import resume, train
from cirl_marl.learners.run_directory import RunDirectory

EACH = 4
"""Kills of one training."""
TEAM = "environments of others"
"""A team by ``cirl_marl.independent``: it is saved whole or not at all, and its training begun anew."""
SAVES = 6
"""How often the team is saved."""


def begin_or_go_on(case: str, folder: Path) -> None:
    """Train a case, from its last checkpoint if there is one; save whenever it can be done."""
    if case == TEAM:
        train_team(folder)
    elif (folder / "config.json").is_file():
        resume(folder, checkpoint_every=0.01)
    else:
        settings, options = recipe(case)
        train("copper_net", settings, directory=folder, seed=3, checkpoint_every=0.01, **options)


def train_team(folder: Path) -> None:
    """Train a team, and save it now and then where that is not done yet."""
    team = cirl_marl.independent(lambda: Shifts(PAIR, 7), A2C, overrides={"whole": partial(PPO, **SMALL)}, num_envs=2)
    for number in range(SAVES):
        team.learn(64)
        if not (folder / str(number)).exists():
            team.save(folder / str(number))


def kept(case: str, folder: Path) -> dict[str, Any]:
    """Return all that a finished training leaves behind, but for times."""
    if case != TEAM:
        return files(folder)
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.glob("[0-9]/*")}


def progress(case: str, folder: Path) -> tuple[bool, bool]:
    """Return whether a training has saved something, and whether it has come to its end."""
    if case == TEAM:
        return any(folder.glob("[0-9]")), (folder / str(SAVES - 1)).exists()
    if not (folder / "config.json").is_file():
        return False, False
    status = RunDirectory(folder).status
    return status["checkpoint"] is not None, status["state"] == "complete"


def run_to_end(case: str, folder: Path) -> None:
    """Train in a process of its own, to the end."""
    process = in_child(case, folder)
    process.join()
    if process.exitcode:
        raise AssertionError(f"{case}: could not go on")


def in_child(case: str, folder: Path) -> Any:
    """Start a training in a process that has imported everything, so that kills fall into its training."""
    process = multiprocessing.get_context("fork").Process(target=begin_or_go_on, args=(case, folder))
    process.start()
    return process


def killed(case: str, folder: Path, draw: random.Random, lasts: float) -> Iterator[bool]:
    """Kill a training ``EACH`` times, and yield whether it had saved something; then let it end."""
    for _ in range(EACH):
        process = in_child(case, folder)
        time.sleep(draw.uniform(0.2, 1.0) * lasts)
        process.kill()
        process.join()
        has_saved, is_complete = progress(case, folder)
        if process.exitcode == -signal.SIGKILL:
            yield has_saved
        if is_complete:
            return
    run_to_end(case, folder)


def main(count: int, seed: int) -> None:
    """Kill ``count`` trainings, of every kind in turn, and say how many ended with other bits."""
    draw, kills, saved, other, cases = random.Random(seed), 0, 0, 0, list[str]()
    with tempfile.TemporaryDirectory() as scratch:
        for case in ("PPO", "SAC"):  # what is imported now is there in every child
            begin_or_go_on(case, Path(scratch) / case)
        while kills < count:
            if not cases:
                cases = [*CASES, TEAM]
                draw.shuffle(cases)
            case = cases.pop()
            whole, again = (Path(scratch) / name for name in ("whole", "again"))
            began = time.perf_counter()
            run_to_end(case, whole)
            lasts = time.perf_counter() - began
            for had in killed(case, again, draw, lasts):
                kills, saved = kills + 1, saved + had
            if not kept(case, whole) or kept(case, whole) != kept(case, again):
                other += 1
                sys.stdout.write(f"{case}, seed {seed}: other bits\n")
            for folder in (whole, again):
                shutil.rmtree(folder)
            sys.stdout.write(f"{kills} kills, {saved} after something was saved; {other} with other bits: {case}\n")
            sys.stdout.flush()
    sys.stdout.write(
        f"seed {seed}: {kills} kills, {saved} of them after something was saved; {other} with other bits\n"
    )


if __name__ == "__main__":
    chosen = int(sys.argv[2]) if len(sys.argv) > 2 else random.SystemRandom().randrange(10**6)
    main(int(sys.argv[1]), chosen)
