"""The site: pages say what definitions, classes and results say, stale ones are refused, and it builds strictly."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import pytest
import typer.main
from rich.table import Table
from some import some

import cirl_marl
from benchmarks.best_plans import FOLDER, LEFT_OUT, read_plan, replayed
from cirl_marl import CirlError, cli, load_network
from cirl_marl.compartments import models
from cirl_marl.definitions.catalogue import families
from cirl_marl.definitions.sources import stated_numbers, stated_settings
from cirl_marl.learners.recipe import load_recipe
from cirl_marl.network.declarations import declarations
from docs.site import networks as network_pages
from docs.site import notebooks
from docs.site.api import api_pages
from docs.site.markdown import ROOT, WRITTEN, sections_about, shown, table
from docs.site.models import model_page
from docs.site.networks import LEGIBLE, STUDY, check_study, network_page
from docs.site.recipes import recipe_page

SCRIPTS = sorted(notebooks.FOLDER.glob("*.py"))
LIMIT_S = 180.0


def cells(text: str) -> list[list[str]]:
    """Return the rows of all tables of a page, those in folded parts included."""
    rows = [line.strip() for line in text.splitlines() if line.strip().startswith("| ")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", row)[1:-1]] for row in rows]


def test_cells_do_not_end_early() -> None:
    """A bar in a cell, of a table of ours or of one for the terminal, is text."""
    assert cells(table(("a",), [("x | y",)]))[1] == [r"x \| y"]
    found = Table("one", "two")
    found.add_row("0 | 1", "2\n3")
    assert cells(shown(found)) == [["one", "two"], [r"0 \| 1", "2 3"]]


@pytest.mark.parametrize("name", [names[0] for names in families().values()])
@pytest.mark.slow
def test_network_pages_say_what_definitions_say(name: str) -> None:
    """Every compartment, every number with its source, every agent; λ by the flows that count; bound and plan."""
    network, page = load_network(name), network_page(name)
    rows = cells(page.text)
    told = stated_numbers(network)
    own = [id_ for id_ in network.compartments if not any(id_.startswith(f"{copy}_") for copy in network.copies)]
    for part in ("nodes", "arcs"):
        for id_, found in told[part].items():
            for each in found if id_ in own else ():
                key = f"`{each.key}`" if each.key else ""
                source = each.source.replace("|", r"\|").replace("\n", " ")
                assert [f"`{id_}`", key, each.value, source] in rows
    for each in stated_settings(network):
        assert ["", f"`{each.key}`", each.value, each.source.replace("|", r"\|")] in rows
    if not network.copies:
        assert {row[0] for row in rows} >= {compartment.id for compartment in network.compartments.values()}
        assert {row[0] for row in rows} >= {f"`{service.id}`" for service in network.services}
    assert {row[0] for row in rows} >= {f"`{agent}`" for agent in network.agents if agent in own}
    formula = re.search(r"^    λ = −Δ·\((.*)\)$", page.text, re.M)
    if formula:
        terms = re.findall(r"(?:(−|\+) )?(\w+)", formula[1])
        signs = {arc.id: sign for arc, sign in zip(network.arcs, network.sustainability.tolist(), strict=True) if sign}
        assert {term: -1.0 if sign == "−" else 1.0 for sign, term in terms} == signs
    if name not in LEFT_OUT:
        kept = read_plan(name)
        assert ["best plan known", f"{kept.circularity:.5g}"] in [row[:2] for row in rows]
        assert kept.bound is None or ["bound", f"{kept.bound:.5g}", f"≥ {kept.min_service:g}", ""] in rows
        is_small = len(network.nodes) <= LEGIBLE or network.copies
        drawing = f"{name}.png" if is_small else f"{name}_flows.html"
        assert set(page.files) == {drawing, f"{name}_plan.png"} and drawing in page.text
        pictures = [content for file, content in page.files.items() if file.endswith(".png")]
        assert all(content.startswith(b"\x89PNG") for content in pictures)


@pytest.mark.parametrize("name", cirl_marl.networks())
@pytest.mark.slow
def test_kept_plans_are_of_the_catalogue(name: str) -> None:
    """Each network has a bound and a plan of its definition as it is now, and the bound is not exceeded."""
    if name in LEFT_OUT:
        assert not (FOLDER / f"{name}.json").exists()
        return
    kept = read_plan(name)
    run = replayed(kept).rollout
    if kept.bound is not None:
        assert kept.circularity <= kept.bound + 1e-9 * abs(kept.bound)
        assert float(run.least_service[0]) >= kept.min_service - 1e-6


@pytest.mark.medium
def test_stale_plans_are_refused(tmp_path: Path) -> None:
    """A plan of another definition, another λ̄ than the simulator's, and none at all are said, with what to do."""
    kept = read_plan("carbo_net")
    with pytest.raises(CirlError, match=r"the kept plan has λ̄ .* in the simulator, not"):
        replayed(replace(kept, circularity=kept.circularity * 1.001))
    with pytest.raises(CirlError, match=r"is missing; python -m benchmarks.best_plans carbo_net"):
        read_plan("carbo_net", tmp_path)
    document = json.loads((FOLDER / "carbo_net.json").read_text()) | {"definition_sha256": "another"}
    (tmp_path / "carbo_net.json").write_text(json.dumps(document))
    with pytest.raises(CirlError, match="the definition has changed since"):
        read_plan("carbo_net", tmp_path)


