"""A field is declared once: what a new one gets by its declaration alone."""

from __future__ import annotations

import tomllib
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import pytest
from pydantic import ValidationError

from cirl_marl import Arc, NetworkError, Node, load_network
from cirl_marl.definitions.catalogue import folder
from cirl_marl.definitions.conversion import Converter
from cirl_marl.definitions.data_files import DataFiles
from cirl_marl.definitions.error_messages import validation_mistakes
from cirl_marl.definitions.schema import NetworkTable, table_of
from cirl_marl.definitions.writer import _Writer, definition_of, fingerprint
from cirl_marl.network.declarations import (
    Declaration,
    Numbers,
    Quantity,
    Word,
    bound_problems,
    declarations,
    frozen_record,
)
from cirl_marl.network.elements import Control, Episode, Objective, Observation, Service
from docs.site.format_guide import format_guide

DOCUMENT = tomllib.loads((folder("envs") / "copper_net.toml").read_text(encoding="utf-8"))
MODES = ("slow", "fast")


@frozen_record
class Warmed(Episode):
    """An episode that begins with a warm-up."""

    warm_up: Annotated[float, Quantity("time before the first decision", of="time", low=0.0)] = 0.0
    mode: Annotated[str, Word("how it warms up", of=MODES)] = "slow"
    heated: Annotated[tuple[str, ...], Declaration("what is warmed up", key="what")] = ()
    reserve: Annotated[tuple[float, float], Numbers("held back", "(low, high)", (2,), "range", "rate")] = (
        0.0,
        0.0,
    )
    cold: Annotated[bool, Declaration("whether it begins cold")] = False


def document(**more: object) -> dict[str, object]:
    """Return the episode of copper_net with more keys."""
    return {**{key: value for key, value in DOCUMENT["episode"].items()}, **more}


def read(**more: object) -> Warmed:
    """Read an episode as the reader of definition files does."""
    converter = Converter(NetworkTable.model_validate(DOCUMENT), DataFiles(Path()))
    found = converter._part(Warmed, table_of(Warmed).model_validate(document(**more)), "episode")
    if converter.mistakes:
        raise NetworkError("here", converter.mistakes)
    assert isinstance(found, Warmed)
    return found


def test_a_new_field_is_read_and_written_with_its_unit() -> None:
    """Given in hours it is in days, and what is written reads back; what is as by default is not written."""
    reserve = {"low": 1, "high": 2, "unit": "1/hour", "source": "x"}
    given = read(warm_up={"value": 6, "unit": "hour", "source": "x"}, mode="fast", what=["use"], reserve=reserve)
    assert given.reserve == pytest.approx((24.0, 48.0))
    assert given.warm_up == pytest.approx(0.25)
    assert (given.mode, given.heated) == ("fast", ("use",))
    written = _Writer(load_network("copper_net"))._part(given)
    assert written["warm_up"] == {"value": given.warm_up, "unit": "day", "source": "network built in Python"}
    assert read(**{key: written[key] for key in ("warm_up", "mode", "what", "reserve")}) == given
    assert not {"warm_up", "mode", "what"} & set(_Writer(load_network("copper_net"))._part(read()))


def test_a_new_field_is_checked() -> None:
    """Its unit, its bounds, its words, its kind of number, misspelt keys: said where they are."""
    with pytest.raises(NetworkError, match=r"episode\.warm_up: unit 'kg' is inconsistent"):
        read(warm_up={"value": 6, "unit": "kg", "source": "x"})
    assert list(bound_problems(replace(read(), warm_up=-1.0))) == ["warm_up -1.0 must be finite and not negative"]
    said = "unknown mode 'fats'. Did you mean 'fast'? Known: slow, fast."
    assert list(bound_problems(replace(read(), mode="fats"), "episode: ")) == [f"episode: {said}"]
    with pytest.raises(NetworkError, match=r"warmed: warm_up must be a number, got \(1.0, 2.0\)"):
        replace(read(), warm_up=(1.0, 2.0))  # type: ignore[arg-type]
    with pytest.raises(ValidationError) as raised:
        read(warmup={"value": 6, "unit": "hour", "source": "x"})
    assert validation_mistakes(raised.value, table_of(Warmed))[0].startswith(
        "warmup: unknown key 'warmup'. Did you mean 'warm_up'"
    )


@pytest.mark.parametrize(
    ("made", "changes", "said"),
    [
        (Warmed(), {"cold": "no"}, "warmed: cold must be true or false, got 'no'"),
        (Warmed(), {"heated": "use"}, "warmed: heated must be (id, …), got 'use'; write ('use',)"),
        (Warmed(), {"mode": None}, "warmed: mode must be text, got None"),
        (Episode(), {"horizon": 2.5}, "episode: horizon must be a whole number, got 2.5"),
        (Episode(), {"control_interval": None}, "episode: control_interval must be a number, got None"),
        (Objective(), {"circularity_weight": "x"}, "objective: circularity_weight must be a number, got 'x'"),
        (Objective(), {"tracked": "use"}, "objective: tracked must be (id, …), got 'use'; write ('use',)"),
        (
            Service(id="s", provider="a", quantity="stock", low=1.0),
            {"low": "104"},
            "service 's': low must be a number, got '104'",
        ),
        (
            Arc(id="k", donor="a", recipient="b"),
            {"pollutant": "no"},
            "arc 'k': pollutant must be true or false, got 'no'",
        ),
        (Arc(id="k", donor="a", recipient="b"), {"donor": 3}, "arc 'k': donor must be text, got 3"),
    ],
)
def test_values_are_of_their_kind(made: Any, changes: dict[str, Any], said: str) -> None:
    """Text is no truth value, no number and no list of ids; None is one only where nothing need be given."""
    with pytest.raises(NetworkError) as raised:
        replace(made, **changes)
    assert str(raised.value) == said


def test_numbers_without_a_spelling_are_a_fault_of_the_declaration() -> None:
    """They would be lost on writing."""

    @frozen_record
    class Lossy(Episode):
        """An episode with numbers that no file can hold."""

        lost: Annotated[tuple[float, ...], Numbers("what is lost", "(value, …)")] = ()

    with pytest.raises(TypeError, match="Lossy: numbers need a spelling in definition files: lost"):
        table_of(Lossy)


def test_a_new_field_is_documented() -> None:
    """In the docstring, and in the schema with which editors complete files."""
    assert "warm_up: time before the first decision." in str(Warmed.__doc__)
    keys = table_of(Warmed).model_json_schema()["properties"]
    assert keys["warm_up"]["description"] == "time before the first decision"
    assert keys["what"]["description"] == "what is warmed up"


def test_a_field_yet_to_come_changes_no_fingerprint() -> None:
    """Kept results stay those of their network: a default is not part of what is hashed."""
    network = load_network("copper_net")
    assert "criticality" not in definition_of(network)
    assert fingerprint(network) == fingerprint(network.with_options(objective={"criticality": None}))
    assert fingerprint(network) != fingerprint(network.with_options(objective={"criticality": 0.5}))


@pytest.mark.parametrize("made", [Node, Arc, Control, Service, Episode, Objective, Observation])
def test_every_field_is_declared(made: Any) -> None:
    """But for the id, which is the key of its table."""
    assert {field.name for field in fields(made)} - set(declarations(made)) <= {"id"}
    for name, declared in declarations(made).items():
        assert declared.meaning and f"{name}: " in str(made.__doc__)


def test_the_format_is_documented() -> None:
    """docs/format.md is what the declarations say; format_guide() writes it anew."""
    path = Path(__file__).parent.parent / "docs" / "format.md"
    assert path.read_text(encoding="utf-8") == format_guide()
