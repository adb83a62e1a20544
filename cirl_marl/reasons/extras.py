"""What only explanations of policies need, and what to install where it is missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from cirl_marl.errors import CirlError

MODULES = {"inputs": ("captum.attr", "captum"), "rules": ("sklearn.tree", "scikit-learn")}
"""By part of an explanation the module that it needs, and the distribution that has it."""


def module_for(part: str) -> Any:
    """Return the module that a part of an explanation needs; a ``CirlError`` says what to install."""
    name, distribution = MODULES[part]
    try:
        return import_module(name)
    except ImportError as missing:
        advice = f'explanations of policies need {distribution}: python -m pip install "cirl-marl[explain]"'
        raise CirlError(advice) from missing
