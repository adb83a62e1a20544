"""Jobs in the queue of Slurm, by its own commands: ``sbatch`` puts them in, ``squeue`` and ``scontrol`` tell of them.

What is to be done goes to the node as a file in a private folder (mode 700) of this driver's, with its hash in the
script; what came of it is read from JSON alone. Nothing else of Slurm's is trusted to be there: accounting
(``sacct``) is asked only for a job that the controller has forgotten.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cirl_marl.errors import CirlError, RunError
from cirl_marl.jobs.work import EXIT_STOPPED, Work, last_line, text_lines

MINUTES = 24 * 60
"""Longest that a job may take unless something else is asked for; what is cut off goes on in another one."""
WARNING = 120
"""Seconds before its time limit at which a job is told to save what it has, or a quarter of a short limit."""
AGE = 2.0
"""Seconds for which an answer of the queue is used again."""
SILENCE = 600.0
"""Seconds without an answer of the controller after which it is given up."""
LIVE = {
    "PENDING", "RUNNING", "SUSPENDED", "COMPLETING", "CONFIGURING", "REQUEUED", "RESIZING", "SIGNALING", "STAGE_OUT",
}  # fmt: skip
"""States of a job that has not ended."""
CUT_OFF = {"TIMEOUT", "PREEMPTED", "NODE_FAIL", "BOOT_FAIL", "REQUEUE_FED", "DEADLINE"}
"""States of a job that was ended by Slurm, and whose work goes on in another one."""
SHORT = {"name": "job-name", "timeout_min": "time", "mem_gb": "mem"}
"""Names of settings that are not those of ``sbatch``."""


class Slurm:
    """The queue of Slurm."""

    def __init__(self, folder: Path, workers: int | None, settings: Mapping[str, str]) -> None:
        """Make the private folder of this driver in ``folder``, which all nodes must see.

        Args:
            folder: where the jobs' own files are.
            workers: jobs at a time; None leaves that to Slurm.
            settings: long options of ``sbatch``, such as ``partition``, with ``timeout_min`` and ``mem_gb`` beside.

        Raises:
            CirlError: if there is no Slurm here, or it does not take the settings.
        """
        options = sbatch_options(settings)
        _run(["sbatch", "--test-only", *options, "--wrap", "true"], settings_text(settings))
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = Path(tempfile.mkdtemp(prefix=".slurm-", dir=folder))  # mode 700
        self._options = options
        self._queue = Queue()
        self.workers = workers or 2**31
        self.description = f"{'all' if workers is None else workers} at a time in the queue of Slurm"

    def start(self, work: Work) -> SlurmJob:
        """Put a job into the queue."""
        payload, progress = pickle.dumps(work), _progress(work)
        file = self._folder / f"{hashlib.sha256(work.files.name.encode()).hexdigest()[:16]}-{time.monotonic_ns()}.pkl"
        file.write_bytes(payload)
        command = [sys.executable, "-m", "cirl_marl.jobs.worker", str(file), hashlib.sha256(payload).hexdigest()]
        script = f"#!/bin/sh\nexec {shlex.join(command)}\n"
        options = [*self._options, f"--output={file.with_suffix('.out')}", f"--chdir={work.directory}", "--parsable"]
        answer = _run(["sbatch", *options], "a job was not taken", script, {"OMP_NUM_THREADS": "1"} | os.environ)
        return SlurmJob(answer.strip().partition(";")[0], self._queue, work, file, progress)

    def close(self) -> None:
        """Remove the private folder, unless a job in the queue still needs it."""
        if not any(self._folder.glob("*.pkl")):
            shutil.rmtree(self._folder)


class SlurmJob:
    """A worker in a job of Slurm."""

    def __init__(self, number: str, queue: Queue, work: Work, file: Path, progress: tuple[Any, ...]) -> None:
        """Follow the job ``number``, whose work is in ``file``, and which began with ``progress``."""
        self._number, self._queue, self._work, self._file = number, queue, work, file
        self._progress = progress
        queue.follow(number)

    def end_state(self) -> str | None:
        """Say how the job ended, by what Slurm knows of it; what it cut off has ended orderly, and goes on."""
        state = self._queue.state(self._number)
        if state in LIVE:
            return None
        self._queue.forget(self._number)
        out = self._file.with_suffix(".out")
        words = last_line(out)
        for file in (self._file, out):
            file.unlink(missing_ok=True)
        if state in CUT_OFF or state == f"FAILED {EXIT_STOPPED}":
            if _progress(self._work) != self._progress:
                return ""
            return f"came no further in a whole job ({state}): give it more time, --slurm timeout_min=…"
        if state == "COMPLETED":
            return ""
        message = "ended, and Slurm does not say how" if state == "" else f"Slurm job {self._number}: {state}"
        return ": ".join(filter(None, [message, words]))

    def stop(self) -> None:
        """Have it save what it has, and end; out of the queue if it has not begun."""
        subprocess.run(["scancel", "--batch", "--signal=TERM", self._number], capture_output=True, check=False)
        subprocess.run(["scancel", "--state=PENDING", self._number], capture_output=True, check=False)


class Queue:
    """What Slurm says of the jobs that are followed; asked for all of them at a time, and not too often."""

    def __init__(self) -> None:
        """Follow nothing yet."""
        self._numbers: set[str] = set()
        self._live: dict[str, str] = {}
        self._last_query = -AGE
        self._last_answer = time.monotonic()

    def follow(self, number: str) -> None:
        """Follow a job that was put into the queue this moment."""
        self._numbers.add(number)
        self._live[number] = "PENDING"

    def forget(self, number: str) -> None:
        """Follow a job no longer."""
        self._numbers.discard(number)
        self._live.pop(number, None)

    def state(self, number: str) -> str:
        """Return the state of a job; with its exit code behind it if it failed, empty if Slurm knows it no longer.

        Raises:
            RunError: if the controller has not answered for a long time.
        """
        if time.monotonic() - self._last_query >= AGE:
            self._ask()
        return self._live[number] if number in self._live else self._end(number)

    def _ask(self) -> None:
        self._last_query = time.monotonic()
        # all of the user's: of a list of numbers squeue refuses to answer when it has forgotten a single one
        answer = _answer("squeue", "--noheader", "--me", "--states=all", "--format=%i %T")
        if answer.returncode:
            if self._last_query - self._last_answer > SILENCE:
                raise RunError(f"Slurm has not answered for {SILENCE:.0f} s: {answer.stderr.strip()}")
            return
        self._last_answer = self._last_query
        states = dict(line.split(maxsplit=1) for line in answer.stdout.splitlines())
        self._live = {number: states[number] for number in self._numbers & states.keys() if states[number] in LIVE}

    def _end(self, number: str) -> str:
        """Return how a job ended, by the controller while it remembers it, then by accounting if there is one."""
        answer = _answer("scontrol", "--oneliner", "show", "job", number)
        if not answer.returncode and (jobs := re.search(r"JobState=(\w+).* ExitCode=(\d+:\d+)", answer.stdout)):
            return _with_code(*jobs.groups())
        columns = "--format=State,ExitCode"
        answer = _answer("sacct", "--noheader", "--parsable2", "--allocations", columns, "--jobs", number)
        state, _, code = answer.stdout.strip().partition("|")
        return "" if answer.returncode or not state else _with_code(state.split()[0], code)


def sbatch_options(settings: Mapping[str, str]) -> list[str]:
    """Return options of ``sbatch``; names may begin with ``slurm_``, and have lower lines for hyphens.

    >>> sbatch_options({"slurm_partition": "long", "timeout_min": "90"})
    ['--job-name=cirl', '--cpus-per-task=1', '--time=90', '--partition=long', '--signal=B:TERM@120']

    Raises:
        CirlError: for a setting that is not a word, or one that this library sets itself.
    """
    options = {"job-name": "cirl", "cpus-per-task": "1", "time": f"{MINUTES}"}
    for name, value in settings.items():
        option = SHORT.get(name, name.removeprefix("slurm_").replace("_", "-"))
        if not re.fullmatch(r"[a-z][a-z-]*", option) or option in ("output", "chdir", "parsable", "wrap", "signal"):
            raise CirlError(f"--slurm {name}={value}: is no setting that can be given")
        options[option] = f"{value}G" if name == "mem_gb" else value
    minutes = options["time"]
    options["signal"] = f"B:TERM@{min(WARNING, 15 * int(minutes)) if minutes.isdigit() else WARNING}"
    return [f"--{name}={value}" for name, value in options.items()]


def _answer(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False)


def _run(command: Sequence[str], purpose: str, text: str = "", environment: Mapping[str, str] | None = None) -> str:
    try:
        answer = subprocess.run(command, input=text, capture_output=True, text=True, check=False, env=environment)
    except FileNotFoundError:
        raise CirlError(f"--on slurm: there is no Slurm here (no {command[0]}); use --on local") from None
    if answer.returncode:
        raise CirlError(f"{purpose}: Slurm says: {(text_lines(answer.stderr) or ['nothing'])[0]}")
    return answer.stdout


def settings_text(settings: Mapping[str, str]) -> str:
    """Return settings as they were given on the command line."""
    output = " ".join(f"{name}={value}" for name, value in settings.items())
    return f"--slurm {output}" if output else "--on slurm"


def _progress(work: Work) -> tuple[Any, ...]:
    figures = work.files.figures()
    return figures.get("what"), figures.get("done")


def _with_code(state: str, code: str) -> str:
    """Return a state, and of a failure the exit code or signal, which Slurm writes as ``code:signal``."""
    exit_code, _, signal = code.partition(":")
    return state if state != "FAILED" else f"FAILED by signal {signal}" if signal != "0" else f"FAILED {exit_code}"