@pytest.mark.medium
def test_figures_of_another_network_are_refused(tmp_path: Path) -> None:
    """The study's neutral episodes are repeated; one that differs ends it."""
    for path in some(list(STUDY.iterdir())):
        check_study(path.name)
    shutil.copytree(STUDY / "carbo_net", tmp_path / "carbo_net")
    path = tmp_path / "carbo_net" / "episodes.csv"
    lines = path.read_text().splitlines()
    place = max(i for i, line in enumerate(lines) if line.startswith("neutral,"))
    row = lines[place].split(",")
    row[4] = str(float(row[4]) * 1.001)
    path.write_text("\n".join([*lines[:place], ",".join(row), *lines[place + 1 :]]) + "\n")
    with pytest.raises(CirlError, match=r"episode 255 of neutral has λ̄ .* now, not .*: make study"):
        check_study("carbo_net", tmp_path)


@pytest.mark.medium
def test_learners_stand_on_the_page_with_their_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the study's summary, row by row; a network that was not studied has none."""
    (heading, rows, _) = network_pages._learners("copper_net")
    assert heading == "## Learners"
    found = json.loads((STUDY / "copper_net" / "summary.json").read_text())["rows"]
    assert [row[0] for row in cells(rows)[1:]] == [row["name"] for row in found]
    ars = next(row for row in found if row["name"] == "independent_ars")["gap"]
    said = next(row for row in cells(rows) if row[0] == "independent_ars")[-1]
    assert said == f"{ars['value']:.1%} [{ars['low']:.1%}, {ars['high']:.1%}]"
    assert list(network_pages._learners("net_zero")) == []


@pytest.mark.medium
def test_model_pages_list_states_inputs_and_parameters() -> None:
    """Of every kind of compartment model, with the default and the meaning of each parameter."""
    for kind, model in models().items():
        text = model_page(kind).text
        rows = cells(text)
        names = {row[0].strip("`") for row in rows}
        found = model()
        assert names >= {*found.state_names, *found.input_names}
        for each in fields(model):
            row = next(row for row in rows if row[0] == f"`{each.name}`")
            default = f"{each.default:.5g}" if isinstance(each.default, float) else str(each.default)
            assert row[1] == default
            assert row[3] == declarations(model)[each.name].meaning.replace("``", "`").replace("|", r"\|")
    assert "[solids_net](../networks/solids_net.md)" in model_page("incinerator").text
    assert "compartments.md#digester-digester_published" in model_page("digester_published").text


@pytest.mark.sample(4)
@pytest.mark.parametrize("name", cirl_marl.recipes())
def test_recipe_pages_list_every_setting(name: str) -> None:
    """Settings of the run, parameters of all learners, and the file itself."""
    recipe, text = load_recipe(name), recipe_page(name).text
    said = {row[0].strip("`") for row in cells(text)}
    assert said >= {f"run.{key}" for key in recipe.run.model_dump()}
    for where, learner in recipe.learners():
        assert said >= {f"{where}.parameters.{key}" for key in learner.parameters}
    assert (ROOT / "agents" / f"{name}.toml").read_text().strip() in text
    assert_it_parses(re.findall(r"^```\ncirl (.*)$", text, re.M)[0])


