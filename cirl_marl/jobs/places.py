"""Where jobs are done: ``here`` in this process, ``local`` on the cores of this machine, ``slurm``, ``ray``."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Protocol

from cirl_marl.errors import CirlError, check_names, optional_module, whole_number
from cirl_marl.jobs.slurm import Slurm, sbatch_options, settings_text
from cirl_marl.jobs.work import Work, text_lines


class Worker(Protocol):
    """Somebody who works on a job."""

    def end_state(self) -> str | None:
        """Return None while at work, an empty text after an orderly end, and how it ended if it did otherwise."""

    def stop(self) -> None:
        """Ask for the end; what was learnt is saved first, if that can be done."""


class Workplace(Protocol):
    """Where jobs are done. ``workers`` work at a time, and ``description`` tells the user where that is."""

    workers: int
    description: str

    def start(self, work: Work) -> Worker:
        """Have a job done."""

    def close(self) -> None:
        """Clear away what the place needed beside the jobs' own files."""


def cores() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class LocalProcess:
    """A worker in a process of its own on this machine."""

    def __init__(self, work: Work) -> None:
        """Start it."""
        self._process: BaseProcess = get_context("spawn").Process(target=_in_process, args=(work,))
        with _one_thread():
            self._process.start()

    def end_state(self) -> str | None:
        """Say how the process ended."""
        code = self._process.exitcode
        if code is None or code == 0:
            return None if code is None else ""
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"

    def stop(self) -> None:
        """Send SIGTERM, at which trainings are saved."""
        self._process.terminate()


class Local:
    """The cores of this machine, a process for each job, so that nothing but its job dies with a worker."""

    def __init__(self, workers: int | None) -> None:
        """Take all cores if no number of ``workers`` is given."""
        self.workers = workers or cores()
        self.description = f"{self.workers} at a time on this machine"

    def start(self, work: Work) -> LocalProcess:
        """Start a process."""
        return LocalProcess(work)

    def close(self) -> None:
        """Do nothing: a process leaves nothing behind."""


def _in_process(work: Work) -> None:
    """Do a job in this process, which ends when the one that started it is gone."""
    if hasattr(os, "setsid"):
        os.setsid()  # Ctrl-C is for the driver, which tells its workers
    parent = parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=follow, daemon=True).start()
    work()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let processes that are started in the block compute on one thread each, unless the user said otherwise."""
    before = "OMP_NUM_THREADS" in os.environ
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        yield
    finally:
        if not before:
            del os.environ["OMP_NUM_THREADS"]


class RayTask:
    """A worker in a task of Ray."""

    def __init__(self, ray: Any, reference: Any) -> None:
        """Follow a task."""
        self._ray, self._reference = ray, reference

    def end_state(self) -> str | None:
        """Say how the task ended, by what Ray knows of it."""
        ready, _ = self._ray.wait([self._reference], timeout=0)
        if not ready:
            return None
        try:
            self._ray.get(self._reference)
        except Exception as error:  # whatever the job raised, and Ray's own
            return _last_line(error)
        return ""

    def stop(self) -> None:
        """Interrupt it, at which trainings are saved."""
        self._ray.cancel(self._reference)


class Ray:
    """A cluster of Ray: that of RAY_ADDRESS, or a new one of the cores of this machine."""

    def __init__(self, workers: int | None) -> None:
        """Join or start the cluster.

        Raises:
            CirlError: if Ray is not installed, or there is no cluster at the address.
        """
        self._ray = _ray()
        if not self._ray.is_initialized():
            try:
                dashboard = False if not _address() else None
                self._ray.init(log_to_driver=False, logging_level="error", include_dashboard=dashboard)
            except (ConnectionError, ValueError) as error:
                raise CirlError(f"no Ray at RAY_ADDRESS={_address()}: {_last_line(error)}") from error
        processors = int(self._ray.cluster_resources().get("CPU", 1))
        self.workers = workers or processors
        self.description = f"{self.workers} at a time on the Ray cluster, which has {processors} processors"
        self._do = self._ray.remote(num_cpus=1, max_retries=0, max_calls=1)(_in_task)

    def start(self, work: Work) -> RayTask:
        """Start a task in a process of its own."""
        return RayTask(self._ray, self._do.remote(work))

    def close(self) -> None:
        """Do nothing: the cluster is the user's, or ends with this process."""


def _in_task(work: Work) -> bool:
    return work()


def _address() -> str:
    return os.environ.get("RAY_ADDRESS", "")


def _ray() -> Any:
    """Import Ray, or say that it is missing; the logs of a node that dies are left out of what it prints."""
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", "Raylet is terminated")  # read when it is imported
    return optional_module("ray", "--on ray needs the package ray, which is not installed", "ray")


def _last_line(error: BaseException) -> str:
    return (text_lines(str(error)) or [type(error).__name__])[-1]


PLACES: tuple[str, ...] = ("here", "local", "slurm", "ray")


def check_place(on: str, workers: int | None = None, settings: Mapping[str, str] | None = None) -> None:
    """Refuse a place that cannot be, before anything is begun.

    Raises:
        CirlError: for an unknown place, workers or settings that it does not take, or a package that is missing.
    """
    check_names("place", [on], PLACES)
    if settings and on != "slurm":
        raise CirlError(f"{settings_text(settings)}: goes with --on slurm, not with --on {on}")
    if workers is not None:
        whole_number("workers", workers, 1)
    if on == "here" and workers not in (None, 1):
        raise CirlError(f"in this process there is one worker, not {workers}; use --on local")
    if on == "slurm":
        sbatch_options(settings or {})
    if on == "ray":
        _ray()


def place_of(on: str, folder: Path, workers: int | None, settings: Mapping[str, str]) -> Workplace | None:
    """Return a place by its name; None is this process.

    Raises:
        CirlError: if ``check_place`` refuses it, Slurm its settings, or there is no Slurm or Ray where there should be.
    """
    check_place(on, workers, settings)
    makers: dict[str, Callable[[], Workplace]] = {
        "local": lambda: Local(workers),
        "slurm": lambda: Slurm(folder, workers, settings),
        "ray": lambda: Ray(workers),
    }
    return makers[on]() if on in makers else None
