"""What happens where a job is done: it is claimed, what it says goes into its log, and it tells how far it is."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from filelock import FileLock, Timeout

from cirl_marl.definitions.code_permission import code_allowed
from cirl_marl.errors import RunError
from cirl_marl.records.files import write_json

APART = 1.0
"""Seconds between two reports of a job."""
EXIT_STOPPED = 75
"""Exit code of a worker that was told to stop, and whose work goes on in another one."""


class Tell(Protocol):
    """Takes what a job is doing, how much of it is done, and figures that are known so far."""

    def __call__(
        self, activity: str, done: float, total: float, figures: Callable[[], Mapping[str, Any]] = lambda: {}
    ) -> None:
        """Say how far the job is; it may be called as often as one likes, and asks for ``figures`` now and then."""


class Job(Protocol):
    """Work that is done once. It is sent as it is to where it is done, so it must be importable there."""

    @property
    def name(self) -> str:
        """What it is called in messages and files; no other job in the same folder has this name."""

    def is_done(self) -> bool:
        """Return whether nothing is left to do."""

    def run(self, tell: Tell) -> None:
        """Do what is left. It may be killed at any instant, and begun again."""


@dataclass(frozen=True, slots=True)
class JobFiles:
    """Where a job keeps what it says and how far it is, and by which lock it is claimed."""

    folder: Path
    name: str

    @property
    def log(self) -> Path:
        """What the last who worked on it said."""
        return self.folder / f"{self.name}.log"

    @property
    def progress_file(self) -> Path:
        """How far it is."""
        return self.folder / f"{self.name}.json"

    def lock(self) -> FileLock:
        """Return the lock that whoever works on it holds; the system frees it when a process dies."""
        return FileLock(self.folder / f".{self.name}.lock", blocking=False)

    def is_claimed(self) -> bool:
        """Return whether somebody works on it at the moment."""
        try:
            with self.lock():
                return False
        except Timeout:
            return True

    def figures(self) -> dict[str, Any]:
        """Return what was told last; empty if nothing was.

        Raises:
            RunError: if the file is something else than what a job tells.
        """
        try:
            content = json.loads(self.progress_file.read_text())
        except FileNotFoundError:
            return {}
        except ValueError as error:
            raise RunError(f"{self.progress_file}: is not what a job told: {error}") from error
        numbers = ("done", "total", "cpu_seconds")
        if not isinstance(content, dict) or any(type(content.get(name, 0)) not in (int, float) for name in numbers):
            raise RunError(f"{self.progress_file}: is not what a job told: {content!r:.80}")
        return content

    def last_words(self) -> str:
        """Return the last line of the log; empty if there is none."""
        lines = text_lines(self.log.read_text(errors="replace")) if self.log.is_file() else []
        return lines[-1] if lines else ""


@dataclass(frozen=True, slots=True)
class Work:
    """A job on its way: it is called where it is done, in a process that may know nothing of who sent it.

    Attributes:
        directory: the working directory, from which relative paths count.
        allow_code: whether definitions may import the models that they name.
    """

    job: Job
    files: JobFiles
    directory: str
    allow_code: bool

    def __call__(self) -> bool:
        """Do the job in a process of its own.

        Returns:
            Whether it was done; if not, somebody else works on it.
        """
        os.chdir(self.directory)
        try:
            with self.files.lock(), _redirect_output(self.files.log):
                with code_allowed(self.allow_code):
                    do(self.job, self.files, lambda: None)
        except Timeout:
            return False
        return True


def do(job: Job, files: JobFiles, listen: Callable[[], None]) -> None:
    """Do a job that is claimed, and ``listen`` whenever it has told how far it is.

    Raises:
        Exception: what the job raised, when it is in the log and among what was told.
    """
    progress = files.figures()
    earlier, began, last = float(progress.get("cpu_seconds", 0.0)), time.process_time(), -APART

    def tell(activity: str, done: float, total: float, figures: Callable[[], Mapping[str, Any]] = lambda: {}) -> None:
        nonlocal last, progress
        if activity == progress.get("what") and time.monotonic() - last < APART:
            return
        last = time.monotonic()
        now = {"what": activity, "done": done, "total": total, "said": "", "host": platform.node(), "pid": os.getpid()}
        progress = {**progress, **figures(), **now, "cpu_seconds": earlier + time.process_time() - began}
        write_json(files.progress_file, progress)
        listen()

    try:
        tell("beginning", 0, 1)
        if not job.is_done():
            job.run(tell)
        if not job.is_done():
            raise RunError(f"{job.name}: came to its end without being done")
        tell("done", 1, 1)
    except Exception as error:
        write_json(files.progress_file, progress | {"said": f"{type(error).__name__}: {error}"})
        raise


def text_lines(text: str) -> list[str]:
    """Return the lines of a text in which something stands."""
    return [line.strip() for line in text.splitlines() if line.strip()]


@contextmanager
def _redirect_output(log: Path) -> Iterator[None]:
    """Let all that this process says, also from outside of Python, stand in its log."""
    with log.open("w", buffering=1) as file:
        for stream, descriptor in ((sys.stdout, 1), (sys.stderr, 2)):
            with contextlib.suppress(ValueError):  # it is closed
                stream.flush()
            os.dup2(file.fileno(), descriptor)
        try:
            yield
        except BaseException:
            file.write(traceback.format_exc())
            raise
