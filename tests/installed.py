"""Use the installed wheel as a stranger would: from another folder, in an environment of its own."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path


def main(environment: Path) -> None:
    """Run the command line of ``environment`` in an empty folder and check that it works."""
    binaries = environment.resolve() / "bin"  # not resolved further: the interpreter is a link out of the environment
    cirl, python = str(binaries / "cirl"), str(binaries / "python")
    with tempfile.TemporaryDirectory() as folder:

        def run(*command: str) -> str:
            done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
            return done.stdout

        where = run(python, "-c", "import cirl_marl; print(cirl_marl.__file__)").strip()
        if not Path(where).resolve().is_relative_to(environment.resolve()):
            raise SystemExit(f"the package was imported from {where}, not from {environment}")
        for network in ("copper_net", "carbo_net"):
            if network not in run(cirl, "networks"):
                raise SystemExit(f"the installed catalogue lacks {network}")
        run(cirl, "show", "copper_net")
        run(cirl, "simulate", "carbo_net", "--control", "random", "--html", "page.html")
        run(cirl, "train", "copper_net", "--steps", "6000", "--envs", "32", "--out", "run")
        run(cirl, "evaluate", "run", "--episodes", "4")
        run(cirl, "benchmark", "verify", "--row", "paper_city-v0/exact_gradients/401")  # with the weights of the wheel
        written = ("copper_net.png", "carbo_net_random.csv", "page.html")
        for name in (*written, "run/evaluation.json", "run/pictures/circularity.png"):
            if not (Path(folder) / name).is_file():
                raise SystemExit(f"{name} was not written")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
