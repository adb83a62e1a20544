"""The forms in which definition files give numbers: with a unit and a source, as a series, or as a column of a file."""

from __future__ import annotations

import math
import re
from datetime import date, datetime
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, Union, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, WithJsonSchema
from pydantic_core import PydanticCustomError

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Source = Annotated[str, Field(min_length=1, description="where the number comes from")]


PERCENT = r"^\d+(\.\d+)? ?%$"


def _deviation(number: object) -> object:
    if isinstance(number, int | float) and not isinstance(number, bool) and math.isfinite(number):
        return number
    if isinstance(number, str) and re.match(PERCENT, number):
        return number
    raise PydanticCustomError("deviation", "must be a number in the unit of the quantity, or relative, as '5 %'")


Deviation = Annotated[
    Any,
    BeforeValidator(_deviation),
    WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "string", "pattern": PERCENT}]}),
]


class Table(BaseModel):
    """A TOML table without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


if TYPE_CHECKING:
    Factor: TypeAlias = Any  # its tables are those that it stands in


class StatedTable(Table):
    """A quantity that may be a product, and may be known only so far."""

    multiplied_by: Factor = Field(
        None, description="another quantity by which it is multiplied, such as a population; the units, too"
    )
    deviation: Deviation | None = Field(
        None,
        description="standard deviation of what is not known exactly, in the same unit (of a series, or of pieces, of "
        "its mean), or relative, as ``5 %``",
    )
    range: tuple[Number, Number] | None = Field(None, description="lowest and highest value that it may have, likewise")
    distribution: Literal["normal", "lognormal", "gamma", "uniform"] | None = Field(
        None, description="of what it may be; default: ``normal`` with a deviation, else ``uniform``"
    )
    disturbed_by: str | None = Field(None, description="name of a disturbance, whose value multiplies it in time")
    disturbed_as: Literal["factor", "summand"] | None = Field(
        None, description="``summand``: the disturbance is added instead, in its own unit; default: ``factor``"
    )


class QuantityTable(StatedTable):
    """A number with its unit and source."""

    value: Number
    unit: str = Field(description="pint unit, such as 'kt', '1/day', 't/day'; '1' if dimensionless")
    source: Source


class PiecesTable(StatedTable):
    """A rate that is higher beyond some amounts: convex, so that bounds hold."""

    to: list[Number] = Field(description="amounts up to which all values but the last hold")
    to_unit: str = Field(
        description="their unit: of a flow, such as 'kt/year', of a stock (``holding``) or of a control (``effort``)"
    )
    values: list[Number] = Field(description="rates, each higher than the one before; one more than in ``to``")
    unit: str
    source: Source


class Range(Table):
    """An interval from which initial stocks are drawn uniformly."""

    low: Number
    high: Number
    unit: str
    source: Source


def _moment(moment: object) -> object:
    if isinstance(moment, int | float | date) and not isinstance(moment, bool | datetime):
        return moment
    raise PydanticCustomError("moment", "must be a number, such as the year 2000 or 2000.5, or a date, as 2020-03-01")


Time = Annotated[
    Any,
    BeforeValidator(_moment),
    WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "string", "format": "date"}]}),
]
Interpolation = Annotated[
    Literal["step", "linear"],
    Field(description="``step``: a value holds until the next one; ``linear``: straight lines between them"),
]
TimeUnit = Annotated[
    str | None,
    Field(
        description="unit of times that count from the start of the episode; without it they are calendar years or "
        "dates, for which [episode] has a start"
    ),
]


class AmountSeries(Table):
    """Numbers that change in time, in the unit of the table in which they stand."""

    times: list[Time] = Field(description="when each value holds; the first not after the start of the episode")
    values: list[Number] = Field(description="one for each time", min_length=1)
    interpolation: Interpolation = "step"
    time_unit: TimeUnit = None
    until: Time | None = Field(
        None, description="when the last value ceases to hold; by default never with steps, at its time with lines"
    )


class SeriesTable(AmountSeries, StatedTable):
    """A quantity that changes in time."""

    unit: str
    source: Source


class RecordColumn(Table):
    """Numbers of a column of a CSV file, in the order of its rows and in the unit of the table in which they stand."""

    file: str = Field(description="name of the file, which lies in the folder of the definition or below it")
    column: str = Field(description="the column with the numbers")
    where: dict[str, str] = Field(
        {}, description="texts by which rows are chosen, by column; {region} in a text stands for that of [regions]"
    )
    times: str | None = Field(
        None, description="the column with the times; default: ``year``, if there is one that ``where`` leaves free"
    )


class AmountColumn(RecordColumn):
    """Numbers of a CSV file, in the unit of the table in which they stand; a single one if they have no times."""

    interpolation: Interpolation = "step"
    time_unit: TimeUnit = None


class ColumnTable(AmountColumn, StatedTable):
    """A quantity that stands in a CSV file; the last step holds as long as the one before it."""

    unit: str
    source: Source


WORD, VALUE, PIECES, SERIES, COLUMN = FORMS = ("<word>", "<value>", "<pieces>", "<series>", "<column>")
"""Tags of the forms in which a number that may vary is given; in pydantic's mistakes they stand among the keys."""


def _form(entry: object) -> str:
    keys = set(entry) if isinstance(entry, dict) else set()
    if {"to", "to_unit"} & keys:
        return PIECES
    return COLUMN if {"file", "column", "where"} & keys else SERIES if {"times", "values"} & keys else VALUE


def number_forms(value: Any, series: Any, column: Any, word: str = "", pieces: Any = None) -> Any:
    """Return the type of a number that may be given in several forms, which its keys tell, or as a word.

    Without ``value`` it has to change in time.
    """
    kinds = [(value, VALUE), (pieces, PIECES), (series, SERIES), (column, COLUMN)]
    forms = [Annotated[kind, Tag(tag)] for kind, tag in kinds if kind is not None]
    if not word:
        return Annotated[Union[*forms], Discriminator(_form)]
    discriminator = Discriminator(lambda kinds: WORD if isinstance(kinds, str) else _form(kinds))
    return Annotated[Union[*forms, Annotated[Literal[word], Tag(WORD)]], discriminator]


if not TYPE_CHECKING:
    Factor = number_forms(QuantityTable, SeriesTable, ColumnTable) | None
for _table in (StatedTable, QuantityTable, PiecesTable, SeriesTable, ColumnTable):
    _table.model_rebuild()


def forms(kind: Any) -> dict[str, Any]:
    """Return the forms of a number that may vary, by tag; none of other types."""
    by_tag: dict[str, Any] = {}
    for alternative in get_args(kind):
        tags = [note.tag for note in getattr(alternative, "__metadata__", ()) if isinstance(note, Tag)]
        by_tag |= {tags[0]: get_args(alternative)[0]} if tags else forms(alternative)
    return by_tag


Record = Annotated[
    Annotated[list[Number], Tag(VALUE)] | Annotated[RecordColumn, Tag(COLUMN)],
    Discriminator(lambda entry: COLUMN if isinstance(entry, dict) else VALUE),
]
VaryingAmount = number_forms(Number, AmountSeries, AmountColumn)
