"""How a field of a network's parts is declared: once, with its kind of quantity, its bounds and its meaning.

A declaration stands in the annotation of the field. Checks, docstrings, reading with units, writing, the JSON schema
and the table of the format derive from it, so that a new field is one declaration and the physics that uses it::

    rate: Annotated[float, Quantity("a, share that leaves in a unit of time", of="rate", low=0.0)] = 0.0
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, MISSING, dataclass, fields, replace
from datetime import date, datetime
from enum import StrEnum
from functools import cache, partial
from itertools import chain
from numbers import Integral, Real
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, TypeVar, dataclass_transform, get_type_hints

import numpy as np

from cirl_marl.errors import NetworkError, unknown_name

Kind = Literal["mass", "time", "rate", "flow", "steps", "1", "own"]
"""Kinds of quantity; a rate is 1/time, a flow mass/time, steps count control intervals, ``own`` is not converted."""

Part = TypeVar("Part")


def with_field_docs(record: type[Part]) -> type[Part]:
    """Let the docstring of a dataclass list its fields with what their annotations declare or, as plain text, say."""
    lines = [
        textwrap.fill(f"        {name}: {getattr(note, 'meaning', note)}.", 120, subsequent_indent=" " * 12)
        for name, note in _annotations(record).items()
    ]
    record.__doc__ = "\n".join([str(record.__doc__).rstrip(), "", "    Attributes:", *lines, "    "])
    return record


@dataclass_transform(kw_only_default=True, frozen_default=True)
def frozen_record(record: type[Part]) -> type[Part]:
    """Make a dataclass of keywords that cannot be changed, and whose docstring lists them."""
    return with_field_docs(dataclass(frozen=True, slots=True, kw_only=True)(record))


@dataclass_transform(frozen_default=True)
def positional_record(record: type[Part]) -> type[Part]:
    """Make a dataclass as ``frozen_record`` does, whose values may be given by their places too."""
    return with_field_docs(dataclass(frozen=True, slots=True)(record))


@dataclass(frozen=True, slots=True)
class KeptRecord:
    """A record that files keep, with another name there for a part in ``NAMES_IN_FILES``."""

    NAMES_IN_FILES: ClassVar[Mapping[str, str]] = {}

    def as_dict(self) -> dict[str, Any]:
        """Return the parts by their names in files."""
        return {self.NAMES_IN_FILES.get(part.name, part.name): getattr(self, part.name) for part in fields(self)}

    @classmethod
    def from_dict(cls, parts: Mapping[str, Any]) -> Self:
        """Return the record of parts that were read from a file."""
        names = {key: name for name, key in cls.NAMES_IN_FILES.items()}
        return cls(**{names.get(key, key): value for key, value in parts.items()})


def _annotations(record: Any) -> dict[str, Any]:
    hints = get_type_hints(record, include_extras=True)
    metadata = {field.name: getattr(hints[field.name], "__metadata__", ()) for field in fields(record)}
    return {name: notes[0] for name, notes in metadata.items() if notes}


class TimeDependent:
    """What may stand for a number that is declared to vary: one that changes in time, between two ``extremes``."""

    __slots__ = ()

    @property
    def extremes(self) -> tuple[float, float]:
        """Lowest and highest value."""
        raise NotImplementedError

    def time_of(self, extreme: float) -> float:
        """Return when it first has its lowest or highest value."""
        raise NotImplementedError


class Scalable:
    """What may stand for a rate on an account, with a ``factor``: the number of it that may change or be uncertain."""

    __slots__ = ()
    factor: Any


@positional_record
class Declaration:
    """What is known of a field; by itself, of a text, of ids in a fixed order, or of one that is true or false."""

    meaning: Annotated[str, "for docstrings, schema and documents"]
    _: KW_ONLY
    key: Annotated[str, "what definition files call it, if not by its name"] = ""
    mandatory: Annotated[bool, "whether definition files must give it, though Python has a default"] = False

    def problem(self, value: object) -> str:
        """Return what the field must be, and what to write instead, if ``value`` is of another kind; else nothing."""
        return ""


@positional_record
class Word(Declaration):
    """One of some words."""

    of: Annotated[type[StrEnum] | tuple[str, ...], "an enumeration, or the words"] = ()
    label: Annotated[str, "what messages call it, if not by its name"] = ""


class Kinds(NamedTuple):
    """A kind of quantity that depends on the value of the field ``by``: one ``of`` those named, or ``otherwise``.

    It is a part, of kind ``1``, where a field ``content_of`` says of what.
    """

    by: str
    of: Mapping[str | bool, Kind]
    otherwise: Kind
    content_of: str = ""


SMALLEST, LARGEST = 1e-50, 1e50
"""Sizes of numbers of which squares and quotients are finite."""


@positional_record
class Quantity(Declaration):
    """A number with a unit."""

    of: Annotated[Kind | Kinds, "kind of quantity"] = "1"
    low: Annotated[float, "lowest value; a ``positive`` one lies above 0"] = -math.inf
    high: Annotated[float, "highest value"] = math.inf
    positive: Annotated[bool, "whether it lies above 0"] = False
    joint: Annotated[bool, "whether its bounds depend on other fields, so that they are checked with these"] = False
    varies: Annotated[bool, "whether it may change in time"] = False
    none_word: Annotated[str, "the word that definition files may give for None"] = ""
    unit_of_table: Annotated[bool, "whether its unit and source are those of the table in which it stands"] = False
    past: Annotated[bool, "whether it is about the time before the episode, and a series"] = False

    def kind(self, part: object) -> Kind:
        """Return the kind of quantity in ``part``, a part of a network or its table in a definition file."""
        kinds = self.of
        if isinstance(kinds, str):
            return kinds
        if kinds.content_of and getattr(part, kinds.content_of):
            return "1"
        return kinds.of.get(getattr(part, kinds.by), kinds.otherwise)

    def problem(self, value: object) -> str:
        """See ``Declaration.problem``."""
        if self.past:
            return "" if isinstance(value, TimeDependent) else f"a series, of times and values, got {value!r}"
        return "" if self.varies and isinstance(value, TimeDependent) else _problem(value, "a number", ())

    def bound_problem(self, value: float) -> str:
        """Return what a number out of its bounds must be; nothing if it is within."""
        if math.isfinite(value) and value and not SMALLEST <= abs(value) <= LARGEST:
            return f"must be 0, or between {SMALLEST:g} and {LARGEST:g} in size"
        within = self.low <= value <= self.high and (value > 0 or not self.positive)
        if self.joint or (math.isfinite(value) and within):
            return ""
        if math.isfinite(self.high):
            return f"must lie in {'(0' if self.positive else f'[{self.low:g}'}, {self.high:g}]"
        if self.positive:
            return "must be positive and finite"
        if self.low == 0:
            return "must be finite and not negative"
        return f"must be at least {self.low:g}" if math.isfinite(self.low) else "must be finite"


RATE = Quantity("an amount on an account", of="own", varies=True)
"""What each number of ``Rates`` is."""
FACTOR = Quantity("a factor on rates", low=0.0, varies=True)
Positive = partial(Quantity, positive=True)
NotNegative = partial(Quantity, low=0.0)
Share = partial(Quantity, low=0.0, high=1.0)


@positional_record
class Numbers(Declaration):
    """Several numbers, which definition files spell in a table of their own."""

    form: Annotated[str, "how they are given in Python"] = ""
    shape: Annotated[tuple[int | None, ...], "their shape, None being any length"] = (None,)
    table_form: Annotated[str, "which table of definition files holds them; empty if that of another field does"] = ""
    of: Annotated[Kind, "kind of quantity; of batches that beside their times"] = "mass"
    varies: Annotated[bool, "whether it may change in time"] = False

    def problem(self, value: object) -> str:
        """See ``Declaration.problem``."""
        return "" if self.varies and isinstance(value, TimeDependent) else _problem(value, self.form, self.shape)


@positional_record
class Rates(Declaration):
    """Numbers by name: one for each of some accounts, in the unit of the account per ``per``, or of some substances."""

    per: Annotated[
        Literal["mass", "stock", "control"],
        "what an amount is charged for: ``mass``, a ``stock`` and time, or a ``control``, in its unit, and time",
    ] = "mass"
    of: Annotated[Literal["account", "substance"], "what has the names"] = "account"
    number: Annotated[Quantity, "what each of them is"] = RATE

    def unit(self, amount: str, mass: str, time: str, control: str) -> str:
        """Return the unit of amounts of some unit per what they are charged for, in the units of a network."""
        per = {"mass": f"({mass})", "stock": f"(({mass})*({time}))", "control": f"(({control})*({time}))"}
        return f"({amount})/{per[self.per]}"

    def unit_of_subject(self, mass: str, time: str, control: str) -> str:
        """Return the unit of what amounts are charged for in a unit of time."""
        return {"mass": f"({mass})/({time})", "stock": mass, "control": control}[self.per]

    def problem(self, value: object) -> str:
        """See ``Declaration.problem``."""
        pairs = value if isinstance(value, tuple) else ()
        if not isinstance(value, tuple) or not all(isinstance(pair, tuple) and len(pair) == 2 for pair in pairs):
            return f"{{{self.of}: number, …}}, got {value!r}"
        names = Counter(str(name) for name, _ in pairs)
        pairs = tuple(pair for pair in pairs if self.of != "account" or not isinstance(pair[1], Scalable))
        truths = (f"{name!r}: a number, got {number!r}" for name, number in pairs if isinstance(number, bool))
        faults = (f"{name!r}: {fault}" for name, number in pairs if (fault := self.number.problem(number)))
        repetitions = (f"{name!r}: once, got it {count} times" for name, count in names.items() if count > 1)
        return next(chain(truths, faults, repetitions), "")


Amount = partial(Numbers, form="a number", shape=(), table_form="amount", varies=True)
"""A number whose unit is that of the table in which it stands."""


@dataclass(frozen=True, slots=True)
class CalendarTime(Declaration):
    """A point in time on the calendar, which definition files spell as a number or a date."""

    def problem(self, value: object) -> str:
        """See ``Declaration.problem``."""
        year: Any = value.year if isinstance(value, date) else value
        if isinstance(year, Real) and not isinstance(value, bool | datetime) and 1 <= float(year) < 9999:
            return ""
        return f"a calendar year such as 2000 or 2000.5, or a date, got {value!r}"


@dataclass(frozen=True, slots=True)
class Subtable(Declaration):
    """A part of its own, with a table of its own."""

    of: Literal["control", "model", "lifetime", "rule"] = "control"


def declarations(record: type[Any]) -> Mapping[str, Declaration]:
    """Return the declared fields of a part by name, in their order."""
    hashable: Any = record  # mypy does not know that classes are hashable
    return _declarations(hashable)


@cache
def _declarations(record: Any) -> Mapping[str, Declaration]:
    return MappingProxyType(
        {name: note for name, note in _annotations(record).items() if isinstance(note, Declaration)}
    )


def default_of(record: type[Any], name: str) -> Any:
    """Return the default of a field; ``dataclasses.MISSING`` if it has none."""
    return record.__dataclass_fields__[name].default


def is_required(record: type[Any], name: str) -> bool:
    """Whether definition files must give a field."""
    return declarations(record)[name].mandatory or default_of(record, name) is MISSING


def check_types(owner: str, part_: Any) -> None:
    """Take words of enumerations as definitions spell them, and refuse what is of another kind than declared.

    Raises:
        NetworkError: naming every field without its numbers, with what to write, and words with the nearest valid one.
    """
    faults, record = [], part_.__class__
    for name, declaration, default, hint in _checks(record):
        value = getattr(part_, name)
        if value is default or type(value) is hint is float:
            continue  # by far the most usual
        if isinstance(declaration, Rates) and isinstance(value, Mapping):
            value = tuple(value.items())  # which can be hashed
            object.__setattr__(part_, name, value)
        if isinstance(declaration, Word) and isinstance(declaration.of, type):
            if value not in declaration.of.__members__.values():
                raise NetworkError(owner, [unknown_name(declaration.label or name, value, declaration.of)])
            object.__setattr__(part_, name, declaration.of(value))
        elif fault := declaration.problem(value) or _plain_problem(value, hint):
            faults.append(f"{name} must be {fault}")
    if faults:
        raise NetworkError(owner, faults)


@cache
def _checks(record: Any) -> tuple[tuple[str, Declaration, Any, Any], ...]:
    """Return name, declaration, default and type of each field; a default that is not of its type counts as none."""
    checks = []
    hints = get_type_hints(record)
    for name, declaration in _declarations(record).items():
        default, hint = default_of(record, name), hints[name]
        if isinstance(declaration, Word) and isinstance(declaration.of, type):
            valid = isinstance(default, declaration.of)
        else:
            valid = default is None or not (declaration.problem(default) or _plain_problem(default, hint))
        checks.append((name, declaration, default if valid else MISSING, hint))
    return tuple(checks)


class CheckedRecord:
    """A part of a network that refuses values of another kind than declared; messages call it by its kind and id."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check every field; take words of enumerations as definitions spell them."""
        kind = type(self).__name__.lower()
        if not isinstance(id_ := getattr(self, "id", ""), str):
            raise NetworkError(f"{kind} {id_!r}", ["id must be text"])
        check_types(f"{kind} '{self.id}'" if hasattr(self, "id") else kind, self)


