"""Trainings of every kind that are killed at random instants, taken up again, and compared with some that were not.

python tests/kill.py 100           # so many SIGKILLs, from a new seed, which is printed; a second number is the seed
python tests/kill.py 20 7 commands # SIGKILLs and Ctrl-C in turn, so many in all, of commands that write something
"""

from __future__ import annotations

import multiprocessing
import os
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

from command import guide
from crowds import Shifts
from stable_baselines3 import A2C, PPO
from test_exact_resumption import CASES, files, recipe
from test_import import cycle, table
from test_teams import PAIR, SMALL

import cirl_marl
from cirl_marl.cli import main as command_line
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


TRAIN = "train bottles.toml --recipe quick.toml --out run"
COMMANDS = {
    "import flows.csv --out metal.toml --reservoir Ore* --landfill Dump*": "",
    "plan bottles.toml --control optimum --out plan.csv": "",
    "simulate bottles.toml --control neutral --out simulated": "",
    "pareto bottles.toml --points 3 --episodes 4 --out front": "",
    "sweep sweep.toml --on here --out swept": "",
    "compare run --controllers optimum --episodes 4 --out compared": TRAIN,
    "report run --html page.html": TRAIN,
    "export run --out exported": TRAIN,
}
"""Commands that write something, and what has to be there before."""
TIMED = ("swept", ".xlsx", ".zip", "episodes.csv", "summary")
"""Parts of the names of files in which times stand."""
RECIPE = """name = "quick"\ntitle = "quick"\nrun = { steps = 200, envs = 2, evaluations = 2, episodes = 4 }
[learner]\nalgorithm = "A2C"\nparameters = { n_steps = 5, policy_kwargs = { net_arch = [4] } }
"""
SWEEP = 'networks = ["bottles.toml"]\nrecipes = ["quick.toml"]\nseeds = [0, 1]\n[evaluation]\nepisodes = 4\n'


def run_command(command: str, folder: Path) -> None:
    """Run a command in a process group of its own; what it says goes to a file beside the folder."""
    os.setpgrp()
    os.chdir(folder)
    output = os.open(folder.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for descriptor in (1, 2):
        os.dup2(output, descriptor)
    sys.argv = ["cirl", *command.split()]
    command_line()


def contents(folder: Path) -> dict[str, bytes]:
    """Return what is in the files of a folder, but for runs, of which ``main`` takes care."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.relative_to(folder).parts[0] != "run")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def commands(count: int, seed: int) -> None:
    """Kill commands; what is there then was there before or is whole, and the same command again ends as it would have.

    Or it says that what it would write is there already, which is then whole.
    """
    draw, faults = random.Random(seed), 0
    fork = multiprocessing.get_context("fork").Process
    for number in range(count):
        command, first = draw.choice([*COMMANDS.items()])
        with tempfile.TemporaryDirectory() as scratch:
            whole, again = (Path(scratch) / name for name in ("whole", "again"))
            whole.mkdir()
            (whole / "bottles.toml").write_text(guide())
            (whole / "quick.toml").write_text(RECIPE)
            (whole / "sweep.toml").write_text(SWEEP)
            table(whole / "flows.csv", cycle())
            for step in filter(None, (first, command)):
                shutil.rmtree(again, ignore_errors=True)
                shutil.copytree(whole, again)
                began = time.perf_counter()
                process = fork(target=run_command, args=(step, whole))
                process.start()
                process.join()
                if process.exitcode:
                    raise AssertionError(f"{step}: {whole.with_suffix('.log').read_text()}")
            lasts, expected = time.perf_counter() - began, contents(whole)
            process = fork(target=run_command, args=(command, again))
            process.start()
            time.sleep(draw.uniform(0.05, 1.0) * lasts)
            os.kill(process.pid or 0, signal.SIGKILL if number % 2 else signal.SIGINT)
            process.join()
            left = contents(again)
            half = [
                name
                for name, content in left.items()
                if name in expected and content != expected[name] and not any(part in name for part in TIMED)
            ]
            last_words = again.with_suffix(".log").read_text()
            process = fork(target=run_command, args=(command, again))
            process.start()
            process.join()
            text, end = again.with_suffix(".log").read_text(), contents(again)
            is_fine = not half and "Traceback" not in last_words + text and end.keys() == expected.keys()
            is_fine &= process.exitcode == 0 or "exists" in text
            faults += not is_fine
            sys.stdout.write(f"{'ok' if is_fine else 'FAULT'}: {command}, {half or ''} {'' if is_fine else text}\n")
            sys.stdout.flush()
    sys.stdout.write(f"seed {seed}: {count} commands killed, {faults} faults\n")


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
    (commands if "commands" in sys.argv else main)(int(sys.argv[1]), chosen)
