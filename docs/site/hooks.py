"""What ``mkdocs`` calls: it lays out the site as the checkout is laid out and adds the pages that code makes.

So the links between documents lead on the site where they lead in the checkout. Whatever else a document links, such
as an example or a definition, comes along as a file. What is stale is a warning, which ends a strict build.
"""

from __future__ import annotations

import logging
import posixpath
import re
from collections.abc import Iterable, Iterator
from typing import Any

from mkdocs.structure.files import File, Files

from cirl_marl import networks, recipes
from cirl_marl.compartments import models
from cirl_marl.errors import CirlError
from docs.site.api import api_pages
from docs.site.markdown import ROOT, WRITTEN, GeneratedPage
from docs.site.models import model_page
from docs.site.networks import network_page
from docs.site.notebooks import FOLDER, kept
from docs.site.recipes import recipe_page

log = logging.getLogger("mkdocs.hooks.cirl_marl")

PLACES = {"networks": networks, "recipes": recipes, "models": models}
"""Folders of the site with a page for each member of a catalogue."""
MAKERS = {"networks": network_page, "recipes": recipe_page, "models": model_page}
GENERATED = "generated:"
"""Marks the places of ``nav`` in mkdocs.yml that generated pages take."""


def on_config(config: Any) -> Any:
    """Put the generated pages where the navigation names them."""
    config.nav = [_settled(each) for each in config.nav]
    return config


def _settled(entry: Any) -> Any:
    """Return an entry of the navigation with the pages of ``generated:FOLDER`` in the place of that mark."""
    if not isinstance(entry, dict):
        return entry
    ((title, value),) = entry.items()
    if isinstance(value, list):
        return {title: [_settled(each) for each in value]}
    if not str(value).startswith(GENERATED):
        return entry
    place = value.removeprefix(GENERATED)
    return {title: _listed(place)}


def _listed(place: str) -> list[Any]:
    if place == "api":
        return [{page.title: page.uri} for page in api_pages()]
    names = list(PLACES[place]())
    countries = [name for name in names if name.startswith("steel_") and name != "steel_world"]
    listed: list[Any] = [{name: f"{place}/{name}.md"} for name in names if name not in countries]
    if countries:
        listed.append({"Steel of countries": [{name: f"{place}/{name}.md"} for name in countries]})
    return listed


def on_files(files: Files, config: Any) -> Files:
    """Return the documents of the checkout, what they link, and the generated pages, beside the files of the theme."""
    kept = Files([each for each in files if each.src_dir != config.docs_dir])
    for path in WRITTEN:
        kept.append(File.generated(config, str(path.relative_to(ROOT)), abs_src_path=str(path)))
    for page in _generated():
        kept.append(File.generated(config, page.uri, content=page.text))
        folder = posixpath.dirname(page.uri)
        for name, content in page.files.items():
            kept.append(File.generated(config, f"{folder}/{name}", content=content))
    for uri in sorted(set(_linked(kept))):
        if kept.get_file_from_path(uri) is None:
            kept.append(File.generated(config, uri, abs_src_path=str(ROOT / uri)))
    for part in ("docs/site/style.css", "docs/site/iframe-worker.js"):
        kept.append(File.generated(config, part, abs_src_path=str(ROOT / part)))
    _check_notebooks()
    return kept


def _generated() -> Iterator[GeneratedPage]:
    for place, names in PLACES.items():
        for name in names():
            try:
                yield MAKERS[place](name)
            except CirlError as stale:
                log.warning("%s", stale)
    yield from api_pages()


def _linked(files: Iterable[File]) -> Iterator[str]:
    """Yield the files of the checkout, other than documents, that documents link."""
    for file in files:
        if not file.src_uri.endswith(".md"):
            continue
        for target in re.findall(r"\]\(([^)#\s]+)", file.content_string):
            uri = posixpath.normpath(posixpath.join(posixpath.dirname(file.src_uri), target))
            if not target.startswith("http") and not uri.endswith(".md") and (ROOT / uri).is_file():
                yield uri


def _check_notebooks() -> None:
    """Warn of notebooks whose script was changed since they were run."""
    for script in sorted(FOLDER.glob("*.py")):
        try:
            kept(script)
        except CirlError as stale:
            log.warning("%s", stale)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Leave out marks of measured sections, and link the names of catalogues where a row of a table begins with one."""
    text = re.sub(r"^<!-- .* -->$", "", markdown, flags=re.M)
    folder = posixpath.dirname(page.file.src_uri)
    if folder in PLACES:
        return text
    for place, names in PLACES.items():
        known = set(names())

        def link(found: re.Match[str], place: str = place, known: set[str] = known) -> str:
            name = found[1]
            uri = posixpath.relpath(f"{place}/{name}.md", folder or ".")
            return f"| [`{name}`]({uri})" if name in known else found[0]

        text = re.sub(r"^\| `(\w+)`", link, text, flags=re.M)
    return text
