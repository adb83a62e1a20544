"""Pages that tests look at: of the small network of the guide, of texts that try to run, of groups."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

from cirl_marl import Arc, Control, ControlKind, Network, Node, Role
from cirl_marl.definitions.reader import Definition
from cirl_marl.network.elements import Episode

GUIDE = Path(__file__).parent.parent / "envs" / "README.md"
HOSTILE = "</script><script>document.title='run'</script><img src=x onerror=document.title='run'>\u2028'\"&amp;{{data}}"
"""A text that becomes a script, an element, a line or a part of the template where it is not taken as text."""
COMPUTED = "=HYPERLINK(1)"
"""A text that a spreadsheet would compute."""


def shown(page: str) -> Any:
    """Return the values of a page."""
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, flags=re.DOTALL)
    return json.loads(text)


def bottles_at(folder: Path, *, hostile: bool = False, days: int = 12) -> Network:
    """Return the small network of the guide, read from a file in ``folder``; hostile in its titles and sources."""
    text = GUIDE.read_text(encoding="utf-8").split("```toml\n")[1].split("```")[0]
    text = text.replace("value = 60", f"value = {days}")
    if hostile:
        said = json.dumps(HOSTILE)
        for old, new in {
            '"Glass bottles of a town"': said,
            '"5 t/d of 10 000 t"': said,
            "[arcs.glassworks]": f"[arcs.glassworks]\ntitle = {said}",
            "[nodes.quarry]": f"[nodes.quarry]\ntitle = {json.dumps(COMPUTED)}",
            "[services.bottles_in_use]": f"[services.bottles_in_use]\ntitle = {said}",
        }.items():
            assert old in text
            text = text.replace(old, new, 1)
    path = folder / "bottles.toml"
    path.write_text(text, encoding="utf-8")
    return Definition(path).network()


def world(countries: int = 4, members: int = 16, horizon: int = 3) -> Network:
    """Return countries, each a chain with a loop, that trade through markets; titles name the country first."""
    markets = {"market": "World market", "store": "World store"}
    nodes = [Node(id=id_, title=title, initial=(50.0, 50.0), scale=50.0) for id_, title in markets.items()]
    arcs = [Arc(id="stored", donor="market", recipient="store", rate=0.1)]
    for c in range(countries):
        ids = [f"c{c}_{i}" for i in range(members)]
        for i, id_ in enumerate(ids):
            role = {0: Role.NONRENEWABLE_RESERVOIR, members - 1: Role.LANDFILL}.get(i, Role.TECHNOSPHERE)
            nodes.append(Node(id=id_, title=f"Country {c}: part {i}", role=role, initial=(9.0, 11.0), scale=10.0))
        ends = [*pairwise(ids), (ids[-3], ids[2]), (ids[3], "market"), ("market", ids[3]), ("store", ids[4])]
        control = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=2.0)
        arcs += [
            Arc(id=f"c{c}_flow{k}", donor=a, recipient=b, rate=0.1, control=control if k == 0 else None)
            for k, (a, b) in enumerate(ends)
        ]
    return Network(name="world", nodes=tuple(nodes), arcs=tuple(arcs), episode=Episode(horizon=horizon))
