"""Whether definitions may name code that is not imported yet. To read a file of somebody else must run nothing."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_PERMISSION = ContextVar("_ALLOWED", default=False)


@contextmanager
def code_allowed(permission: bool = True) -> Iterator[None]:
    """Let definitions that are read in the block import the models that they name, if ``permission``."""
    token = _PERMISSION.set(permission or _PERMISSION.get())
    try:
        yield
    finally:
        _PERMISSION.reset(token)


def is_code_allowed() -> bool:
    """Return whether definitions may import the models that they name; other processes have to be told."""
    return _PERMISSION.get()


def refusal(kind: str) -> str | None:
    """Return why the model of that kind may not be imported; None if it may, or need not be."""
    module = kind.partition(":")[0]
    if ":" not in kind or _PERMISSION.get() or module in sys.modules:
        return None
    return (
        f"kind '{kind}' would import '{module}', and run what it says; if you trust it, say so: "
        "cirl --allow-code …, or load_network(…, allow_code=True)"
    )
