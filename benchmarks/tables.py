"""What reading a table costs: processor time, as a multiple of that of Python's ``csv.reader`` on the same file.

``python -m benchmarks.tables`` writes tables of flows of 4 and 131 MB, reads each by ``csv.reader``, which keeps
nothing, as a table of flows and as a data file of a definition, in turn, prints the ratio of the medians, and ends with
code 1 if that of the small one is above its limit.
"""

from __future__ import annotations

import csv
import statistics
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from cirl_marl.definitions.data_files import DataFiles
from cirl_marl.importing.flow_table import read_flows

LIMIT = 5.0
"""Largest ratio of the small file."""
SIZES = {4: (25, 9), 131: (800, 1)}
"""Regions, and how often a file is read, by its megabytes."""


def write_flows(path: Path, regions: int) -> None:
    """Write a table of flows of 40 pairs of processes in 70 years of so many regions."""
    draw = np.random.default_rng(0)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["source", "target", "type", "region", "year", "value", "unit"])
        for region in range(regions):
            for year in range(1950, 2020):
                values = draw.uniform(0.0, 100.0, 40)
                rows = ((f"process {k}", f"process {k + 1}", "", f"region {region}", year) for k in range(40))
                writer.writerows([*row, f"{value:.6f}", "kt/year"] for row, value in zip(rows, values, strict=True))


def read_plainly(path: Path) -> None:
    """Read a file by ``csv.reader``, and keep nothing."""
    with path.open(newline="", encoding="utf-8") as file:
        deque(csv.reader(file), maxlen=0)


def read_data(path: Path) -> None:
    """Read a file as one of a definition."""
    conditions = {"source": "process 0", "region": "region 0"}
    assert len(DataFiles(path.parent).column(path.name, "value", conditions, None).values) == 70


READERS: dict[str, Callable[[Path], object]] = {
    "csv.reader": read_plainly,
    "table of flows": read_flows,
    "data file": read_data,
}


def seconds(read: Callable[[Path], object], path: Path) -> float:
    """Return the processor time of reading a file."""
    began = time.process_time()
    read(path)
    return time.process_time() - began


def main() -> int:
    """Print the ratios."""
    highest = 0.0
    with TemporaryDirectory() as folder:
        for size, (regions, runs) in SIZES.items():
            write_flows(path := Path(folder) / f"flows{size}.csv", regions)
            times = [[seconds(read, path) for read in READERS.values()] for _ in range(runs)]
            reference, *others = (statistics.median(column) for column in zip(*times, strict=True))
            for name, time_ in zip(list(READERS)[1:], others, strict=True):
                ratio = time_ / reference
                highest = max(highest, ratio) if size == min(SIZES) else highest
                label = f"{name}, {path.stat().st_size / 1e6:.0f} MB"
                sys.stdout.write(f"{label:24} {ratio:5.1f} x  ({time_:.2f} s, csv.reader {reference:.2f} s)\n")
    return int(highest > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
