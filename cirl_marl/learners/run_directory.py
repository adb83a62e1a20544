"""A training run on disk: what was asked for, how far it got, what was learnt. Nothing in it is ever half written.

::

    RUN/
      config.json          network, recipe, seed, steps, copies, options, as resolved
      network.toml         the definition that was trained on; network/network.toml, with its data files beside or
                           below it, if it has such
      versions.json        of Python and of every package that matters
      status.json          state, joint steps, the newest checkpoint and the best; rewritten last, atomically
      checkpoints/NNN/     LEARNER.json, LEARNER.safetensors: policy and normaliser, which act; an independent
                           learner has the name of its agent. LEARNER.state.*: all else that it goes on from,
                           LEARNER.journal.*: what came after that, training.*: the environment; price.json, if the
                           price of service moves
      evaluations.csv      one row an evaluation during training: λ̄, service, whether it was the best so far
      metrics.csv          one row an episode: λ̄, service level, return of each agent
      tensorboard/LEARNER/ learning curves of each learner
      evaluation.json      written by an evaluation
      .lock                claimed while a training has the run open
      pictures/
"""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any

from filelock import FileLock, Timeout
from pydantic import Field, StrictInt, ValidationError, field_validator

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.definitions.error_messages import validation_mistakes
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RunError, path_of, unknown_name
from cirl_marl.learners.recipe import OPTIONS, Group, Recipe, Settings
from cirl_marl.network import Network
from cirl_marl.records.files import PARTIAL as PARTIAL_FILE
from cirl_marl.records.files import (
    read_content,
    read_record,
    refuse_links,
    sha256_of,
    sync,
    write_atomically,
    write_json,
)
from cirl_marl.records.machine import versions

STATES = ("running", "complete", "interrupted", "failed")
CHECKPOINT = re.compile(r"\d{9,}-(start|running|interrupted|complete|best|failed)")
"""Names of checkpoints."""
LOCK = ".lock"
"""File that who trains keeps locked."""
BEFORE_CONFIG = re.compile(rf"network(\.toml)?|(versions|status)\.json|{PARTIAL_FILE.pattern}\.json")
"""What is in the directory of a run before its description is."""
PARTIAL = "next.partial"
"""Folder of a checkpoint that is being written."""
CHECKPOINTS_TO_KEEP = 3
"""Checkpoints that are kept, should the newest be damaged."""


class Origin(Settings):
    """From where a learner had its first policy: a checkpoint of another run, and the hashes of what was read."""

    run: str
    agent: str
    checkpoint: str
    sha256: dict[str, str]


class RunConfig(Settings):
    """What a run was asked to do, fully resolved.

    ``steps`` are environment steps, summed over the copies, of which there are ``envs``. Every random stream derives
    from ``seed``; ``options`` are those of ``MultiAgentVectorEnv``. Of a definition with regions, ``region`` is the one
    that was trained on; ``definition_sha256`` is the hash of the definition, ``data_sha256`` are those of the data
    files by the names that it gives them.
    ``origins`` say for each learner that had a start where that came from; going on with the run does not need it.
    """

    network: str
    scenario: str
    agents: tuple[str, ...]
    recipe: Recipe
    seed: StrictInt
    steps: StrictInt
    envs: StrictInt
    options: dict[str, Any]
    region: str = ""
    definition_sha256: str = ""
    data_sha256: dict[str, str] = Field(default_factory=dict)
    origins: dict[str, Origin] = Field(default_factory=dict)

    @field_validator("options")
    @classmethod
    def _are_known(cls, options: dict[str, Any]) -> dict[str, Any]:
        for name in options:
            if name not in OPTIONS:
                raise ValueError(unknown_name("option", name, OPTIONS))
        return options


