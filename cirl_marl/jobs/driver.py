"""The driver: it has what is missing done, sees who is how far, and names who died."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from filelock import Timeout

from cirl_marl.definitions.code_permission import is_code_allowed
from cirl_marl.errors import CirlError, RunError
from cirl_marl.jobs.places import Worker, Workplace, place_of
from cirl_marl.jobs.work import Job, JobFiles, Work, do, last_line
from cirl_marl.records.files import refuse_links

JobState = Literal["waiting", "running", "elsewhere", "done", "failed"]
POLL, WATCH = 0.1, 1.0
"""Seconds between two looks at the workers, and between two calls of who watches."""
POLL_SECONDS = 0.002
"""Seconds more for every worker, so that thousands in a queue are not asked all the time."""
PATIENCE = 60.0
"""Seconds for workers that are told to stop to save what they have."""


@dataclass(frozen=True, slots=True)
class Failure:
    """A job that was not done: its name, in words why, and the exception if it was raised in this process."""

    name: str
    message: str
    log: Path
    error: Exception | None = None

    def __str__(self) -> str:
        """Say all of it in a line."""
        return f"{self.name}: {self.message}" + (f" (log: {self.log})" if self.log.is_file() else "")


@dataclass(frozen=True, slots=True)
class JobStatus:
    """How far a job is.

    Attributes:
        state: ``elsewhere`` is what another driver has claimed.
        figures: what the job told last, ``what`` it does and how much is ``done`` of a ``total`` among it.
    """

    name: str
    state: JobState
    figures: Mapping[str, Any]

    @property
    def share(self) -> float:
        """Share that is done of what it does at the moment, or of all if it is done."""
        return 1.0 if self.state == "done" else float(self.figures.get("done", 0)) / float(self.figures.get("total", 1))


Watch = Callable[[Sequence[JobStatus]], None]


def run_jobs(
    jobs: Sequence[Job],
    folder: Path,
    *,
    on: str = "here",
    workers: int | None = None,
    settings: Mapping[str, str] | None = None,
    watch: Watch = lambda statuses: None,
    say: Callable[[str], None] = lambda line: None,
) -> list[Failure]:
    """Do every job that is not done. One that fails, or whose worker dies, keeps no other from being done.

    Jobs that somebody else has claimed are waited for, and done here if they are left undone. Whoever is killed leaves
    nothing behind that would have to be cleared away: call this again.

    Args:
        jobs: with distinct names; they are begun in this order.
        folder: where logs, locks and what was told are kept.
        on: ``here`` (one after the other in this process), ``local``, ``slurm`` or ``ray``.
        workers: how many work at a time; None is all that the place has.
        settings: of ``sbatch``, for ``slurm``.
        watch: called with the status of every job, about once a second.
        say: called with where the jobs are done.

    Returns:
        The jobs that were not done, each with the reason.

    Raises:
        CirlError: if the place is unknown or cannot be used; nothing is begun then.
        RunError: if a link stands in ``folder``, or a file there is not what jobs write.
        KeyboardInterrupt: after Ctrl-C; workers are told to stop, and what they save is kept.
    """
    refuse_links(folder)
    place = place_of(on, folder, workers, settings or {})
    folder.mkdir(parents=True, exist_ok=True)
    if place is not None:
        say(place.description)
    driver = _Driver(jobs, folder, watch)
    try:
        while driver.goes_on(place):
            time.sleep(POLL + POLL_SECONDS * driver.at_work)
    finally:
        driver.stop()
        if place is not None:
            place.close()
    return driver.failures


def raise_first(failures: Sequence[Failure]) -> None:
    """Raise what the first of several jobs failed by, if any did.

    Raises:
        Exception: what it raised, if that was in this process.
        RunError: what it said, if not.
    """
    for failure in failures:
        raise failure.error or RunError(str(failure))


class _Driver:
    """What is waiting, who is at work, and what has failed."""

    def __init__(self, jobs: Sequence[Job], folder: Path, watch: Watch) -> None:
        self._files = {job.name: JobFiles(folder, job.name) for job in jobs}
        if len(self._files) != len(jobs):
            repeated = [name for name, count in Counter(job.name for job in jobs).items() if count > 1]
            raise CirlError(f"jobs must have distinct names; asked for more than once: {', '.join(repeated)}")
        self._states: dict[str, JobState] = {job.name: "done" if job.is_done() else "waiting" for job in jobs}
        self._queue = [job for job in jobs if self._states[job.name] == "waiting"]
        self._at_work: dict[str, tuple[Job, Worker]] = {}
        self._last_report: dict[str, Mapping[str, Any]] = {}
        self._watch, self._reported_at = watch, -WATCH
        self.failures: list[Failure] = []

    @property
    def at_work(self) -> int:
        """How many work at the moment."""
        return len(self._at_work)

    def goes_on(self, place: Workplace | None) -> bool:
        """Look after those at work, start others, and return whether anything is left to be done."""
        for job, worker in list(self._at_work.values()):
            if (state := worker.end_state()) is not None:
                self._take_back(job, state)
        for job in list(self._queue):
            if place is not None and len(self._at_work) >= place.workers:
                break
            if self._files[job.name].is_claimed():
                self._states[job.name] = "elsewhere"
            elif self._states[job.name] == "elsewhere" and job.is_done():
                self._settle(job, "done")
            elif place is None:
                self._do_here(job)
            else:
                self._queue.remove(job)
                self._states[job.name] = "running"
                self._last_report.pop(job.name, None)
                work = Work(job, self._files[job.name], os.getcwd(), is_code_allowed())
                self._at_work[job.name] = job, place.start(work)
        rest = bool(self._queue or self._at_work)
        self._look(at_once=not rest)
        return rest

    def stop(self) -> None:
        """Tell all who are at work to stop, and wait for what they save."""
        for _, worker in self._at_work.values():
            worker.stop()
        late = time.monotonic() + PATIENCE
        while any(worker.end_state() is None for _, worker in self._at_work.values()) and time.monotonic() < late:
            time.sleep(POLL)

    def _take_back(self, job: Job, state: str) -> None:
        """Note how a worker ended: the job is done, has failed, or was somebody else's."""
        del self._at_work[job.name]
        files = self._files[job.name]
        if job.is_done():
            self._settle(job, "done")
        elif not state:
            self._queue.append(job)
            self._states[job.name] = "elsewhere"
        else:
            message = files.figures().get("said") or ": ".join(
                filter(None, (state, last_line(files.log) or "it said nothing"))
            )
            self._settle(job, "failed", Failure(job.name, message, files.log))

    def _do_here(self, job: Job) -> None:
        """Do a job in this process, unless somebody was faster to claim it."""
        files = self._files[job.name]
        self._states[job.name] = "running"
        try:
            with files.lock():
                do(job, files, self._look)
        except Timeout:
            self._states[job.name] = "elsewhere"
        except Exception as error:  # of whatever kind: the others go on, and it is reported
            message = f"{type(error).__name__}: {error}"
            self._settle(job, "failed", Failure(job.name, message, files.log, error))
        else:
            self._settle(job, "done")

    def _settle(self, job: Job, state: JobState, failure: Failure | None = None) -> None:
        if job in self._queue:
            self._queue.remove(job)
        self._states[job.name] = state
        self._last_report.pop(job.name, None)
        if failure is not None:
            self.failures.append(failure)

    def _look(self, at_once: bool = False) -> None:
        """Call who watches, unless that was a moment ago."""
        if not at_once and time.monotonic() - self._reported_at < WATCH:
            return
        self._reported_at = time.monotonic()
        for name, state in self._states.items():
            if state in ("running", "elsewhere") or name not in self._last_report:
                self._last_report[name] = self._files[name].figures()
        self._watch([JobStatus(name, state, self._last_report[name]) for name, state in self._states.items()])
