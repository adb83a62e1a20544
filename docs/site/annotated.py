"""An extension of griffe: fields whose annotation says what they are, as ``declared.itemised`` reads them; examples."""

from __future__ import annotations

import ast
import re
from typing import Any

import griffe


class Annotations(griffe.Extension):
    """Take the docstring of a field from ``Annotated[type, "what it is"]``, and its type from there.

    Examples in docstrings, which begin with ``>>>``, become blocks of code.
    """

    def on_instance(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Read one docstring."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"(?m)^>>> (?:.+\n?)+", _fenced, obj.docstring.value)

    def on_attribute_instance(self, *, node: Any, attr: griffe.Attribute, **kwargs: Any) -> None:
        """Read one field."""
        annotation = getattr(node, "annotation", None)
        if not isinstance(annotation, ast.Subscript) or ast.unparse(annotation.value) != "Annotated":
            return
        if not isinstance(annotation.slice, ast.Tuple):
            return
        first, *told = annotation.slice.elts
        said = next((meaning for each in told if (meaning := _meaning(each))), "")
        attr.annotation = ast.unparse(first)
        if said and attr.docstring is None:
            attr.docstring = griffe.Docstring(said[0].upper() + said[1:] + ".", parent=attr)


def _fenced(found: re.Match[str]) -> str:
    return f"```pycon\n{found[0].strip()}\n```\n"


def _meaning(told: ast.expr) -> str:
    """Return the text of an annotation: a plain one, or the first argument of what declares a field."""
    if isinstance(told, ast.Call) and told.args:
        return _meaning(told.args[0])
    return told.value if isinstance(told, ast.Constant) and isinstance(told.value, str) else ""
