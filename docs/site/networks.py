"""A page for each network of the catalogue, made from its definition and from results that are kept."""

from __future__ import annotations

import csv
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.best_plans import LEFT_OUT, read_plan, replayed
from cirl_marl import MultiAgentVectorEnv, Network, load_network, simulate
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import episode_start, rollout
from cirl_marl.controllers.schedule import Schedule
from cirl_marl.definitions.sources import stated_numbers, stated_settings
from cirl_marl.drawing.digraph import save_network
from cirl_marl.drawing.folding import fold_copies as folded_network
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats
from cirl_marl.network.calendar import labels
from cirl_marl.network.declarations import TimeDependent
from cirl_marl.network.elements import Law, Service
from cirl_marl.optimum import gap
from cirl_marl.report.decisions import decisions_table, save_decisions, savings_table, settings
from cirl_marl.report.page_html import write_page
from cirl_marl.report.report_page import page_of_alternatives
from cirl_marl.report.terminal import arcs_table, nodes_table
from docs.site.markdown import ROOT, GeneratedPage, folded, sections_about, shown, table

STUDY = ROOT / "benchmarks" / "results" / "study"
LEGIBLE = 20
"""Nodes up to which a picture is read at the width of a page."""
TERMS = 16
"""Flows up to which the formula of λ names each."""
SAME = 1e-6
"""Relative difference of λ̄ that rounding makes between machines."""


def network_page(name: str) -> GeneratedPage:
    """Return the page of a network.

    Raises:
        CirlError: if a result that it shows is missing, or of another definition.
    """
    network = load_network(name)
    env = MultiAgentVectorEnv(network, num_envs=1)
    begun = episode_start(env, None)
    begun.reset(env)
    stock, flow = env.rows.stocks(env.physical.stock)[:, 0].copy(), env.physical.flow[:, 0].copy()
    circularity = float(network.circularity(flow))
    files: dict[str, bytes] = {}
    if len(network.nodes) <= LEGIBLE or network.copies:
        save = partial(save_network, network=network, stock=stock, flow=flow, circularity=circularity)
        files[f"{name}.png"] = _picture("png", save)
    else:
        report = page_of_alternatives([simulate(network)])
        files[f"{name}_flows.html"] = _picture("html", lambda path: write_page(path, report))
    folded_away, stocks, flows = folded_network(network, stock, flow)
    parts = [
        f"# {name}",
        f"{network.title}. {_size(network)}",
        _more(name, network),
        _drawing(name, files),
        f"Stocks and flows at the start of an episode: {begun.description}. λ = {circularity:.5g} {network.mass_unit}.",
        "## Circularity",
        _formula(network),
        "## Services",
        _services(network),
        "## Compartments",
        _copies(network),
        shown(nodes_table(folded_away, stocks)),
        shown(arcs_table(folded_away, flows)),
        "`in λ` says with which sign a flow counts. A control is given by its lowest, neutral and highest value.",
        "## What agents set and see",
        *_spaces(network, env),
        "## Bound and best plan",
        *_plan(name, files),
        *_learners(name),
        "## Every number and its source",
        *_sources(network),
    ]
    return GeneratedPage(f"networks/{name}.md", name, "\n\n".join(part for part in parts if part) + "\n", files)


def _drawing(name: str, files: Mapping[str, bytes]) -> str:
    """Show the picture or, of a network too large for one, the diagram of a report for the browser."""
    if f"{name}.png" in files:
        return f"![{name} at the start of an episode]({name}.png)"
    frame = f'<iframe class="flows" src="{name}_flows.html#network" title="Flows of {name} as usual"></iframe>'
    return f"{frame}\n\nWhile nobody acts, year by year: [open it alone]({name}_flows.html)."


