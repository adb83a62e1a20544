"""A sweep as a TOML file: what is multiplied out, and how the results are measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BeforeValidator, Field, StrictBool, StrictInt, StrictStr, ValidationError
from pydantic_core import PydanticCustomError

from cirl_marl.definitions.catalogue import file_and_region, load_network
from cirl_marl.definitions.error_messages import validation_mistakes
from cirl_marl.definitions.quantities import Number
from cirl_marl.definitions.reader import read_toml
from cirl_marl.errors import CirlError, DefinitionError, unknown_name
from cirl_marl.learners.recipe import Count, EngineName, Recipe, Settings, load_recipe
from cirl_marl.network import Network
from cirl_marl.network.elements import Moment, Observe, Reward

OneOrMore = TypeVar("OneOrMore")
Level = Annotated[Number, Field(ge=0, le=1)]
SeedNumber = Annotated[StrictInt, Field(ge=0)]


def _as_list(value: Any) -> Any:
    """Return a value as the list of one that it stands for; of what is listed, nothing may stand there twice."""
    entries = value if isinstance(value, list) else [value]
    if not entries:
        raise PydanticCustomError("nothing", "lists nothing")
    typed = [(type(entry), entry) for entry in entries]  # true is not 1
    twice = [entry for i, (_, entry) in enumerate(typed) if typed[i] in typed[:i]]
    if twice:
        raise PydanticCustomError("twice", "lists {value} twice", {"value": repr(twice[0])})
    return entries


NonEmptyList = Annotated[list[OneOrMore], BeforeValidator(_as_list)]


class SweepOptions(Settings):
    """Options of ``train`` for all cells; a list of several values is multiplied out. None takes the recipe's."""

    steps: NonEmptyList[Count] | None = None
    envs: NonEmptyList[Count] | None = None
    engine: NonEmptyList[EngineName] | None = None
    min_service: NonEmptyList[Level] | None = None
    reward: NonEmptyList[Reward] | None = None
    observe: NonEmptyList[Observe] | None = None
    countdown: NonEmptyList[StrictBool] | None = None
    circularity: NonEmptyList[Moment] | None = None
    circularity_weight: NonEmptyList[Level] | None = None
    horizon: NonEmptyList[Count] | None = None
    uncertain: NonEmptyList[StrictBool] | None = None


class SweepEvaluation(Settings):
    """The fresh episodes in which every cell is measured: how many, from which seed, and whether to the bound."""

    episodes: Annotated[int, Field(strict=True, ge=2)] = 64
    seed: SeedNumber = 0
    bounds: StrictBool = True


class SweepFile(Settings):
    """What a sweep file says.

    Attributes:
        networks: names of the catalogue, or files, which count from the folder of the sweep file.
        recipes: likewise; None takes the default one of each network.
        scenarios: of every network; None takes the recipe's, else the default one.
    """

    networks: NonEmptyList[StrictStr]
    recipes: NonEmptyList[StrictStr] | None = None
    scenarios: NonEmptyList[StrictStr] | None = None
    seeds: NonEmptyList[SeedNumber] = Field([0])
    options: SweepOptions = SweepOptions()
    evaluation: SweepEvaluation = SweepEvaluation()


def load_sweep(path: Path) -> SweepFile:
    """Read a sweep file; names of files in it become paths from the working directory.

    Raises:
        DefinitionError: if the file has mistakes; all are named, those in what it names as well.
    """
    document = read_toml(path)
    mistakes: list[str] = []
    faulty: set[str] = set()
    try:
        SweepFile.model_validate(document)
    except ValidationError as error:
        mistakes += validation_mistakes(error, SweepFile)
        faulty = {str(item["loc"][0]) for item in error.errors()}
    sound = {key: _as_list(value) for key, value in document.items() if key in _NAMES and key not in faulty}
    sound = {key: [_from(path.parent, str(name)) for name in names] for key, names in sound.items()}
    mistakes += _unknown_names(sound)
    if mistakes:
        raise DefinitionError(str(path), mistakes)
    return SweepFile.model_validate(document | sound)


_NAMES = ("networks", "recipes", "scenarios")


def _from(folder: Path, name: str) -> str:
    """Return the name of a file as it is from the working directory, and a name of the catalogue as it is."""
    return str(folder / name) if file_and_region(name) is not None else name


def _unknown_names(sound: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield what is wrong with networks, scenarios and recipes, each by itself."""
    readers: dict[str, Callable[[str], Network | Recipe]] = {"networks": load_network, "recipes": load_recipe}
    networks: list[Network] = []
    for key, read in readers.items():
        for name in sound.get(key, ()):
            try:
                candidate = read(name)
            except DefinitionError as error:
                yield from (f"{key}: {problem}" for problem in str(error).splitlines())
            except CirlError as error:
                yield f"{key}: {error}"
            else:
                networks += [candidate] if isinstance(candidate, Network) else []
    for network in networks:
        present = [network.scenario_name, *network.scenarios]
        for name in sound.get("scenarios", ()):
            if name not in present:
                yield f"scenarios: network '{network.name}': {unknown_name('scenario', name, present)}"
