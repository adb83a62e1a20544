"""A small definition whose numbers the tests replace by series and columns."""

from __future__ import annotations

from pathlib import Path

SOURCE = 'source = "test"'
HEAD = f"""name = "ores"
title = "Ores"
material = "ore"

[units]
mass = "kt"
time = "year"

[scales]
stock = {{ value = 1, unit = "kt", {SOURCE} }}
flow = {{ value = 1, unit = "kt/year", {SOURCE} }}

[objective]
reference_interval = {{ value = 1, unit = "year", {SOURCE} }}
net_zero = "signed"
reward = "mixed"
circularity_scale = {{ value = 1, unit = "kt", {SOURCE} }}
circularity_weight = {{ value = 0.5, unit = "1", {SOURCE} }}

[observation]
mode = "local"

[episode]
control_interval = {{ value = 1, unit = "year", {SOURCE} }}
horizon = {{ value = 4, unit = "1", {SOURCE} }}
START
[nodes.mine]
role = "nonrenewable_reservoir"

[nodes.market]
role = "technosphere"
stores = false

[nodes.use]
role = "technosphere"
initial = {{ low = 0, high = 0, unit = "kt", {SOURCE} }}

[nodes.dump]
role = "landfill"
initial = {{ low = 0, high = 0, unit = "kt", {SOURCE} }}

[arcs.ore]
from = "mine"
to = "market"
law = "exogenous"
flow = FLOW

[arcs.sold]
from = "market"
to = "use"
law = "share"
SOLD

[arcs.lost]
from = "market"
to = "dump"
law = "share"
share = "rest"
"""
CONSTANT = f'{{ value = 10, unit = "kt/year", {SOURCE} }}'
HALF = f'share = {{ value = 0.5, unit = "1", {SOURCE} }}'
CSV = """country,year,kt,note
Japan,2000,10,a
Japan,2001,20,b
Japan,2002,30,
Japan,2003,40,d
China,2000,1,
China,2002,3,
"""


def definition(flow: str = CONSTANT, *, start: str = "", sold: str = HALF, more: str = "") -> str:
    """Return a definition with this flow of ore, start of the calendar and share that is sold."""
    head = HEAD.replace("START", f"start = {start}\n" if start else "")
    return head.replace("FLOW", flow).replace("SOLD", sold) + more


def column(more: str = 'where = { country = "Japan" }', file: str = "ores.csv", name: str = "kt") -> str:
    """Return a flow in a column of a file."""
    keys = ", ".join(filter(None, [f'file = "{file}", column = "{name}"', more]))
    return f'{{ {keys}, unit = "kt/year", {SOURCE} }}'


def written(folder: Path, text: str, csv: str | None = CSV) -> Path:
    """Write a definition and its data file, and return the path of the definition."""
    if csv is not None:
        (folder / "ores.csv").write_text(csv, encoding="utf-8")
    path = folder / "ores.toml"
    path.write_text(text, encoding="utf-8")
    return path
