"""The command line in a test: how it is called, and the small network that it is called with."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from cirl_marl import cli
from cirl_marl.definitions.catalogue import folder

SOURCE = """
[nodes.world]
role = "technosphere"
initial = { low = 30, high = 30, unit = "t", source = "too little" }
[arcs.imports]
from = "world"
to = "households"
law = "controlled"
control = { kind = "flow", low = 0, neutral = 10, high = 20, unit = "t/day", source = "trade" }
"""
"""A node and an arc that the guide's network may be given besides."""


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run ``cirl`` with ``arguments`` and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["cirl", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


def bottles(**changes: str) -> None:
    """Write the small network of the guide as ``bottles.toml``, with some texts replaced."""
    Path("bottles.toml").write_text(guide(changes))


def guide(changes: Mapping[str, str] | None = None, days: int = 7) -> str:
    """Return the definition of the small network of the guide, with some texts replaced."""
    text = (folder("envs") / "README.md").read_text().split("```toml\n")[1].split("```")[0]
    for old, new in {"value = 60": f"value = {days}", **(changes or {})}.items():
        text = text.replace(old, new)
    return text
