"""Where the networks and the learner recipes are. No other file knows.

In a wheel they lie inside the package; in a checkout or an editable install beside it.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from cirl_marl.definitions.reading import Definition
from cirl_marl.errors import CirlError, unknown
from cirl_marl.network import Network

PACKAGED = Path(__file__).parent.parent / "_catalogue"
CHECKOUT = Path(__file__).parent.parent.parent


def folder(kind: str) -> Path:
    """Return the folder of definitions ``envs`` or ``agents``, of the installed package or of a checkout."""
    packaged = PACKAGED / kind
    if packaged.is_dir():
        return packaged
    beside = CHECKOUT / kind
    if beside.is_dir() and (CHECKOUT / "cirl_marl" / "definitions" / "catalogue.py").samefile(__file__):
        return beside
    raise CirlError(f"the catalogue folder '{kind}' is missing: looked in {packaged} and {beside}")


def networks() -> list[str]:
    """Return the names of the networks in the catalogue.

    >>> "copper_net" in networks()
    True
    """
    return sorted(path.stem for path in folder("envs").glob("*.toml"))


def recipes() -> list[str]:
    """Return the names of the learner recipes in the catalogue."""
    return sorted(path.stem for path in folder("agents").glob("*.toml"))


def load_network(name: str | Path, *, scenario: str | None = None) -> Network:
    """Return a network of the catalogue, or of a definition file if ``name`` ends in ``.toml``.

    It is under ``scenario``; None is the default, physical one.

    Raises:
        DefinitionError: if the file has mistakes; all are named.
        CirlError: if there is no such network or scenario.
    """
    path = Path(name) if str(name).endswith(".toml") else _in_catalogue("envs", str(name), networks())
    stamp = path.stat().st_mtime_ns if path.is_file() else 0
    return _read(path.resolve(), stamp).scenario(scenario)


def recipe_path(name: str | Path) -> Path:
    """Return the file of a recipe of the catalogue, or ``name`` itself if it ends in ``.toml``."""
    return Path(name) if str(name).endswith(".toml") else _in_catalogue("agents", str(name), recipes())


def _in_catalogue(kind: str, name: str, known: list[str]) -> Path:
    if name not in known:
        what = "network" if kind == "envs" else "recipe"
        raise CirlError(f"{unknown(what, name, known)} A file of your own must end in .toml.")
    return folder(kind) / f"{name}.toml"


@cache
def _read(path: Path, stamp: int) -> Network:
    del stamp  # part of the cache key, so that an edited file is read again
    return Definition(path).network()
