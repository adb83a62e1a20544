"""Each peer in an environment of its own, below the folder ``build`` that git ignores."""

from __future__ import annotations

import subprocess
import sys
import venv
from pathlib import Path

from benchmarks.peers.contenders import Contender

ROOT = Path(__file__).parent.parent.parent
HOME = ROOT / "build" / "peers"


def python_of(contender: Contender, home: Path = HOME) -> Path:
    """Return the interpreter that has what a contender needs, installed first if it is not there.

    Ourselves run by the interpreter of now. An environment of a peer sees the packages of the interpreter of now, so
    that it holds only what these lack, or what the peer pins to another version.
    The versions of ``constraints.txt`` hold for peers as well.

    Raises:
        CalledProcessError: if the packages cannot be installed; the environment is not used then.
    """
    if not contender.packages:
        return Path(sys.executable)
    folder = home / contender.venv
    python, done = folder / "bin" / "python", folder / "installed.txt"
    wanted = "\n".join([*contender.packages, sys.prefix])
    if not done.is_file() or done.read_text(encoding="utf-8") != wanted:
        venv.create(folder, with_pip=True, clear=True)
        (packages,) = folder.glob("lib/python*/site-packages")
        (packages / "of_the_project.pth").write_text("\n".join([*_site_packages(), str(ROOT)]), encoding="utf-8")
        install = ["-m", "pip", "install", "--quiet", "--no-compile", "-c", str(ROOT / "constraints.txt")]
        subprocess.run([str(python), *install, *contender.packages], check=True)
        done.write_text(wanted, encoding="utf-8")
    return python


def _site_packages() -> list[str]:
    return [path for path in sys.path if Path(path).name == "site-packages"]
