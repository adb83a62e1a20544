"""A report as one HTML file that opens anywhere: no server, no request, nothing in it that can run but its own script.

The page is made of the files in ``page/``: a template, a style sheet, and modules of JavaScript that become one script.
Data is JSON in an element that does not run. Script and style are allowed by their hashes alone, so that no text of a
network, whatever it says, can become either.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from importlib.resources import files
from pathlib import Path

from cirl_marl.records.files import write_atomically
from cirl_marl.report.page_data import page_data
from cirl_marl.report.report_page import ReportPage

SCRIPTS = (
    "elements", "figures", "clock", "ribbons", "contents", "diagram", "curves", "plane", "details", "agents", "reasons",
    "tables", "main",
)  # fmt: skip
"""Modules of the page, each behind those from which it imports."""


def write_page(path: Path, page: ReportPage) -> Path:
    """Write the page of ``page``, whole or not at all, and return its path; missing folders are made.

    Raises:
        CirlError: for what ``document`` refuses.
        OSError: if the file cannot be written.
    """
    text = page_html(page)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda draft: draft.write_text(text, "utf-8", "xmlcharrefreplace"))
    return path


def page_html(page: ReportPage) -> str:
    """Return the text of the page."""
    script = "\n" + "\n".join(_script(name, _read(f"{name}.js")) for name in SCRIPTS)
    style = _read("page.css")
    parts = {
        "title": html.escape(page.title),
        "script_hash": _hash(script),
        "style_hash": _hash(style),
        "style": style,
        "data": _json_text(page_data(page)),
        "script": script,
    }
    return re.sub(r"{{(\w+)}}", lambda match: parts[match[1]], _read("page.html"))


def _script(name: str, module: str) -> str:
    """Return a module as a function that returns what it exports to those below it."""
    exports = ", ".join(re.findall(r"^export (?:function|const) (\w+)", module, flags=re.M))
    body = re.sub(r"^import ({.*}) from \"\./(\w+)\.js\";$", r"const \1 = of_\2;", module, flags=re.M)
    body = re.sub(r"^export ", "", body, flags=re.M)
    return f"const of_{name} = (() => {{\n{body}return {{ {exports} }};\n}})();"


def _read(name: str) -> str:
    return (files("cirl_marl.report") / "page" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _json_text(value: object) -> str:
    """Return JSON that ends no element and no line, whatever it holds."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return re.sub("[<>&]", lambda match: f"\\u{ord(match[0]):04x}", text)
