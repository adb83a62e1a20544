"""What keeps a test from passing on nothing."""

from __future__ import annotations

from collections.abc import Sized
from typing import TypeVar

Collection = TypeVar("Collection", bound=Sized)


def some(collection: Collection) -> Collection:
    """Return a collection that must not be empty: of what is compared, or gone through, there has to be something."""
    assert len(collection), "nothing was found: the test would pass on nothing"
    return collection
