"""What only explanations of policies need, and what to install where it is missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from cirl_marl.errors import CirlError

ADVICE = 'explanations of policies need {}: python -m pip install "cirl-marl[explain]"'


def captum() -> Any:
    """Return ``captum.attr``; a ``CirlError`` says what to install."""
    return _module("captum.attr", "captum")


def trees() -> Any:
    """Return ``sklearn.tree``; a ``CirlError`` says what to install."""
    return _module("sklearn.tree", "scikit-learn")


def _module(name: str, distribution: str) -> Any:
    try:
        return import_module(name)
    except ImportError as missing:
        raise CirlError(ADVICE.format(distribution)) from missing
