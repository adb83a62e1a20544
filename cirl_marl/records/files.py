"""Writing that never leaves half a file: one file in one step, or a folder of files that belong together."""

from __future__ import annotations

import csv
import hashlib
import itertools
import json
import os
import platform
import re
import shutil
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cirl_marl.errors import RunError

LARGEST = 200_000_000
"""Bytes of the largest file that is read as a whole."""
PARTIAL = re.compile(r"\.partial-(?P<machine>[0-9a-f]{8})-(?P<process>\d+)-\d+")
"""Stem of a file or folder that is being written: on which machine, and by which process."""
_count = itertools.count()


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file, then put it in the place of ``path`` in one step."""
    temporary = _partial(path.parent, path.suffix)
    try:
        write(temporary)
        sync(temporary)
        temporary.replace(path)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error  # which file, and not its passing name
    finally:
        with suppress(OSError):  # it is not there any more, or never was, on a disk that cannot be written to
            temporary.unlink()


def _partial(folder: Path, suffix: str = "") -> Path:
    """Return a name that nobody else writes to, and remove what killed processes of this machine left behind."""
    machine = f"{zlib.crc32(platform.node().encode()):08x}"
    for path in folder.glob(".partial-*"):
        match = PARTIAL.match(path.name)
        if match and match["machine"] == machine and not _is_running(int(match["process"])):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
    return folder / f".partial-{machine}-{os.getpid()}-{next(_count)}{suffix}"


def _is_running(process: int) -> bool:
    if os.name == "nt":
        return True  # where signal 0 is Ctrl-C
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def sync(path: Path) -> None:
    """Have a file, or the names in a folder, on the disk before anything else is done."""
    if os.name == "nt" and path.is_dir():
        return  # Windows does not open folders
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_content(path: Path) -> bytes:
    """Return what is in a regular file.

    Raises:
        OSError: if it is missing, something that may never end, as a pipe or a device, or larger than ``LARGEST``.
    """
    size = path.stat().st_size
    if not path.is_file():
        raise OSError(f"'{path}' is no regular file")
    if size > LARGEST:
        raise OSError(f"'{path}' has {size / 1e6:.0f} MB, and at most {LARGEST // 10**6} MB are read")
    with path.open("rb") as file:
        return file.read(size)


def sha256_of(path: Path) -> str:
    """Return the hash of what is in a regular file; errors are those of ``read_content``."""
    return hashlib.sha256(read_content(path)).hexdigest()


def read_json(path: Path) -> Any:
    """Return what a JSON file says; a ``RunError`` if it cannot be read."""
    try:
        return json.loads(read_content(path))
    except (OSError, ValueError, RecursionError) as error:
        raise RunError(f"{path}: cannot be read: {error}") from error


def read_record(path: Path) -> dict[str, Any]:
    """Return what a JSON file says that holds an object; a ``RunError`` if it cannot be read, or is something else."""
    record = read_json(path)
    if not isinstance(record, dict):
        raise RunError(f"{path}: is no JSON object")
    return record


def write_json(path: Path, value: object) -> None:
    """Write JSON atomically."""
    write_atomically(path, lambda temporary: temporary.write_text(json.dumps(value, indent=2) + "\n"))


def refuse_links(folder: Path) -> None:
    """Refuse a folder below which a link stands, as nothing outside may be read or written, or a pipe or a device.

    Raises:
        RunError: naming it.
    """
    for parent, folders, files in os.walk(folder):
        for path in (Path(parent) / name for name in (*folders, *files)):
            if path.is_symlink():
                raise RunError(
                    f"{path}: is a link; nothing outside of {folder} is read or written, so put a copy there"
                )
        for path in (Path(parent) / name for name in files):
            if path.exists() and not path.is_file():
                raise RunError(f"{path}: is no file but a pipe, a socket or a device, which may never end")


@contextmanager
def publish_folder(folder: Path, last: str = "") -> Iterator[Path]:
    """Yield an empty folder; its files move to ``folder`` if all goes well, and are forgotten if not.

    The one called ``last``, which names the others, moves last.
    """
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    partial = _partial(folder)
    partial.mkdir()
    try:
        yield partial
        for file in sorted(partial.iterdir(), key=lambda file: (file.name == last, file.name)):
            os.replace(file, folder / file.name)
    finally:
        shutil.rmtree(partial)
        if is_new and not any(folder.iterdir()):
            folder.rmdir()


TableRows = Iterable[Sequence[object]]


def publish_result(
    folder: Path,
    tables: Mapping[str, tuple[Sequence[str], TableRows]],
    pictures: Mapping[str, Callable[[Path], object]],
    records: Mapping[str, object] = MappingProxyType({}),
) -> list[Path]:
    """Write the files of a result by name, all of them or none, and return their paths.

    They are CSV files of header and rows, then JSON files of ``records``, then what ``pictures`` draw.
    """
    with publish_folder(folder) as draft:
        for name, table in tables.items():
            write_table(draft / name, *table)
        for name, record in records.items():
            write_json(draft / name, record)
        for name, draw in pictures.items():
            draw(draft / name)
    return [folder / name for name in (*tables, *records, *pictures)]


def write_table(path: Path, header: Sequence[str], rows: TableRows) -> Path:
    """Write a CSV file atomically and return its path; None becomes an empty cell, and missing folders are made."""

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(["" if cell is None else cell for cell in row] for row in rows)

    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, write)
    return path