def _picture(kind: str, save: Callable[[Path], object]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"picture.{kind}"
        save(path)
        return path.read_bytes()


def _size(network: Network) -> str:
    episode, mass = network.episode, network.mass_unit
    calendar, dates = labels(network, np.array([0.0, episode.horizon * episode.control_interval]))
    when = f", {calendar[0]} {dates[0][0]} to {dates[0][-1]}" if dates else ""
    return (
        f"{len(network.compartments)} compartments ({len(network.nodes)} nodes, {len(network.arcs)} arcs), "
        f"{len(network.agents)} agents. An episode has {episode.horizon} decisions, one every "
        f"{episode.control_interval:g} {network.time_unit}{when}. Masses are in {mass}, flows in "
        f"{mass}/{network.time_unit}."
    )


def _more(name: str, network: Network) -> str:
    """Say where more is told: sections of the documents, the definition itself, scenarios."""
    assert network.source is not None
    file = f"[{network.source.name}](../envs/{network.source.name})"
    why = " and ".join(sections_about(name, network.source.name))
    scenarios = ", ".join(f"`{each}`" for each in network.scenarios)
    said = f"Definition: {file}. Why it is as it is: {why}." if why else f"Definition: {file}."
    more = f" Other scenarios: {scenarios}." if scenarios else ""
    return f"{said}{more} This page is about the default one.\n\n```\ncirl show {name}\ncirl train {name}\n```"


def _formula(network: Network) -> str:
    """Write λ as it follows from the roles."""
    delta = f"Δ = {network.objective.reference_interval:g} {network.time_unit}"
    counted = [(float(sign), arc) for sign, arc in zip(network.sustainability, network.arcs, strict=True) if sign]
    if not counted:
        return "No flow counts: λ is 0."
    if len(counted) > TERMS:
        lowering = sum(sign > 0 for sign, _ in counted)
        return f"λ = −Δ·(sum of {lowering} flows − sum of {len(counted) - lowering} flows), {delta}; see the tables."
    terms = " ".join(f"{'+' if sign > 0 else '−'} {arc.id}" for sign, arc in counted).removeprefix("+ ")
    batches = [arc.id for _, arc in counted if arc.law is Law.BATCH]
    moved = f" {', '.join(batches)} move batches, of which the masses count once they have moved." if batches else ""
    return f"It follows from the roles, with {delta}:\n\n    λ = −Δ·({terms})\n\n{moved}".rstrip()


def _services(network: Network) -> str:
    own = [service for service in network.services if _is_own(network, service.id)]
    rows = [_service(network, each) for each in own]
    left = len(network.services) - len(own)
    said = f"\n\nThe {left} services of the copies are those of the network that is copied." if left else ""
    columns = ("service", "what is measured", "at least", "at most", "weight", "owed by")
    return (table(columns, rows) if rows else "") + said or "None: stopping everything is the best policy here."


def _service(network: Network, service: Service) -> tuple[str, ...]:
    measured = f"{service.measure or service.quantity} of {' and '.join(service.providers)}"
    owed = ", ".join(service.debtors) if len(service.debtors) <= TERMS else f"{len(service.debtors)} compartments"
    low, high = _value(service.low), _value(service.high)
    ends = ("" if low == "0" else low, "" if high == "inf" else high)
    return f"`{service.id}`", measured, *ends, f"{service.weight:g}", owed


def _value(value: object) -> str:
    """Write a number, or the ends of one that changes in time."""
    if not isinstance(value, TimeDependent):
        return f"{value:g}"
    low, high = value.extremes
    return f"{low:.5g} … {high:.5g} in time"


def _is_own(network: Network, id_: str) -> bool:
    """Whether a compartment or service stands in the definition itself, and not in a copy."""
    return not any(id_.startswith(f"{region}_") for region in network.copies)


def _copies(network: Network) -> str:
    if not network.copies:
        return ""
    return (
        f"{len(network.copies)} copies, each drawn and listed as one box: {', '.join(network.copies)}. What such a "
        "copy is made of stands on the page of the network that is copied."
    )


def _spaces(network: Network, env: MultiAgentVectorEnv) -> Iterator[str]:
    """Yield what agents set, in physical units, and what they see, with what it is divided by."""
    low, neutral, high = network.control_bounds
    own = [agent for agent in env.agents if _is_own(network, agent)]
    if not own:
        yield "All agents are those of the copies."
        return
    yield "An action is a number in [−1, 1] for each row, from the lowest value to the highest."
    rows = [
        (f"`{each.agent}`", each.name, each.kind.value + (f" of {each.of}" if each.of else ""),
         *(_span(ends[each.row]) for ends in (low, neutral, high)), each.unit.replace("1", ""))
        for each in settings(network, own)
    ]  # fmt: skip
    yield table(("agent", "called", "sets", "lowest", "neutral", "highest", "unit"), rows)
    entries = [
        (f"`{agent}`", entry, _divisor(network, entry), f"{space.low[i]:.4g}", f"{space.high[i]:.4g}")
        for agent in own
        for space in (env.observation_spaces[agent],)
        for i, entry in enumerate(env.observation_names[agent])
    ]
    said = table(("agent", "entry of its observation", "divided by", "lowest", "highest"), entries)
    yield folded(f"What they see: {len(entries)} entries", said)


def _span(values: Floats) -> str:
    return f"{values[0]:.4g}" if (values == values[0]).all() else f"{values[0]:.4g} … {values[-1]:.4g} in time"


def _divisor(network: Network, entry: str) -> str:
    """Say what a signal is divided by, with its unit; nothing if it is shown as it is."""
    what, _, id_ = entry.partition(" of ")
    mass, flow = network.mass_unit, f"{network.mass_unit}/{network.time_unit}"
    if id_ not in network.compartments:
        return "the horizon" if entry == "time" else ""
    level = mass if id_ in network.node_index and network.nodes[network.node_index[id_]].stores else flow
    unit = {"stock": mass, "throughput": flow, "flow": flow, "set-point": level}[what]
    return f"{network.compartments[id_].scale:g} {unit}"


def _plan(name: str, files: dict[str, bytes]) -> Iterator[str]:
    """Yield what is proved and planned, from the kept plan, which is carried out anew."""
    if name in LEFT_OUT:
        yield f"{LEFT_OUT[name].capitalize()}."
        return
    kept = read_plan(name)
    found = replayed(kept)
    network, run, usual = found.network, found.rollout, found.usual
    mass = network.mass_unit
    rows: list[tuple[object, ...]] = [
        ("nobody acts", float(usual.episode_circularity[0]), float(usual.least_service[0]), ""),
        ("best plan known", float(run.episode_circularity[0]), float(run.least_service[0]), ""),
    ]
    if kept.bound is not None:
        off = float(gap(kept.bound, kept.circularity))
        rows = [*rows[:1], (*rows[1][:3], f"{off:.2%}"), ("bound", kept.bound, f"≥ {kept.min_service:g}", "")]
        yield (
            f"From the start that is drawn above, with a mean level of every service of at least {kept.min_service:g}, "
            "no λ̄ exceeds the bound: [bound.md](../docs/bound.md)."
        )
    else:
        reason = kept.reason.rpartition("no bound is proved: ")[2]
        yield f"No bound is proved: {reason}. The plan is the best that was found by simulation, without certificate."
    yield table(("who acts", f"λ̄ ({mass})", "lowest service", "gap to the bound"), rows)
    yield f"What the plan does, beside business as usual:\n\n{shown(decisions_table(found))}"
    yield f"What it saves in an episode, in {mass}:\n\n{shown(savings_table(found))}"
    files[f"{name}_plan.png"] = _picture("png", lambda path: _draw(path, found, name))
    yield f"![The best plan of {name} and business as usual]({name}_plan.png)"
    yield f"Made by `python -m benchmarks.best_plans {name}`, and carried out anew for this page."


def _draw(path: Path, found: Schedule, name: str) -> None:
    save_decisions(path, found, title=f"{name}: λ and the levers that differ most")


def _learners(name: str) -> Iterator[str]:
    """Yield what learners reached in the study, if it was about this network."""
    path = STUDY / name / "summary.json"
    if not path.is_file():
        return
    check_study(name)
    found = json.loads(path.read_text(encoding="utf-8"))
    forms = (("circularity", "{:.4g}"), ("service", "{:.4f}"), ("bound", "{:.4g}"), ("gap", "{:.1%}"))
    rows = [
        (row["name"], len(row["seeds"]) or "", *(interval(row[which], form) for which, form in forms))
        for row in found["rows"]
    ]
    yield "## Learners"
    columns = ("who", "seeds", f"λ̄ ({found['unit']})", "mean service", "bound", "gap to the bound")
    yield table(columns, rows)
    yield (
        f"{found['episodes']} fresh episodes, the same for all. How the intervals are made and what each recipe does: "
        "[study.md](../docs/study.md)."
    )


def interval(figure: dict[str, float], form: str) -> str:
    """Write a figure with its interval, if it has one."""
    value, low, high = (figure[name] for name in ("value", "low", "high"))
    return form.format(value) if low is None else f"{form.format(value)} [{form.format(low)}, {form.format(high)}]"


def check_study(name: str, folder: Path = STUDY) -> None:
    """Refuse figures of learners that are of another network than the catalogue's: its neutral episodes are repeated.

    Raises:
        CirlError: naming the episode with another λ̄.
    """
    path = folder / name / "episodes.csv"
    with path.open(encoding="utf-8", newline="") as file:
        kept = [row for row in csv.DictReader(file) if row["name"] == "neutral"]
    seeds = [int(row["start seed"]) for row in kept]
    network = load_network(name)
    column = f"circularity ({network.mass_unit})"
    run = rollout(MultiAgentVectorEnv(network, num_envs=len(kept)), Neutral(), seed=seeds[0])
    for row, now in zip(kept, run.episode_circularity.tolist(), strict=True):
        before = float(row.get(column, "nan"))
        if not abs(now - before) <= SAME * abs(now):
            raise CirlError(
                f"{path}: episode {row['episode']} of neutral has λ̄ {now!r} now, not {before!r}: make study"
            )


def _sources(network: Network) -> Iterator[str]:
    told = stated_numbers(network)
    rows = [("", each) for each in stated_settings(network)]
    rows += [(f"`{id_}`", each) for part in told.values() for id_, found in part.items() for each in found]
    own = [(where, each) for where, each in rows if _is_own(network, where.strip("`"))]
    cells = [(where, f"`{each.key}`" if each.key else "", each.value, each.source) for where, each in own]
    yield table(("of", "what", "value", "source"), cells)
    if len(rows) > len(own):
        yield f"The {len(rows) - len(own)} of the copies stand on the page of the network that is copied."
    if network.references:
        yield "References:\n\n" + "\n".join(f"- {each}" for each in network.references)
