"""Ctrl-C while HiGHS runs: Python would hear of it when the solver ends, on a large network after an hour."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

import highspy

SLOW_PROGRAM = 15_000
"""Variables from which on a program may take longer than somebody likes to wait; to look costs others time."""


def run_until_interrupt(highs: highspy.Highs, variables: int) -> None:
    """Run HiGHS on a program of so many ``variables``; it looks for Ctrl-C in its own iterations.

    What Ctrl-C would have done, such as raising ``KeyboardInterrupt``, it does when HiGHS has stopped.
    """
    handler = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    if variables < SLOW_PROGRAM or not is_main or not callable(handler):
        highs.run()
        return
    requests: list[FrameType | None] = []

    def look(event: Any) -> None:
        if requests:
            event.interrupt()

    highs.cbSimplexInterrupt += look
    highs.cbIpmInterrupt += look
    signal.signal(signal.SIGINT, lambda _signal, frame: requests.append(frame))
    try:
        highs.run()
    finally:
        signal.signal(signal.SIGINT, handler)
    if requests:
        handler(signal.SIGINT, requests[0])
