"""Runs notebooks and keeps what comes out: ``python -m docs.site.notebooks [SCRIPT ...]``.

A notebook is a script in jupytext's percent format in ``examples/notebooks``. Jupyter opens it with jupytext. What a
run prints and draws is kept beside it, since it takes minutes: as a notebook, to be read where notebooks are shown, and
as Markdown and pictures, for the site. Both have the hash of the script.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cirl_marl.errors import CirlError
from docs.site.markdown import ROOT

FOLDER = ROOT / "examples" / "notebooks"
PICTURES = "pictures"
"""Folder of the pictures, in that of the notebooks."""
LIMIT_S = 1800
"""Seconds in which a cell has to end, on a machine that does other work as well."""
CLOCK = "import sys as _sys, time as _time; _ = _sys.stdout.write(str(_time.process_time()))"
"""A last cell, which is not shown: what the notebook took."""


@dataclass(frozen=True, slots=True)
class Executed:
    """What came out of a notebook.

    Attributes:
        text: in Markdown.
        pictures: contents of its pictures by name.
        notebook: the same as a Jupyter notebook, in JSON.
        seconds: processor time.
    """

    text: str
    pictures: Mapping[str, bytes]
    notebook: Mapping[str, Any]
    seconds: float


def executed(script: Path) -> Executed:
    """Run a notebook in a folder of its own.

    Raises:
        CirlError: if the packages that run notebooks are not installed, or a cell of it fails.
    """
    try:
        import jupytext
        from nbclient import NotebookClient
        from nbclient.exceptions import CellExecutionError
    except ImportError as missing:
        raise CirlError(f"to run notebooks install the extra, pip install 'cirl-marl[docs]': {missing}") from missing
    notebook = jupytext.read(script)
    notebook.cells += jupytext.reads(f"# %%\n{CLOCK}", fmt="py:percent").cells
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        client = NotebookClient(
            notebook,
            timeout=LIMIT_S,
            startup_timeout=LIMIT_S,
            kernel_name="python3",
            resources=resources,
            record_timing=False,
            coalesce_streams=True,  # else output is cut where the kernel happened to send it
        )
        kernel = client.create_kernel_manager()
        kernel.transport, kernel.ip = "ipc", f"{folder}/kernel"  # no port is opened
        try:
            client.execute()
        except CellExecutionError as failed:
            raise CirlError(f"{script}: {failed}") from failed
    seconds = float(notebook.cells.pop().outputs[0].text)
    pictures: dict[str, bytes] = {}
    parts = [part for cell in notebook.cells for part in _shown(cell, script.stem, pictures)]
    return Executed("\n\n".join(parts) + "\n", pictures, _plain(notebook, script), seconds)


def _plain(notebook: Any, script: Path) -> dict[str, Any]:
    """Return a notebook without what differs from run to run or machine to machine, and with the hash of its script."""
    cells = []
    for i, cell in enumerate(notebook.cells):
        plain = {"cell_type": cell.cell_type, "id": f"cell-{i}", "metadata": {}, "source": cell.source}
        if cell.cell_type == "code":
            outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
            plain |= {"execution_count": cell.execution_count, "outputs": outputs}
        cells.append(plain)
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}, "script": _hash(script)}
    return {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


def _shown(cell: Any, name: str, pictures: dict[str, bytes]) -> Iterator[str]:
    """Yield a cell and what came out of it; pictures are added to those there are."""
    if cell.cell_type == "markdown":
        yield cell.source
        return
    yield f"```python\n{cell.source}\n```"
    printed = ""
    for output in cell.outputs:
        data = output.get("data", {})
        if "image/png" not in data:
            printed += _printed(output)
            continue
        picture = f"{name}_{len(pictures) + 1}.png"
        pictures[picture] = base64.b64decode(data["image/png"])
        yield from _block(printed)
        yield f"![What this draws]({PICTURES}/{picture})"
        printed = ""
    yield from _block(printed)


def _block(printed: str) -> Iterator[str]:
    lines = [line.rstrip() for line in printed.strip("\n").splitlines()]
    if any(lines):
        yield "\n".join(["```text", *lines, "```"])


def _printed(output: Any) -> str:
    """Return what a cell printed, without colours; nothing of what it only logged."""
    if output.get("name") == "stderr":
        return ""
    text = output.get("text", output.get("data", {}).get("text/plain", ""))
    return re.sub(r"\x1b\[[\d;]*m", "", text).rstrip("\n") + "\n"


def _hash(script: Path) -> str:
    return hashlib.sha256(script.read_bytes()).hexdigest()


def mark(script: Path) -> str:
    """Return the first line of what came out of a script: by which it is seen whether the script was changed since."""
    return f"<!-- {script.name} {_hash(script)} -->"


def kept(script: Path) -> Path:
    """Return the document that was kept of a script, beside its notebook.

    Raises:
        CirlError: if one of the two is missing, or the script was changed since.
    """
    path, notebook = script.with_suffix(".md"), script.with_suffix(".ipynb")
    if not path.is_file() or path.read_text(encoding="utf-8").partition("\n")[0] != mark(script):
        raise CirlError(f"{path}: is not what {script.name} comes out as: make notebooks")
    text = notebook.read_text(encoding="utf-8") if notebook.is_file() else "{}"
    if json.loads(text).get("metadata", {}).get("script") != _hash(script):
        raise CirlError(f"{notebook}: is not what {script.name} comes out as: make notebooks")
    return path


def keep(script: Path) -> float:
    """Run a notebook, keep what comes out, and return its processor time, seconds."""
    found, pictures = executed(script), script.parent / PICTURES
    pictures.mkdir(exist_ok=True)
    for old in pictures.glob("*.png"):
        if re.fullmatch(rf"{script.stem}_\d+", old.stem):
            old.unlink()
    for name, content in found.pictures.items():
        (pictures / name).write_bytes(content)
    text = json.dumps(found.notebook, indent=1, ensure_ascii=False)
    script.with_suffix(".ipynb").write_text(text + "\n", encoding="utf-8")
    minutes = f"It took {found.seconds:.0f} seconds of one core. The script is [{script.name}]({script.name})."
    title, rest = found.text.split("\n", 1)
    script.with_suffix(".md").write_text(f"{mark(script)}\n{title}\n\n{minutes}\n{rest}", encoding="utf-8")
    return found.seconds


def main() -> None:
    """Run those that are named, or those whose script was changed."""
    for script in [*map(Path, sys.argv[1:])] or sorted(FOLDER.glob("*.py")):
        try:
            kept(script)
        except CirlError:
            sys.stdout.write(f"{script} …\n")
            sys.stdout.flush()
            sys.stdout.write(f"{keep(script):.0f} s\n")


if __name__ == "__main__":
    main()
