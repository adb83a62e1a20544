"""Jobs of the tests of jobs: each writes a file, and some do other things first. Workers import them from here."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from cirl_marl.jobs import Tell


@dataclass(frozen=True)
class Written:
    """Writes how often it was begun into a file; before, it ``does`` something."""

    name: str
    file: Path
    does: str = ""

    def is_done(self) -> bool:
        """Return whether the file is there."""
        return self.file.is_file()

    def run(self, tell: Tell) -> None:
        """Write the file."""
        tell("writing", 1, 2)
        begun = self.file.with_suffix(".begun")
        with begun.open("a") as file:
            file.write(f"{os.getpid()}\n")
        if self.does == "raise":
            raise ValueError("paper is out")
        if self.does == "die":
            sys.stderr.write("the pen breaks\n")
            sys.stderr.flush()
            os.kill(os.getpid(), signal.SIGKILL)
        if self.does == "wait":
            time.sleep(300)
        if self.does == "count":  # to 100 seconds, over several workers
            counted = self.file.with_suffix(".counted")
            for second in range(int(counted.read_text()) if counted.is_file() else 0, 100):
                counted.write_text(str(second))
                tell(f"counting {second // 10}", second, 100)
                time.sleep(1)
        if self.does != "forget":
            self.file.write_text(str(len(begun.read_text().splitlines())))


def written(folder: Path, **does: str) -> list[Written]:
    """Return jobs ``a``, ``b`` and ``c``, of which some do other things first."""
    return [Written(name, folder / f"{name}.txt", does.get(name, "")) for name in "abc"]


@dataclass(frozen=True)
class Exploding:
    """Leaves a file behind when somebody unpickles it."""

    file: str

    def __reduce__(self) -> tuple[object, ...]:
        """Have the file made."""
        return Path.touch, (Path(self.file),)
