"""Where the networks and the learner recipes are. No other file knows.

In a wheel they lie inside the package; in a checkout or an editable install beside it.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from cirl_marl.definitions.code_permission import code_allowed
from cirl_marl.definitions.ids import NAMESPACE, network_and_scenario
from cirl_marl.definitions.reader import Definition
from cirl_marl.errors import CirlError, path_of, unknown_name
from cirl_marl.network import Network

IN_PACKAGE = Path(__file__).parent.parent / "_catalogue"
CHECKOUT = Path(__file__).parent.parent.parent


def folder(kind: str) -> Path:
    """Return the folder of definitions ``envs`` or ``agents``, of the installed package or of a checkout."""
    in_package = IN_PACKAGE / kind
    if in_package.is_dir():
        return in_package
    beside = CHECKOUT / kind
    if beside.is_dir() and (CHECKOUT / "cirl_marl" / "definitions" / "catalogue.py").samefile(__file__):
        return beside
    raise CirlError(f"the catalogue folder '{kind}' is missing: looked in {in_package} and {beside}")


def networks() -> list[str]:
    """Return the names of the networks in the catalogue; of a definition with regions the name of each.

    >>> "copper_net" in networks()
    True
    """
    return sorted(name for names in families().values() for name in names)


def families() -> dict[str, list[str]]:
    """Return the names of the networks of each definition of the catalogue, by the name of the definition."""
    return {name: [*_regions(definition_.path)] for name, definition_ in definitions().items()}


def definitions() -> dict[str, Definition]:
    """Return the definitions of the catalogue, by name."""
    return {path.stem: definition(path) for path in sorted(folder("envs").glob("*.toml"))}


def recipes() -> list[str]:
    """Return the names of the learner recipes in the catalogue."""
    return sorted(path.stem for path in folder("agents").glob("*.toml"))


def load_network(name: str | Path | Network, *, scenario: str | None = None, allow_code: bool = False) -> Network:
    """Return a network of the catalogue, or of a definition file if ``name`` ends in ``.toml`` or ``.toml:REGION``.

    A network of the catalogue has a name, as ``copper_net``, and ids, as ``cirl_marl/copper_net.paper-v0``; a
    ``Network`` is itself. It is under ``scenario``; None is the default, physical one, or that of the id. With
    ``allow_code`` the file may name models of its own, whose modules are then imported; those that are imported already
    need no leave.

    Raises:
        DefinitionError: if the file has mistakes; all are named.
        CirlError: if there is no such network or scenario.
    """
    if isinstance(name, Network):
        return name.scenario(scenario)
    if not isinstance(name, str | Path):
        raise CirlError(f"network must be a name of the catalogue, a file or a Network, got {name!r}")
    path_of("network", name)
    path_and_region, variant = file_and_region(str(name)), None
    if path_and_region is None:
        network = str(name)
        if network.startswith(NAMESPACE):
            network, variant = network_and_scenario(network)
        path_and_region = _in_catalogue(network)
    path, region = path_and_region
    with code_allowed(allow_code):
        return definition(path).network(region=region).scenario(variant).scenario(scenario)


def file_and_region(name: str) -> tuple[Path, str] | None:
    """Return what ``FILE.toml`` or ``FILE.toml:REGION`` names; None if it is no name of a file."""
    if name.endswith(".toml"):
        return Path(name), ""
    file, _, region = name.rpartition(":")
    return (Path(file), region) if file.endswith(".toml") else None


def recipe_path(name: str | Path) -> Path:
    """Return the file of a recipe of the catalogue, or ``name`` itself if it ends in ``.toml``."""
    if str(name).endswith(".toml"):
        return path_of("recipe", name)
    if name not in recipes():
        raise CirlError(f"{unknown_name('recipe', name, recipes())} A file of your own must end in .toml.")
    return folder("agents") / f"{name}.toml"


def _in_catalogue(name: str) -> tuple[Path, str]:
    """Return file and region of a network; only files with whose names it begins are read, the longest name first."""
    for path in sorted(folder("envs").glob("*.toml"), key=lambda path_: -len(path_.stem)):
        if name.startswith(path.stem) and name in (regions_ := _regions(path)):
            return path, regions_[name]
    names = networks()
    regions = [path_ for path_ in names if path_.startswith(f"{name}_")]
    raise CirlError(f"{unknown_name('network', name, regions or names)} A file of your own must end in .toml.")


def _regions(path: Path) -> dict[str, str]:
    """Return the regions of a definition by the names of their networks; the empty one if it has none."""
    return {f"{path.stem}_{region}": region for region in definition(path).regions} or {path.stem: ""}


def definition(path: Path) -> Definition:
    """Return a definition, as it was read before if neither it nor its data files have been edited since."""
    stamp = path.stat().st_mtime_ns if path.is_file() else 0
    latest = _read(path.resolve(), stamp)
    if latest.files.has_changed:
        _read.cache_clear()
        latest = _read(path.resolve(), stamp)
    return latest


@lru_cache(maxsize=64)
def _read(path: Path, stamp: int) -> Definition:
    del stamp  # part of the cache key, so that an edited file is read again
    return Definition(path)
