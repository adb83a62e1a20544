"""What happens where a job is done: it is claimed, what it says goes into its log, and it tells how far it is."""

from __future__ import annotations

import contextlib
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
from cirl_marl.records.files import read_record, write_json

APART = 1.0
"""Seconds between two reports of a job."""
MOST = 10**18
"""Largest whole number that a job tells."""
TEXTS = ("what", "said", "host")
"""What a job tells that is no number."""
TAIL = 2**16
"""Bytes at the end of a log in which its last line is looked for."""
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
        if not self.progress_file.exists():
            return {}
        content = read_record(self.progress_file)
        for name, value in content.items():
            number = value is None or isinstance(value, float) or (type(value) is int and abs(value) < MOST)
            if not (isinstance(value, str) if name in TEXTS else number):
                raise RunError(f"{self.progress_file}: is not what a job told: {name} is {value!r:.80}")
        done, total = content.get("done"), content.get("total")
        if content and not (done is not None and total is not None and 0 <= done < MOST and 0 < total < MOST):
            raise RunError(f"{self.progress_file}: is not what a job told: {done} is done of {total}")
        if content.get("cpu_seconds", 0.0) is None:
            raise RunError(f"{self.progress_file}: is not what a job told: cpu_seconds is None")
        return content


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


def last_line(file: Path) -> str:
    """Return the last line of a file in which something stands; empty if there is none, or no file."""
    if not file.is_file():
        return ""
    with file.open("rb") as content:
        content.seek(max(0, file.stat().st_size - TAIL))
        return (text_lines(content.read(TAIL).decode(errors="replace")) or [""])[-1]


def text_lines(text: str) -> list[str]:
    """Return the lines of a text in which something stands."""
    return [line.strip() for line in text.splitlines() if line.strip()]


@contextmanager
def _redirect_output(log: Path) -> Iterator[None]:
    """Let all that this process says, also from outside of Python, stand in its log."""
    log.unlink(missing_ok=True)  # were it another name of a file elsewhere, that would be emptied
    with log.open("x", buffering=1) as file:
        for stream, descriptor in ((sys.stdout, 1), (sys.stderr, 2)):
            with contextlib.suppress(ValueError):  # it is closed
                stream.flush()
            os.dup2(file.fileno(), descriptor)
        try:
            yield
        except BaseException:
            file.write(traceback.format_exc())
            raise
