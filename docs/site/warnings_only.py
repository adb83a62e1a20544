"""What ``mkdocs`` calls first: it prints warnings and errors, and not what it is at."""

from __future__ import annotations

import logging
from typing import Any


def on_startup(**_: Any) -> None:
    """Raise the level of the handler that prints; with ``--quiet`` a strict build would not count warnings either."""
    for handler in logging.getLogger("mkdocs").handlers:
        if isinstance(handler, logging.StreamHandler):
            handler.setLevel(logging.WARNING)
