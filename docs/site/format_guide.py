"""The fields of the file format as a document, from their declarations: ``python -m docs.site.format_guide``.

Writes ``docs/format.md`` and the schemas of files.
"""

from __future__ import annotations

import textwrap
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from cirl_marl.definitions import quantities, schema
from docs.site.markdown import ROOT
from docs.site.schemas import write_schemas

PARTS: dict[str, tuple[Any, str]] = {
    "network": (schema.NetworkTable, "The file itself"),
    "copies": (schema.CopiesTable, "`[copies]`, and, without `of` and `regions`, `copies` of a scenario"),
    "units": (schema.UnitsTable, "`[units]`"),
    "scales": (schema.ScalesTable, "`[scales]`"),
    "episode": (schema.EpisodeTable, "`[episode]`"),
    "objective": (schema.ObjectiveTable, "`[objective]`"),
    "observation": (schema.ObservationTable, "`[observation]`"),
    "node": (schema.NodeTable, "`[nodes.NAME]`"),
    "arc": (schema.ArcTable, "`[arcs.NAME]`"),
    "control": (schema.ControlTable, "`control` of a node or an arc"),
    "lifetime": (schema.LifetimeTable, "`lifetime` of a node"),
    "rule": (schema.RuleTable, "`rule` of a node or an arc"),
    "model": (schema.ModelTable, "`model` of a node or an arc"),
    "service": (schema.ServiceTable, "`[services.NAME]`"),
    "account": (schema.AccountTable, "`[accounts.NAME]`"),
    "substance": (schema.SubstanceTable, "`[substances.NAME]`"),
    **{kind: (table, f'`[disturbances.NAME]` with `kind = "{kind}"`') for kind, table in schema.DISTURBANCES.items()},
    "correlation": (schema.CorrelationTable, "`[disturbance_correlation]`"),
    "quantity": (quantities.QuantityTable, "Every number with a unit"),
    "pieces": (quantities.PiecesTable, "For a rate on an account"),
    "series": (quantities.SeriesTable, "For a quantity; in a control without `unit` and `source`, which are its own"),
    "column": (quantities.ColumnTable, "For a quantity; in a control without `unit` and `source`, which are its own"),
    "range": (quantities.Range, "`initial` of a node"),
    "batches": (schema.Batches, "`batches` of an arc"),
}


def format_guide() -> str:
    """Return the document: a list of keys for each table of a definition file."""
    parts = [_part(name, table, place) for name, (table, place) in PARTS.items()]
    return (
        "# The format of definition files\n\n"
        "Every key of every table, to look things up; `envs/README.md` shows how to write a network.\n"
        "This page is made from the declarations in `cirl_marl/network/elements.py`: change them, not the page.\n"
        + "".join(parts)
    )


def _part(name: str, table: type[BaseModel], place: str) -> str:
    keys = "".join(_key(field.alias or key, field) for key, field in table.model_fields.items())
    summary = str(table.__doc__).partition("\n")[0].replace("``", "`")
    return f"\n## {name}\n\n{_wrap(f'{place}. {summary}', indent=0)}\n{keys}"


def _key(key: str, field: FieldInfo) -> str:
    """Return the line of a key: what it takes, if that is a table of its own, and what it means."""
    kinds = [*quantities.forms(field.annotation).values(), field.annotation]
    kinds += get_args(field.annotation)
    tables = [name for name, (table, _) in PARTS.items() if {table, *table.__bases__} & set(kinds)]
    necessity = "required" if field.is_required() else "may be left out"
    about = f": {field.description.replace('``', '`')}" if field.description else ""
    return _wrap(f"- `{key}` ({', '.join([*(f'[{name}](#{name})' for name in tables), necessity])}){about}.")


def _wrap(line: str, indent: int = 2) -> str:
    return (
        textwrap.fill(line, 120, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False) + "\n"
    )


if __name__ == "__main__":
    (ROOT / "docs" / "format.md").write_text(format_guide(), encoding="utf-8")
    write_schemas()
