"""Errors that users meet. Each message names the object, the value and the nearest valid choice."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar
from unicodedata import category

T = TypeVar("T")
LONGEST_LINE = 1200
"""Characters of a line of a message; of a longer one, which repeats what is in a file, the middle is left out."""
CONTROL = ("Cc", "Cf")
"""Unicode's categories of what is no character to be read: control characters, and those that turn a text round."""
MOST_LINES = 10
"""Most faults of one kind that a message lists."""


class CirlError(ValueError):
    """Base of every error that this library raises about its input."""

    def __init__(self, message: object = "") -> None:
        """Take a message: what a terminal would act on is written out, and lines too long to be read are shortened."""
        super().__init__("\n".join(_shorten(_printable(line)) for line in str(message).split("\n")))


def _printable(line: str) -> str:
    r"""Return a line with control characters as Python writes them.

    >>> _printable("kt\x1b[31m")
    'kt\\x1b[31m'
    """
    if line.isprintable():
        return line
    return "".join(repr(character)[1:-1] if category(character) in CONTROL else character for character in line)


def _shorten(line: str) -> str:
    """Return a line without its middle if it is too long.

    >>> len(_shorten("x" * 100_000)) <= LONGEST_LINE
    True
    """
    if len(line) <= LONGEST_LINE:
        return line
    cut = f" … ({len(line)} characters in all) … "
    end = (LONGEST_LINE - len(cut)) // 2
    return line[:end] + cut + line[-end:]


def first_lines(lines: Sequence[str]) -> list[str]:
    """Return the first lines, at most ``MOST_LINES``, and a last one that says how many more there are.

    >>> first_lines([str(number) for number in range(12)])[-2:]
    ['9', 'and 2 more']
    """
    return [*lines[:MOST_LINES], *([f"and {len(lines) - MOST_LINES} more"] if len(lines) > MOST_LINES else [])]


class NetworkError(CirlError):
    """A network that cannot be simulated; ``problems`` lists every fault found."""

    def __init__(self, subject: str, problems: Sequence[str]) -> None:
        """Join the ``problems`` of ``subject`` into one message."""
        self.subject = subject
        self.problems = tuple(problems)
        super().__init__("\n".join(f"{subject}: {problem}" for problem in problems))

    def __reduce__(self) -> tuple[type[NetworkError], tuple[str, tuple[str, ...]]]:
        """Pickle what it was made of, so that it comes back from other processes."""
        return type(self), (self.subject, self.problems)


class DefinitionError(NetworkError):
    """A definition file that cannot be read; ``problems`` lists every mistake found."""


class ControlError(CirlError):
    """An action, control or initial state that the environment cannot take."""


class RecipeError(CirlError):
    """A learner recipe that cannot be used."""


class RunError(CirlError):
    """A run directory that is missing, incomplete or belongs to something else."""


class LearnerError(RuntimeError):
    """A learner failed while training; names its agent and the joint step."""


def instance_of(kind: type[T], name: str, value: object) -> T:
    """Return a value of a class; a ``CirlError`` names one of another.

    >>> instance_of(dict, "options", {})
    {}
    """
    if not isinstance(value, kind):
        raise CirlError(f"{name} must be a {kind.__name__}, got {value!r}")
    return value


def whole_number(name: str, value: object, least: int) -> int:
    """Return a whole number, of Python or NumPy; a ``CirlError`` names one that is none, or below ``least``.

    >>> whole_number("seed", 3, 0)
    3
    """
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise CirlError(f"{name} must be a whole number of at least {least}, got {value!r}")
    return int(value)


def real_number(name: str, value: object, least: float = -math.inf, most: float = math.inf) -> float:
    """Return a number, of Python or NumPy; a ``CirlError`` names one that is none, NaN, or not in [least, most].

    >>> real_number("min_service", 1, 0, 1)
    1.0
    """
    if not isinstance(value, Real) or isinstance(value, bool) or not least <= value <= most:  # type: ignore[operator]
        limits = f" in [{least}, {most}]" if most < math.inf else f" of at least {least}" if least > -math.inf else ""
        raise CirlError(f"{name} must be a number{limits}, got {value!r}")
    return float(value)


def path_of(kind: str, value: Any) -> Path:
    """Return where a file or folder is or would be; a ``CirlError`` names what can be no path, whoever made it.

    >>> path_of("run", "runs/mine").name
    'mine'
    """
    try:
        path = Path(value)
        with suppress(FileNotFoundError, NotADirectoryError):
            path.stat()
    except (OSError, TypeError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise CirlError(f"{kind}: {value!r} is no path: {reason}") from error
    return path


def optional_module(name: str, need: str, extra: str) -> Any:
    """Return a module that an extra of this package installs; a ``CirlError`` says what needs it, and how to get it."""
    try:
        return import_module(name)
    except ImportError as failure:
        raise CirlError(f"{need}: pip install 'cirl-marl[{extra}]'") from failure


def unknown_name(kind: str, name: object, known_names: Iterable[object]) -> str:
    """Say that ``name`` is no ``kind``, with the nearest match, whatever the case of its letters, and all options.

    >>> unknown_name("law", "donnor", ["donor", "recipient"])
    "unknown law 'donnor'. Did you mean 'donor'? Known: donor, recipient."
    >>> unknown_name("algorithm", "ppo", ["A2C", "PPO"])
    "unknown algorithm 'ppo'. Did you mean 'PPO'? Known: A2C, PPO."
    """
    options = [str(option) for option in known_names]
    by_lower_case = {option.lower(): option for option in options}
    match = difflib.get_close_matches(str(name).lower(), by_lower_case, n=1, cutoff=0.5)
    hint = f" Did you mean '{by_lower_case[match[0]]}'?" if match else ""
    listed_names = ", ".join(options[:30]) + (f", … ({len(options)} in all)" if len(options) > 30 else "")
    return f"unknown {kind} '{name}'.{hint} Known: {listed_names or 'none'}."


def unknown_names(
    kind: str, names: Iterable[object], known_names: Collection[object], subject: str = ""
) -> Iterator[str]:
    """Yield ``subject`` and ``unknown_name`` of each name that is not known."""
    return (f"{subject}{unknown_name(kind, name, known_names)}" for name in names if name not in known_names)


def check_names(
    kind: str,
    names: Iterable[object],
    known_names: Collection[object],
    subject: str = "",
    error: type[CirlError] = CirlError,
) -> None:
    """Raise an ``error`` that says the first of ``unknown_names``, if there is any.

    >>> check_names("law", ["donor"], ["donor", "recipient"])
    """
    for fault in unknown_names(kind, names, known_names, subject):
        raise error(fault)
