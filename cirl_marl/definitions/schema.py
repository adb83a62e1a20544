"""The shape of a definition file: strict, typed tables in which each number has a value, a unit and a source.

The tables of nodes, arcs, controls, services and settings follow from the declarations in ``network.elements``; only
what files spell otherwise than Python is written out here.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Union, get_type_hints

from pydantic import BaseModel, Discriminator, Field, StrictBool, Tag, create_model
from pydantic.json_schema import SkipJsonSchema

from cirl_marl.definitions import quantities
from cirl_marl.network.declarations import (
    CalendarTime,
    Declaration,
    Numbers,
    Quantity,
    Rates,
    Subtable,
    Word,
    declarations,
    default_of,
    is_required,
)
from cirl_marl.network.disturbances import KINDS, Correlation
from cirl_marl.network.elements import (
    IDENTIFIER,
    Account,
    Arc,
    Control,
    Episode,
    FeedbackRule,
    Lifetime,
    Node,
    Objective,
    Observation,
    Service,
    Substance,
)

Identifier = Annotated[str, Field(pattern=IDENTIFIER)]
IN_MODEL = ("inner", "reward_scale")
"""Fields of compartments that stand in the table of their model."""


class Batches(quantities.Table):
    """Discrete masses: ``masses[i]`` leaves the donor at ``times[i]``, at the start of a control interval."""

    times: list[quantities.Number]
    time_unit: str
    masses: list[quantities.Number]
    unit: str
    source: quantities.Source


class InnerRange(quantities.Table):
    """Initial range of an inner state, in the unit that its name carries."""

    low: quantities.Number
    high: quantities.Number
    source: quantities.Source


class ModelTable(quantities.Table):
    """Inner physics of a compartment."""

    kind: str = Field(description="name of a compartment model")
    form: str | None = Field(None, description="form of the equations, such as 'published' or 'sound'")
    parameters: dict[str, StrictBool | quantities.Number] = Field(
        {}, description="parameters that differ from the model's own, by name"
    )
    source: quantities.Source
    initial: dict[str, InnerRange] = Field(
        {}, description="initial range of each inner state that the model does not draw"
    )
    reward_scale: quantities.QuantityTable | None = Field(
        None, description="the model's reward is divided by it, unit '1'; default 1"
    )


def table_of(record: type[Any], **more: Any) -> Any:
    """Return the table of a part: a key for each declared field, with ``more`` that Python has otherwise."""
    fields, hints = declarations(record), get_type_hints(record)
    if unspelt := [n for n, d in fields.items() if isinstance(d, Numbers) and not d.table_form and n not in IN_MODEL]:
        raise TypeError(f"{record.__name__}: numbers need a spelling in definition files: {', '.join(unspelt)}")
    types = {name: _field_type(field, hints[name]) for name, field in fields.items() if name not in IN_MODEL}
    keys = {name: _key(record, name, kind) for name, kind in types.items() if kind is not None}
    of_table = any(isinstance(declaration, Quantity) and declaration.unit_of_table for declaration in fields.values())
    if of_table or quantities.VaryingAmount in types.values():
        more |= {"unit": (str, ...), "source": (quantities.Source, ...)}
    summary = str(record.__doc__).partition("\n")[0]
    return create_model(f"{record.__name__}Table", __base__=quantities.Table, __doc__=summary, **{**keys, **more})


def _key(record: type[Any], name: str, kind: Any) -> tuple[Any, Any]:
    """Return type and pydantic field of a declared field; what is left out is None, or its default if that is plain."""
    declaration, default = declarations(record)[name], default_of(record, name)
    options: dict[str, Any] = {"description": declaration.meaning, "alias": declaration.key or None}
    if is_required(record, name):
        return kind, Field(**options)
    if isinstance(declaration, Rates):
        return kind, Field({}, **options)
    if isinstance(declaration, Quantity | Numbers | Subtable | CalendarTime):
        return kind | None, Field(None, **options)
    return kind, Field(list(default) if isinstance(default, tuple) else default, **options)


def _field_type(declaration: Declaration, hint: Any) -> Any:
    """Return the type of a declared field in a file; None if it stands in the table of another."""
    if isinstance(declaration, Word):
        return declaration.of if isinstance(declaration.of, type) else Literal[declaration.of]
    if isinstance(declaration, Numbers):
        tables: dict[str, Any] = {
            "range": quantities.number_forms(quantities.Range, None, quantities.ColumnTable),
            "batches": Batches,
            "amount": quantities.VaryingAmount,
            "list": list[quantities.Number],
            "matrix": list[list[quantities.Number]],
            "record": quantities.Record,
        }
        return tables[declaration.table_form] if declaration.table_form else None
    if isinstance(declaration, Subtable):
        return {"control": ControlTable, "lifetime": LifetimeTable, "model": ModelTable, "rule": RuleTable}[
            declaration.of
        ]
    if isinstance(declaration, CalendarTime):
        return quantities.Time
    if isinstance(declaration, Rates):
        number = VaryingQuantity if declaration.number.varies else FixedQuantity
        number = AccountRate if declaration.of == "account" else number
        return dict[Identifier, number]  # type: ignore[valid-type]
    if isinstance(declaration, Quantity) and declaration.unit_of_table:
        return quantities.Number
    if isinstance(declaration, Quantity) and declaration.past:
        return quantities.number_forms(None, quantities.SeriesTable, quantities.ColumnTable)
    if isinstance(declaration, Quantity) and declaration.varies:
        return quantities.number_forms(
            quantities.QuantityTable, quantities.SeriesTable, quantities.ColumnTable, declaration.none_word
        )
    if isinstance(declaration, Quantity):
        return FixedQuantity
    return {bool: StrictBool, tuple[str, ...]: list[str]}.get(hint, hint)


def _disturbance_table(kind: str) -> Any:
    """Return the table of a kind of disturbance, which says its kind."""
    word = Field(description=f"``{kind}``; other kinds: {', '.join(other for other in KINDS if other != kind)}")
    unit = Field(description=declarations(KINDS[kind])["unit"].meaning)
    return table_of(KINDS[kind], kind=(Literal[kind], word), unit=(str, unit), source=(quantities.Source, ...))


VaryingQuantity = quantities.number_forms(quantities.QuantityTable, quantities.SeriesTable, quantities.ColumnTable)
AccountRate = quantities.number_forms(
    quantities.QuantityTable, quantities.SeriesTable, quantities.ColumnTable, pieces=quantities.PiecesTable
)
FixedQuantity = quantities.number_forms(quantities.QuantityTable, None, quantities.ColumnTable)
_OF_CONTROL = {
    "disturbed_by": "name of a disturbance of its capacity, the value at action +1",
    "deviation": "standard deviation of its neutral value (of ``high`` where that is 0), in the same unit or relative; "
    "what is drawn multiplies all three values",
    "range": "lowest and highest neutral value that it may have; of a share at most 1",
}
_STATED: dict[str, Any] = {}
for _name in ("disturbed_by", "disturbed_as", "deviation", "range", "distribution"):
    _stated = quantities.StatedTable.model_fields[_name]
    _STATED[_name] = (_stated.annotation, Field(None, description=_OF_CONTROL.get(_name, _stated.description)))
ControlTable = table_of(Control, **_STATED)
LifetimeTable = table_of(Lifetime)
RuleTable = table_of(FeedbackRule)
NodeTable = table_of(Node)
ArcTable = table_of(Arc)
ServiceTable = table_of(Service)
AccountTable = table_of(Account)
SubstanceTable = table_of(Substance)
EpisodeTable = table_of(Episode)
ObjectiveTable = table_of(Objective)
ObservationTable = table_of(Observation)
DISTURBANCES: dict[str, Any] = {kind: _disturbance_table(kind) for kind in KINDS}
"""The table of each kind of disturbance."""
CorrelationTable = table_of(Correlation, source=(quantities.Source, ...))


class NoKind(BaseModel):
    """A disturbance that says none of the kinds there are."""

    kind: Literal[tuple(KINDS)]  # type: ignore[valid-type]


def _disturbance_kind(entry: Any) -> str:
    kind = entry.get("kind") if isinstance(entry, dict) else None
    return f"<{kind}>" if kind in KINDS else "<kind>"


_BY_KIND = {**DISTURBANCES, "kind": SkipJsonSchema[NoKind]}
_KIND_TABLES = [Annotated[table, Tag(f"<{kind}>")] for kind, table in _BY_KIND.items()]
DisturbanceTable = Annotated[Union[*_KIND_TABLES], Discriminator(_disturbance_kind)]  # type: ignore[valid-type]


class UnitsTable(quantities.Table):
    """Units in which the network is simulated and reported."""

    mass: str
    time: str


class ScalesTable(quantities.Table):
    """Reference stock and flow of compartments that state none of their own."""

    stock: FixedQuantity  # type: ignore[valid-type]
    flow: FixedQuantity  # type: ignore[valid-type]


Changes = Annotated[dict[Identifier, dict[str, Any]], Field(default_factory=dict)]


class CopiesTable(quantities.Table):
    """Copies of another definition, side by side in this one."""

    of: str = Field(description="the definition that is copied, a file in the same folder or below it, with regions")
    regions: list[Identifier] = Field([], description="which of its regions; default: all")
    without: list[str] = Field([], description="what is left out of each copy first, as dotted paths")
    agents: list[str] = Field([], description="who acts in each copy, by the names there; default: those who do there")
    nodes: Changes = Field(description="tables laid over those of each copy, key by key, as in scenarios")
    arcs: Changes = Field(description="likewise; ends that are no node of the copy are nodes of this definition")
    services: Changes = Field(description="likewise")
    disturbances: Changes = Field(description="likewise, or new ones; those that are ``common`` stand in no copy")


class NetworkTable(quantities.Table):
    """A material network."""

    name: Identifier
    title: str
    material: str
    references: list[str] = Field([], description="where its numbers come from, as a whole")
    regions: dict[Identifier, str] = Field(
        {},
        description="if the file stands for several networks: by what the name of each ends in, the text for which "
        "{region} stands in its title and in ``where``",
    )
    units: UnitsTable
    episode: EpisodeTable  # type: ignore[valid-type]
    scales: ScalesTable
    objective: ObjectiveTable  # type: ignore[valid-type]
    observation: ObservationTable  # type: ignore[valid-type]
    agents: list[str] = Field([], description="who acts; default: every compartment with a control")
    copies: CopiesTable | None = Field(
        None,
        description="if it has copies of another definition: each name in a copy then begins with its region and '_'",
    )
    nodes: dict[Identifier, NodeTable]  # type: ignore[valid-type]
    arcs: dict[Identifier, ArcTable]  # type: ignore[valid-type]
    services: dict[Identifier, ServiceTable] = Field({})  # type: ignore[valid-type]
    accounts: dict[Identifier, AccountTable] = Field(  # type: ignore[valid-type]
        {}, description="what is counted beside mass: money, emissions, energy"
    )
    substances: dict[Identifier, SubstanceTable] = Field(  # type: ignore[valid-type]
        {}, description="what the material has in it, such as tramp elements, alloys or additives"
    )
    disturbances: dict[Identifier, DisturbanceTable] = Field(
        {}, description="processes in time that disturb the quantities that name them in ``disturbed_by``"
    )
    disturbance_correlation: CorrelationTable | None = Field(  # type: ignore[valid-type]
        None, description="what correlates them; left out, they are independent"
    )
    scenarios: dict[Identifier, dict[str, Any]] = Field(
        {},
        description="tables that replace those of the default scenario, key by key, or add nodes, arcs and services, "
        "after those named in 'without', such as 'nodes.digester.model', are left out",
    )