def test_recipe_pages_name_the_command_that_trains() -> None:
    """That of the paper, and that of the network for which a recipe is."""
    assert "cirl paper Incinerator --recipe tuned" in recipe_page("paper_incinerator").text
    assert "cirl train solids_net --recipe sorter_alone" in recipe_page("sorter_alone").text


def assert_it_parses(command: str) -> None:
    """Let the command line read a command as it would before it does anything."""
    name, *arguments = command.split()
    known = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
    known[name].make_context(name, arguments)


def test_every_module_is_described() -> None:
    """The reference names every module of the library once, but for private ones."""
    named = [name for page in api_pages() for name in re.findall(r"^::: (\S+)$", page.text, re.M)]
    files = [path for path in (ROOT / "cirl_marl").rglob("*.py") if not path.name.startswith("_")]
    assert sorted(named) == sorted(".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files)


def test_documents_tell_of_what_they_name() -> None:
    """A page leads to the section that names it in its heading, or first names it or its file."""
    made, learnt = sections_about("solids_net")
    assert made.startswith("[networks.md](../docs/networks.md#solids_net")
    assert learnt.startswith("[compartments.md](../docs/compartments.md#robots-solids_net")
    assert sections_about("copper_world") == ["[data.md](../docs/data.md#copper-aluminium-and-plastics)"]
    assert sections_about("steel_spain", "steel.toml") == ["[data.md](../docs/data.md#data-of-the-real-cycles)"]
    assert sections_about("nothing_of_the_kind") == []


def test_every_document_has_a_place() -> None:
    """The navigation of the site names each document; a strict build would refuse one that it lacks."""
    named = re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M)
    assert sorted(named) == sorted(str(path.relative_to(ROOT)) for path in WRITTEN)


@pytest.mark.parametrize("script", SCRIPTS, ids=[path.stem for path in SCRIPTS])
def test_kept_notebooks_are_of_their_scripts(script: Path) -> None:
    """What is shown came out of the script as it is, pictures included; a changed script is noticed."""
    text = notebooks.kept(script).read_text(encoding="utf-8")
    pictures = re.findall(rf"\]\((pictures/{script.stem}_\d+\.png)\)", text)
    assert pictures
    assert all((script.parent / picture).is_file() for picture in pictures)
    (seconds,) = re.findall(r"^It took (\d+) seconds of one core\.", text, re.M)
    assert float(seconds) < LIMIT_S


def test_a_changed_notebook_is_noticed(tmp_path: Path) -> None:
    """One more character in the script, or no document beside it."""
    script = Path(shutil.copy(SCRIPTS[0], tmp_path))
    with pytest.raises(CirlError, match="make notebooks"):
        notebooks.kept(script)
    shutil.copy(SCRIPTS[0].with_suffix(".md"), tmp_path)
    with pytest.raises(CirlError, match="ipynb: is not what"):
        notebooks.kept(script)
    shutil.copy(SCRIPTS[0].with_suffix(".ipynb"), tmp_path)
    assert notebooks.kept(script) == script.with_suffix(".md")
    script.write_text(script.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    with pytest.raises(CirlError, match=f"is not what {script.name} comes out as"):
        notebooks.kept(script)


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=[path.stem for path in SCRIPTS])
def test_notebooks_run(script: Path) -> None:
    """Each runs to its end, and prints and draws what is kept, but for figures."""
    pytest.importorskip("nbclient", reason="needs the extra 'docs'")
    found = notebooks.executed(script)
    _, _, _, _, rest = notebooks.kept(script).read_text(encoding="utf-8").split("\n", 4)
    before = rest.strip().splitlines()
    now = found.text.split("\n", 1)[1].strip().splitlines()
    assert [_without_figures(line) for line in now] == [_without_figures(line) for line in before]


def _without_figures(line: str) -> str:
    return re.sub(r"[-+−]?\d[\d.,]*(?:e[-+]?\d+)?|\s+|[─━]", "", line)


TINY = """\
INHERIT: {mkdocs}
docs_dir: {docs}
theme: {{name: mkdocs}}
plugins: []
hooks: ["{hooks}"]
extra_css: []
nav: [{{First: first.md}}, {{Second: second.md}}]
"""
"""A site with the strictness, the validation and the way of printing of ours, without its theme and plugins."""


