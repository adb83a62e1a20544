"""What starting costs: processor time of a fresh process, as a multiple of importing numpy and scipy.sparse.

``python -m benchmarks.startup`` prints the median of ten runs of each, taken in turn so that a busy machine slows all
alike, and ends with code 1 if a ratio is above its limit. Processor time, not time, as it hardly depends on what else
runs. Each runs once beforehand, so that all bytecode lies in a folder of the benchmark's own: what is measured does not
depend on PYTHONDONTWRITEBYTECODE, nor on whether packages were compiled when they were installed.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
from tempfile import TemporaryDirectory

RUNS = 10
REFERENCE = ("-c", "import numpy, scipy.sparse")
CASES = {
    "import cirl_marl": (("-c", "import cirl_marl"), 2.0),
    "cirl --help": (("-m", "cirl_marl.cli", "--help"), 3.0),
    "cirl networks": (("-m", "cirl_marl.cli", "networks"), 6.0),
    "cirl check steel_world": (("-m", "cirl_marl.cli", "check", "steel_world"), 16.0),
}
"""Arguments of Python, and the largest ratio to the reference."""


def processor_seconds(arguments: tuple[str, ...], bytecode: str) -> float:
    """Return the processor time of a fresh Python with these arguments, user and system; bytecode lies in a folder."""
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = bytecode
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], capture_output=True, check=True, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def ratios(runs: int = RUNS) -> dict[str, float]:
    """Return the median processor time of each case in units of the median reference."""
    commands = {"": REFERENCE} | {name: arguments for name, (arguments, _) in CASES.items()}
    times: dict[str, list[float]] = {name: [] for name in commands}
    with TemporaryDirectory() as bytecode:
        for _ in range(1 + runs):
            for name, arguments in commands.items():
                times[name].append(processor_seconds(arguments, bytecode))
    medians = {name: statistics.median(seconds[1:]) for name, seconds in times.items()}
    return {name: medians[name] / medians[""] for name in CASES}


def main() -> int:
    """Print each ratio beside its limit."""
    measured = ratios()
    lines = [f"{name:24} {measured[name]:5.1f} x  (at most {limit:g} x)" for name, (_, limit) in CASES.items()]
    sys.stdout.write("\n".join(lines) + "\n")
    return int(any(measured[name] > limit for name, (_, limit) in CASES.items()))


if __name__ == "__main__":
    sys.exit(main())
