"""Multi-agent reinforcement learning for the circular economy.

Compartments of a thermodynamical material network are agents, coupled by the mass they send each other; the team's
reward is the circularity λ(N;t) of the network.

>>> import cirl_marl
>>> cirl_marl.networks()[:3]
['aluminium_world', 'car_batteries', 'carbo_net']

Its names stand in ``__init__.pyi``, where type checkers and editors look for them; each is loaded when it is first
asked for (PEP 562), so that importing the library is cheap.
"""

import ast
from importlib import import_module
from pathlib import Path

from cirl_marl.environments.registration import register as register

__version__ = "0.1.0"

_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_HOMES = {
    alias.name: str(statement.module)
    for statement in _STUB.body
    if isinstance(statement, ast.ImportFrom)
    for alias in statement.names
}
"""Public names by the module that defines them."""

__all__ = sorted(_HOMES)

register()


def __getattr__(name: str) -> object:
    """Load the module that defines a public name, and keep the name."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return globals().setdefault(name, getattr(import_module(_HOMES[name]), name))


def __dir__() -> list[str]:
    """Return the public names."""
    return list(__all__)
