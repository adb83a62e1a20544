"""Trainings of every kind that are killed at random instants, taken up again, and compared with some that were not.

python tests/kill.py 100      # so many SIGKILLs, from a new seed, which is printed; a second number is the seed
"""

from __future__ import annotations

import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from test_exact_resumption import CASES, files, recipe

from cirl_marl.learners.interface import resume, train
from cirl_marl.learners.run_directory import RunDirectory

EACH = 5
"""Kills of one training."""


def begin_or_go_on(case: str, folder: Path) -> None:
    """Train a case, from its last checkpoint if there is one; save whenever it can be done."""
    if (folder / "config.json").is_file():
        resume(folder, checkpoint_every=0.01)
        return
    found, options = recipe(case)
    train("copper_net", found, directory=folder, seed=3, checkpoint_every=0.01, **options)


def killed(case: str, folder: Path, draw: random.Random, lasts: float) -> Iterator[bool]:
    """Kill a training ``EACH`` times, and yield whether it had saved something; then let it end."""
    command = [sys.executable, __file__, "--train", case, str(folder)]
    for _ in range(EACH):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        time.sleep(draw.uniform(0.3, 1.0) * lasts)
        process.kill()
        process.wait()
        begun = (folder / "config.json").is_file()
        yield begun and RunDirectory(folder).status["checkpoint"] is not None
        if begun and RunDirectory(folder).status["state"] == "complete":
            return
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise AssertionError(f"{case}: could not go on: {done.stderr}")


def main(count: int, seed: int) -> None:
    """Kill ``count`` trainings, and say how many ended with other bits."""
    draw, kills, saved, other = random.Random(seed), 0, 0, 0
    with tempfile.TemporaryDirectory() as scratch:
        while kills < count:
            case = draw.choice(list(CASES))
            whole, again = (Path(scratch) / name for name in ("whole", "again"))
            began = time.perf_counter()
            subprocess.run([sys.executable, __file__, "--train", case, str(whole)], check=True, capture_output=True)
            lasts = time.perf_counter() - began
            for had in killed(case, again, draw, lasts):
                kills, saved = kills + 1, saved + had
            if files(whole) != files(again):
                other += 1
                sys.stdout.write(f"{case}, seed {seed}: other bits\n")
            for folder in (whole, again):
                shutil.rmtree(folder)
    sys.stdout.write(f"{kills} kills, {saved} of them after something was saved; {other} trainings with other bits\n")


if __name__ == "__main__":
    if sys.argv[1] == "--train":
        begin_or_go_on(sys.argv[2], Path(sys.argv[3]))
    else:
        chosen = int(sys.argv[2]) if len(sys.argv) > 2 else random.SystemRandom().randrange(10**6)
        main(int(sys.argv[1]), chosen)
