"""An environment with a wheel, what it declares to need, and nothing else: python tests/clean.py WHEEL FOLDER.

The packages are those of the interpreter of now, linked and not unpacked again, which would take a minute of the
processor. What the wheel forgets to declare is missing all the same.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Iterator
from importlib.metadata import Distribution, distribution
from importlib.util import cache_from_source
from pathlib import Path

from packaging.requirements import Requirement


def main(wheel: Path, folder: Path) -> None:
    """Make the environment anew."""
    venv.create(folder, clear=True, symlinks=True)
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(folder), "platbase": str(folder)}))
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(folder / "bin" / "python")]
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--no-compile", str(wheel.resolve())], check=True)
    (own,) = packages.glob("*.dist-info")
    for needed in closure(Distribution.at(own)):
        link(needed, packages)
    subprocess.run([*pip, "check"], check=True, stdout=subprocess.DEVNULL)


def closure(package: Distribution) -> Iterator[Distribution]:
    """Yield what a package needs without its extras, and what that needs, each once.

    Raises:
        PackageNotFoundError: if something is not installed here.
    """
    waiting, met = list(requirements(package, set())), set[tuple[str, frozenset[str]]]()
    names = set[str]()
    while waiting:
        needed = waiting.pop()
        asked = needed.name.lower().replace("_", "-"), frozenset(needed.extras)
        if asked in met:
            continue
        met.add(asked)
        here = distribution(needed.name)
        waiting += requirements(here, needed.extras)
        if asked[0] not in names:
            names.add(asked[0])
            yield here


def requirements(package: Distribution, extras: set[str]) -> Iterator[Requirement]:
    """Yield what a package with some extras needs on this machine."""
    for line in package.requires or ():
        needed = Requirement(line)
        if needed.marker is None or any(needed.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield needed


def link(package: Distribution, packages: Path) -> None:
    """Put the files of a package into an environment, but for commands, and bytecode where it is there already."""
    for file in package.files or ():
        source, target = Path(str(package.locate_file(file))), packages / file
        if ".." in file.parts or source.suffix == ".pyc" or not source.is_file():
            continue
        pairs = [(source, target)]
        if source.suffix == ".py":
            cached = Path(cache_from_source(str(source)))
            pairs += [(cached, target.parent / "__pycache__" / cached.name)] if cached.is_file() else []
        for here, there in pairs:
            there.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(here, there)
            except OSError:  # another file system
                shutil.copy2(here, there)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