@pytest.mark.medium
@pytest.mark.parametrize(
    ("link", "code"),
    [
        ("[fine](second.md#a-heading) ![fine](dot.png)", 0),
        ("[broken](no_such_page.md)", 1),
        ("[broken](second.md#no-such-heading)", 1),
        ("![broken](no_such_picture.png)", 1),
    ],
    ids=["clean", "page", "anchor", "picture"],
)
def test_the_way_we_build_is_strict(link: str, code: int, tmp_path: Path) -> None:
    """Two pages, built as ``make docs`` builds ours: what leads nowhere is printed and ends it, and nothing else is."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "first.md").write_text(f"# First\n\n{link}\n")
    (tmp_path / "docs" / "second.md").write_text("# Second\n\n## A heading\n")
    (tmp_path / "docs" / "dot.png").write_bytes(b"")
    config = tmp_path / "mkdocs.yml"
    hooks = ROOT / "docs" / "site" / "warnings_only.py"
    config.write_text(TINY.format(mkdocs=ROOT / "mkdocs.yml", docs=tmp_path / "docs", hooks=hooks))
    done = built(ROOT, tmp_path / "site", "--config-file", str(config))
    assert done.returncode == code, done.stderr
    target = re.findall(r"\((\S+)\)", link)[0]
    said = done.stderr + done.stdout
    assert (f"'{target}'" in said and "Aborted with 1 warnings in strict mode" in said) if code else said == ""


@pytest.mark.slow
def test_the_site_builds(tmp_path: Path) -> None:
    """Strictly; with a page for each network, recipe, model and package; and no page asks the network for anything."""
    pytest.importorskip("mkdocstrings", reason="needs the extra 'docs'")
    done = built(ROOT, tmp_path / "site")
    assert done.returncode == 0, done.stderr[-3000:]
    for place, names in (("networks", cirl_marl.networks()), ("recipes", cirl_marl.recipes()), ("models", models())):
        pages = {path.stem for path in (tmp_path / "site" / place).glob("*.html")}
        assert {page for page in pages if not page.endswith("_flows")} == set(names)  # and diagrams of large networks
    for path in some(list((tmp_path / "site").rglob("*.html"))):
        text = path.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|link|iframe|source)\b[^>]*?(?:src|href)="([^"]*)"', text)
        assert [each for each in loaded if re.match(r"(?:https?:)?//", each)] == [], path
    for path in some(list((tmp_path / "site").rglob("*.css"))):
        assert not re.search(r"url\([\"']?(?:https?:)?//|@import", path.read_text(encoding="utf-8")), path


@pytest.mark.slow
def test_a_broken_link_ends_the_build(tmp_path: Path) -> None:
    """A page, an anchor or a file that is not there, in a copy of the checkout without the pages of networks."""
    pytest.importorskip("mkdocstrings", reason="needs the extra 'docs'")
    copy = tmp_path / "checkout"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "runs", "build", "*_cache", "tests"))
    hooks = copy / "docs" / "site" / "hooks.py"
    text = hooks.read_text(encoding="utf-8")
    assert '"networks": networks, ' in text
    hooks.write_text(text.replace('"networks": networks, ', '"networks": list, '), encoding="utf-8")
    page = copy / "docs" / "concepts.md"
    broken = ("no_such_page.md", "bound.md#no-such-heading", "pictures/no_such_picture.png")
    links = "".join(f"\n[a link]({each})\n" for each in broken)
    page.write_text(page.read_text(encoding="utf-8") + links, encoding="utf-8")
    done = built(copy, tmp_path / "site")
    assert done.returncode == 1
    assert all(each in done.stderr for each in broken)


def built(checkout: Path, site: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Build the site of a checkout by the command of ``make docs``."""
    (line,) = re.findall(r"^docs:.*\n\tNO_MKDOCS_2_WARNING=1 \S+ (.*)$", (ROOT / "Makefile").read_text(), re.M)
    command = [sys.executable, *line.split(), "--site-dir", str(site), *options]
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    return subprocess.run(command, cwd=checkout, env=env, capture_output=True, text=True, check=False)