def bound_problems(part_: Any, prefix: str = "") -> Iterator[str]:
    """Yield every number out of its declared bounds, and every word that is none of its words."""
    for name, declaration, value in numbers(part_):
        if isinstance(declaration, Word) and value not in declaration.of:
            yield f"{prefix}{unknown_name(declaration.label or name, value, declaration.of)}"
        elif isinstance(declaration, Quantity) and value is not None:
            for number in value.extremes if isinstance(value, TimeDependent) else (value,):
                if fault := declaration.bound_problem(number):
                    when = (
                        f", at time {value.time_of(number):g} of the episode"
                        if isinstance(value, TimeDependent)
                        else ""
                    )
                    yield f"{prefix}{name} {float(f'{number:.12g}')} {fault}{when}"
                    break


def numbers(part_: Any) -> Iterator[tuple[str, Declaration, Any]]:
    """Give name, declaration and value of every declared field; of rates each, or its factor, as ``accounts.NAME``."""
    for name, declaration in declarations(type(part_)).items():
        if isinstance(declaration, Rates):
            for id_, number in getattr(part_, name):
                is_scalable = isinstance(number, Scalable)
                kind = FACTOR if is_scalable else declaration.number
                yield f"{name}.{id_}", kind, number.factor if is_scalable else number
        else:
            yield name, declaration, getattr(part_, name)


