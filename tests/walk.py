"""Through how many modules a call leads, and how often it comes back into one that it has left.

    python tests/walk.py

The call is made, and every function of the library is entered once, at its first call: that is the path of somebody
who reads the code in the order in which it runs. A *return* leads into a module that was left before.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import cirl_marl

PACKAGE = Path(cirl_marl.__file__).parent


def walk(call: Callable[[], Any]) -> list[str]:
    """Return the modules of the library that ``call`` leads through, in the order in which it does."""
    functions: set[Any] = set()
    stays: list[str] = []
    followed: list[bool] = []  # for every open frame of the library whether its function was new

    def module_of(frame: FrameType) -> str | None:
        path = Path(frame.f_code.co_filename)
        return str(path.relative_to(PACKAGE)) if path.is_relative_to(PACKAGE) else None

    def trace(frame: FrameType, event: str, _: Any) -> None:
        if event not in ("call", "return") or (module := module_of(frame)) is None:
            return
        if event == "call":
            followed.append(frame.f_code not in functions)
            functions.add(frame.f_code)
            if followed[-1]:
                stays.append(module)
        elif followed and followed.pop() and frame.f_back is not None and (caller := module_of(frame.f_back)):
            stays.append(caller)

    sys.setprofile(trace)
    try:
        call()
    finally:
        sys.setprofile(None)
    return [first for first, second in pairwise([*stays, ""]) if first != second]


def main() -> None:
    """Print the walk of a bound."""
    network, bound = cirl_marl.load_network("copper_net"), cirl_marl.bound  # imported before: that is no part of it
    stays = walk(lambda: bound(network, horizon=6))
    rooms = len(set(stays))
    sys.stdout.write("\n".join(stays) + f"\n{len(stays)} stays, {rooms} modules, {len(stays) - rooms} returns\n")


if __name__ == "__main__":
    main()
