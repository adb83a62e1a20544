"""What a result was made with: the versions of the packages that bear on it, and the processor."""

from __future__ import annotations

import platform
from importlib import metadata
from pathlib import Path

PACKAGES = (
    "cirl-marl", "gymnasium", "greenlet", "highspy", "networkx", "numpy", "pettingzoo", "sb3-contrib", "scipy",
    "stable-baselines3", "torch",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Return the versions of Python, the platform and every package that bears on a result."""
    packages = {"python": platform.python_version(), "platform": f"{platform.system()} {platform.machine()}"}
    return packages | {package: metadata.version(package) for package in PACKAGES}


def processor() -> str:
    """Return the model of the processor, as far as the platform tells it."""
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", maxsplit=1)[1].strip()
    return platform.processor() or platform.machine()