def with_number(part_: Any, name: str, value: Any, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ``changes`` of fields of a part, by name, with that of the number ``name`` to ``value``."""
    field, _, id_ = name.partition(".")
    if id_:
        before = dict(changes.get(field, getattr(part_, field)))
        if isinstance(before.get(id_), Scalable):
            value = replace(before[id_], factor=value)
        value = tuple({**before, id_: value}.items())
    return {**changes, field: value}


def number_of(part_: Any, name: str) -> Any:
    """Return the number ``name`` of a part; see ``numbers``."""
    field, _, account = name.partition(".")
    number = dict(getattr(part_, field))[account] if account else getattr(part_, field)
    return number.factor if isinstance(number, Scalable) else number


def _plain_problem(value: object, hint: Any) -> str:
    """Return what a text, a truth value, ids or a count must be; nothing for other kinds of fields."""
    if hint is bool and not isinstance(value, bool | np.bool_):
        return f"true or false, got {value!r}"
    if hint is int and not isinstance(value, Integral):
        return f"a whole number, got {value!r}"
    if hint is str and not isinstance(value, str):
        return f"text, got {value!r}"
    if hint == tuple[str, ...] and (isinstance(value, str) or not isinstance(value, Sequence)):
        instead = f"; write {(value,)!r}" if isinstance(value, str) else ""
        return f"(id, …), got {value!r}{instead}"
    return ""


def _problem(value: object, form: str, shape: tuple[int | None, ...]) -> str:
    if _fits(value, shape):
        return ""
    instead = (f"; write {alternative!r}" for alternative in ((value,), (value, value)) if _fits(alternative, shape))
    return f"{form}, got {value!r}{next(instead, '')}"


def _fits(value: object, shape: tuple[int | None, ...]) -> bool:
    if not shape:
        return type(value) is float or isinstance(value, Real)
    if not isinstance(value, tuple | Sequence | np.ndarray) or shape[0] not in (None, len(value)):
        return False
    if len(shape) == 1 and {*map(type, value)} <= {float, int}:
        return True
    return all(_fits(part, shape[1:]) for part in value)