class RunDirectory:
    """Reads and writes one run."""

    def __init__(self, path: str | Path) -> None:
        """Refer to the run in the directory ``path``; nothing is read or written yet."""
        self.path = path_of("run", path)

    @classmethod
    @contextmanager
    def create(cls, path: str | Path, config: RunConfig, definition: Path) -> Iterator[RunDirectory]:
        """Start a run in a new or empty directory, and yield it, locked from its first file on.

        Raises:
            RunError: if the directory already holds something, another process is at it, or the configuration cannot
                be written to a file.
        """
        run = cls(path)
        run._require_free()
        config = config.model_copy(update={"definition_sha256": sha256_of(definition)})
        try:
            plain = config.model_dump(mode="json")
            json.dumps(plain)
        except (TypeError, ValueError) as error:
            raise RunError(f"{run.path}: a run on disk needs a recipe of plain values: {error}") from error
        run.path.mkdir(parents=True, exist_ok=True)
        with run.lock():
            run._require_free()  # another process may have been faster
            for rest in run.path.iterdir():
                if rest.is_dir():
                    shutil.rmtree(rest)
                elif rest.name != LOCK:
                    rest.unlink()
            write_json(run.path / "versions.json", versions())  # the first: by it one knows what a crash left
            folder = run.path / "network" if config.data_sha256 else run.path
            data = {name: definition.parent / name for name in config.data_sha256}
            for name, source in {"network.toml": definition, **data}.items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, folder / name)
            run.set_status("running", 0, None)
            write_json(run.path / "config.json", plain)  # the last: with it the directory is a run
            yield run

    def _require_free(self) -> None:
        """Refuse a directory that holds more than what a crash left when a run was made: parts of it, no description.

        Raises:
            RunError: saying so.
        """
        if not self.path.exists():
            return
        is_free = self.path.is_dir()
        if is_free and (names := {entry.name for entry in self.path.iterdir()} - {LOCK}):
            is_ours = any(name == "versions.json" or PARTIAL_FILE.match(name) for name in names)
            is_free = is_ours and not self.path.is_symlink() and all(map(BEFORE_CONFIG.fullmatch, names))
        if not is_free:
            raise RunError(f"{self.path}: already exists and is not empty; choose another directory, or resume it")

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes from training this run at the same time; a ``RunError`` if one does."""
        lock = FileLock(self.path / LOCK, blocking=False)
        try:
            lock.acquire()
        except Timeout:
            raise RunError(f"{self.path}: is being trained by another process") from None
        try:
            yield
        finally:
            lock.release()

    @property
    def config(self) -> RunConfig:
        """The resolved configuration; a ``RunError`` if there is none, or a link that could lead out of the run."""
        refuse_links(self.path)
        plain = self._json("config.json")
        try:
            return RunConfig.model_validate(plain)
        except ValidationError as error:
            mistakes = "; ".join(validation_mistakes(error, RunConfig))
            raise RunError(f"{self.path / 'config.json'}: is not a run configuration: {mistakes}") from error

    @property
    def status(self) -> dict[str, Any]:
        """State, joint steps and checkpoint; a ``RunError`` if the file is missing or says something else."""
        status = self._json("status.json")
        fits = {"state", "joint_steps", "checkpoint"} <= set(status)
        fits = fits and status["state"] in STATES and type(status["joint_steps"]) is int and status["joint_steps"] >= 0
        fits = fits and isinstance(status["checkpoint"], str | None) and _is_best(status.setdefault("best", None))
        if fits and status["checkpoint"] is not None and CHECKPOINT.fullmatch(status["checkpoint"]):
            fits = status["joint_steps"] == steps_of(Path(status["checkpoint"]))
        if not fits:
            raise RunError(f"{self.path / 'status.json'}: is not the status of a run: {status!r}")
        return status

    def set_status(
        self, state: str, joint_steps: int, checkpoint: str | None, best: dict[str, Any] | None = None
    ) -> None:
        """Say how far the run got, and which checkpoint is the best; written atomically."""
        status = {"state": state, "joint_steps": joint_steps, "checkpoint": checkpoint, "best": best, "reason": ""}
        write_json(self.path / "status.json", status)

    def other_versions(self) -> list[str]:
        """Return of what the run began with other versions than there are now."""
        then, now = self._json("versions.json"), versions()
        return [f"{name} {then.get(name)}, now {now[name]}" for name in now if then.get(name) != now[name]]

    def reopen(self, config: RunConfig, checkpoint: Path | None) -> None:
        """Say that the run goes on from ``checkpoint``, to the steps of ``config``, which is its own but for these."""
        write_json(self.path / "config.json", config.model_dump(mode="json"))
        done, name = (0, None) if checkpoint is None else (steps_of(checkpoint), checkpoint.name)
        best: dict[str, Any] | None = None
        if checkpoint is not None and checkpoint.name.endswith("-complete"):
            best = self.status["best"]
        elif checkpoint is not None:
            best = _best_at(checkpoint)
        self.set_status("running", done, name, best)

    def stop(self, state: str, reason: str) -> None:
        """Say that the run ended early, with what was saved last."""
        shutil.rmtree(self._folder / PARTIAL, ignore_errors=True)
        self._update_status(state=state, reason=reason)

    def _update_status(self, **changes: Any) -> None:
        write_json(self.path / "status.json", {**self.status, **changes})

    @property
    def _folder(self) -> Path:
        return self.path / "checkpoints"

    @property
    def checkpoint(self) -> Path:
        """The newest complete checkpoint; a ``RunError`` if nothing was saved yet, or files of it are missing."""
        return self._checkpoint(self.status["checkpoint"])

    @property
    def acting_checkpoint(self) -> Path:
        """The checkpoint that acts: the best by evaluation, or the newest if none was evaluated; errors likewise."""
        status = self.status
        name = status["best"]["checkpoint"] if status["best"] is not None else status["checkpoint"]
        failures = [path.name for path in self._checkpoints() if path.name.endswith("-failed")]
        return self._checkpoint(failures[-1] if name is None and failures else name)

    def resumable(self) -> list[Path]:
        """Return the checkpoints from which the run can go on, the newest first."""
        newest = self.status["checkpoint"]
        if newest is None:
            return []
        _check_name(newest, self.path)
        older = [path for path in self._checkpoints() if path.name < newest and not _acts_only(path)]
        return [self._folder / newest, *reversed(older)]

    def _checkpoints(self) -> list[Path]:
        """Return the folders of checkpoints in the order of their steps; strangers among them are left alone."""
        return sorted(path for path in self._folder.glob("*") if CHECKPOINT.fullmatch(path.name) and path.is_dir())

    def _checkpoint(self, name: str | None) -> Path:
        if name is None:
            raise RunError(f"{self.path}: nothing was saved in this run yet (state: {self.status['state']})")
        _check_name(name, self.path)
        folder: Path = self._folder / name
        absentees = [group.name for group in self.groups() if not (folder / f"{group.name}.json").is_file()]
        if absentees:
            raise RunError(f"{folder}: the checkpoint lacks the policies of {', '.join(absentees)}")
        return folder

    def groups(self) -> tuple[Group, ...]:
        """Return the learners of the run."""
        config = self.config
        return config.recipe.groups(self.network(), config.agents)

    def network(self) -> Network:
        """Return the network that the run trained on, under its scenario.

        Raises:
            RunError: if a file of it is missing, or is not the one that it was trained with.
        """
        config = self.config
        files = {self._file(f"network/{_inside(name)}"): sha256 for name, sha256 in config.data_sha256.items()}
        if config.definition_sha256:
            files[self.definition] = config.definition_sha256
        for file, sha256 in files.items():
            if (actual := sha256_of(file)) != sha256:
                raise RunError(f"{file}: is not the file of this training, whose SHA-256 was {sha256}; it is {actual}")
        address = f"{self.definition}:{config.region}" if config.region else self.definition
        return load_network(address, scenario=config.scenario)

    @property
    def definition(self) -> Path:
        """The file of the network; a ``RunError`` if it is missing."""
        return self._file("network/network.toml" if self.config.data_sha256 else "network.toml")

    def make_env(self, num_envs: int, *, uncertain: bool | None = None) -> MultiAgentVectorEnv:
        """Return the environment that the run trained in, with ``num_envs`` copies.

        ``uncertain`` says whether uncertain numbers are drawn; None: if they were in the training.
        """
        config = self.config
        options = config.options if uncertain is None else {**config.options, "uncertain": uncertain}
        return MultiAgentVectorEnv(self.network(), num_envs=num_envs, agents=config.agents, **options)

    def begin_checkpoint(self, name: str = PARTIAL) -> Path:
        """Return an empty folder for a checkpoint, which counts when ``end_checkpoint`` is called."""
        partial = self._folder / name
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        return partial

    def end_checkpoint(self, partial: Path, joint_steps: int, state: str) -> None:
        """Let the checkpoint in the folder ``partial`` be the newest, and drop those that nobody needs any more."""
        name = f"{joint_steps:09d}-{state}"
        self._publish(partial, name)
        state = "running" if state == "start" else state
        self._update_status(state=state, joint_steps=joint_steps, checkpoint=name, reason="")
        self._drop()

    def save_best(self, joint_steps: int, write: Callable[[Path], None], figures: dict[str, float]) -> None:
        """Let ``write`` fill the checkpoint that acts from now on, and note the ``figures`` that it was chosen by."""
        name = self.save_policies(f"{joint_steps:09d}-best", write)
        self._update_status(best={"checkpoint": name, "joint_steps": joint_steps, "figures": figures})
        self._drop()

    def save_policies(self, name: str, write: Callable[[Path], None]) -> str:
        """Let ``write`` fill a checkpoint that acts, and from which no training goes on."""
        partial = self.begin_checkpoint(f"{name}.partial")
        write(partial)
        self._publish(partial, name)
        return name

    def _publish(self, partial: Path, name: str) -> None:
        """Give a folder its name when all of it is on the disk."""
        for path in (*partial.iterdir(), partial):
            sync(path)
        folder = partial.with_name(name)
        shutil.rmtree(folder, ignore_errors=True)
        partial.replace(folder)
        sync(folder.parent)

    def _drop(self) -> None:
        """Remove all checkpoints but the newest few, and the best ones to which they would go back."""
        status = self.status
        newest, checkpoints = status["checkpoint"] or "", self._checkpoints()
        resumable = [path for path in checkpoints if path.name <= newest and not _acts_only(path)]
        resumable = resumable[-1 if status["state"] == "complete" else -CHECKPOINTS_TO_KEEP :]
        to_keep = {path.name for path in resumable} | {newest, (status["best"] or {}).get("checkpoint")}
        to_keep |= {(_best_at(path) or {}).get("checkpoint") for path in resumable}
        after_crash = (path for path in self._folder.glob("*.partial") if CHECKPOINT.fullmatch(path.stem))
        for path in (*checkpoints, *after_crash):
            if path.name not in to_keep:
                shutil.rmtree(path)

    def metrics(self) -> dict[str, list[float]]:
        """Return the columns of ``metrics.csv``."""
        path = self._file("metrics.csv")
        try:
            header, *rows = _complete_rows(path)
            return {name: [float(row[i]) for row in rows] for i, name in enumerate(header)}
        except (ValueError, IndexError) as error:
            raise RunError(f"{path}: cannot be read: {error}") from error

    def evaluations(self) -> int:
        """Return how many evaluations there were during training."""
        return len(_complete_rows(self._file("evaluations.csv"))) - 1

    def _file(self, name: str) -> Path:
        path = self.path / name
        if not path.is_file():
            raise RunError(f"{path}: missing; the run directory is incomplete")
        return path

    def _json(self, name: str) -> dict[str, Any]:
        if not (self.path / "config.json").is_file():
            beside = sorted(str(config.parent) for config in self.path.parent.glob("*/config.json"))
            hint = f": {unknown_name('run', self.path, beside)}" if beside else ""
            raise RunError(f"no run in {self.path} (it has no config.json){hint}")
        return read_record(self._file(name))


def _complete_rows(path: Path) -> list[list[str]]:
    """Return the rows of a CSV file that end in a newline; a crash may have cut the last one short."""
    try:
        text = read_content(path).decode()
        return list(csv.reader(text[: text.rfind("\n") + 1].splitlines()))
    except (OSError, ValueError, csv.Error) as error:
        raise RunError(f"{path}: cannot be read: {error}") from error


def steps_of(checkpoint: Path) -> int:
    """Return the joint steps that are behind a checkpoint, which its name tells."""
    return int(checkpoint.name.partition("-")[0])


def _best_at(checkpoint: Path) -> dict[str, Any] | None:
    """Return which checkpoint was the best when one was written from which the run can go on."""
    path = checkpoint / "training.json"
    if not path.is_file():
        return None
    best: dict[str, Any] | None = read_record(path).get("best", {})
    if not _is_best(best):
        raise RunError(f"{path}: is not what a training wrote: best = {best!r}")
    return best


def _inside(name: str) -> str:
    """Return the name of a file below the run; a ``RunError`` if it leads out."""
    parts = PurePath(name).parts
    if not parts or ".." in parts or PurePath(name).is_absolute():
        raise RunError(f"data_sha256: {name!r} leads out of the run")
    return name


def _check_name(name: str, run: Path) -> None:
    if not CHECKPOINT.fullmatch(name):
        raise RunError(f"{run / 'status.json'}: {name!r} is no name of a checkpoint, such as 000000100-running")


def _acts_only(checkpoint: Path) -> bool:
    return checkpoint.name.endswith(("-best", "-failed"))


def _is_best(best: object) -> bool:
    """Return whether ``status.json`` says which checkpoint is the best, or that none is."""
    if best is None:
        return True
    fits = isinstance(best, dict) and set(best) == {"checkpoint", "joint_steps", "figures"}
    return fits and isinstance(best["checkpoint"], str) and isinstance(best["figures"], dict)  # type: ignore[index]


class TableFile:
    """A CSV file to which a training appends rows, the first column the joint step.

    Attributes:
        last: the last row that was there at the beginning, by column; empty if there was none.
    """

    def __init__(self, path: Path, columns: Sequence[str], done: int) -> None:
        """Open the file; rows past joint step ``done``, which a resumed run will repeat, are dropped."""
        try:
            rows = [row for row in _complete_rows(path)[1:] if float(row[0]) <= done] if path.is_file() else []
            self.last = dict(zip(columns, map(float, rows[-1]), strict=True)) if rows else {}
        except (ValueError, IndexError) as error:
            raise RunError(f"{path}: cannot be read: {error}") from error
        text = "".join(",".join(row) + "\n" for row in (columns, *rows))
        write_atomically(path, lambda temporary: temporary.write_text(text))
        self._path = path

    def append(self, row: Iterable[float]) -> None:
        """Write a row."""
        with self._path.open("a", newline="") as file:
            file.write(",".join(f"{value:.10g}" for value in row) + "\n")
