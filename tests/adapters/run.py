"""Each adapter in an environment of its own: its contract, and its example.

    python tests/adapters/run.py [NAME ...]

What a peer of the benchmarks needs is installed once, in ``build/peers``; pins of peers disagree with each other.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
sys.path.insert(0, str(ROOT))
TESTS = ROOT / "tests"
CONTRACTS = {
    "supersuit": TESTS / "test_supersuit.py",
    **{name: TESTS / "adapters" / f"contract_{name}.py" for name in ("torchrl", "benchmarl", "rllib")},
}
"""Tests by adapter; only SuperSuit is installed where the other tests run."""


def main() -> None:
    """Check those that are named, or all."""
    from benchmarks.peers.contenders import CONTENDERS
    from benchmarks.peers.installing import python_of

    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
    for name in sys.argv[1:] or CONTRACTS:
        python = str(python_of(CONTENDERS[name])) if name in CONTENDERS else sys.executable
        # warnings of other libraries are theirs
        tests = [
            "-m",
            "pytest",
            "-q",
            "-W",
            "default",
            "--disable-warnings",
            "-p",
            "no:cacheprovider",
            str(CONTRACTS[name]),
        ]
        for task in (tests, [str(ROOT / "examples" / "adapters" / f"train_{name}.py")]):
            sys.stdout.write(f"{name}: {Path(task[-1]).name}\n")
            sys.stdout.flush()
            subprocess.run([python, *task], cwd=ROOT, env=env, check=True)


if __name__ == "__main__":
    main()
