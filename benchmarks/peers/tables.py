"""What trainings of all contenders come to: figures for a file, and two tables for a document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from statistics import median
from typing import Any

from benchmarks.document import markdown_table
from benchmarks.peers.contenders import CONTENDERS
from benchmarks.peers.gaps import Standing, reached
from benchmarks.peers.settings import GOALS, SERVICE
from benchmarks.peers.watch import Record

OURS = "stacked"
"""Whose speed peers are held against."""
FASTER = 20.0
"""Times the fastest peer that ours should be."""

Rounds = Mapping[str, Sequence[Record]]
Standings = Mapping[str, Sequence[Standing]]


def speed_table(rounds: Rounds, agents: int) -> str:
    """Return agent-steps per second of each, the slowest first, and how many times as many ours does in its round."""
    order = sorted(rounds, key=lambda name: median(record.processor_rate for record in rounds[name]))
    rows = [
        (
            CONTENDERS[name].title,
            f"{agents * median(record.processor_rate for record in rounds[name]):,.0f}",
            f"{agents * median(record.rate for record in rounds[name]):,.0f}",
            f"{times(rounds, name):.2g} ×",
        )
        for name in order
    ]
    return markdown_table(("who", "agent-steps per processor second", "per second", "ours, stacked / it"), rows)


def verdict(rounds: Rounds, names: Sequence[str]) -> str:
    """Say whether ours is so many times as fast as the fastest of those that are named."""
    fastest = max(names, key=lambda name: median(record.processor_rate for record in rounds[name]))
    ratio = times(rounds, fastest)
    met = "met" if ratio >= FASTER else "missed"
    return f"{ratio:.2g} times the agent-steps of {CONTENDERS[fastest].title} (goal: ≥ {FASTER:g}, {met})"


def times(rounds: Rounds, name: str) -> float:
    """Return how many times as many agent-steps ours does per processor second, the median over the rounds."""
    pairs = zip(rounds[OURS], rounds[name], strict=True)
    return median(ours.processor_rate / its.processor_rate for ours, its in pairs)


def gap_table(standings: Standings) -> str:
    """Return when each first came near enough to the bound, at the service that is demanded or any, and its end."""
    demanded = [f"{goal:.0%} at service ≥ {SERVICE:g}" for goal in GOALS]
    columns = (
        "who",
        *demanded,
        *(f"{goal:.0%} at any" for goal in GOALS),
        "in the end",
        "service",
        "environment steps",
    )
    rows = []
    for name, each in standings.items():
        last = each[-1]
        when = [_when(reached(each, goal, service), last) for service in (SERVICE, 0.0) for goal in GOALS]
        rows.append((CONTENDERS[name].title, *when, f"{last.gap:.0%}", f"{last.service:.3f}", f"{last.steps:,}"))
    return markdown_table(columns, rows)


def figures(rounds: Rounds, standings: Standings, setups: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return all figures, ready for JSON."""
    speed = {
        name: [
            {
                "env_steps_per_second": record.rate,
                "env_steps_per_processor_second": record.processor_rate,
                "rollouts": len(record.laps) - 1,
                "load": record.load,
                "setup": record.setup,
            }
            for record in records
        ]
        for name, records in rounds.items()
    }
    gaps = {
        name: {
            "setup": setups[name],
            "first_at_gap": {
                f"{goal:g}": None if (one := reached(each, goal)) is None else asdict(one) for goal in GOALS
            },
            "standings": [asdict(one) for one in each],
        }
        for name, each in standings.items()
    }
    return {"service": SERVICE, "speed": speed, "gaps": gaps}


def _when(found: Standing | None, last: Standing) -> str:
    """Return the seconds of the processor until then, or that they are more than there were."""
    return f"> {last.processor:,.0f} s" if found is None else f"{found.processor:,.0f} s"
