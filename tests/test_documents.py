"""What the documents promise exists and works."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from imports import arrows, modules, rooms
from readability import ALL, PAGE, words

import cirl_marl
from cirl_marl import cli
from cirl_marl.definitions.catalogue import families
from cirl_marl.definitions.reader import Definition
from cirl_marl.learners.interface import train
from cirl_marl.learners.recipe import load_recipe
from docs.site.reference import reference_tables

ROOT = Path(__file__).parent.parent
DOCUMENTS = sorted(
    [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md"), *ROOT.glob("[a-z]*/README.md")]
)
WIDTH = 120
COMMANDS: dict[str, Any] = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]


def named(path: Path) -> str:
    """Return the name of a document in the checkout."""
    return str(path.relative_to(ROOT))


each_document = pytest.mark.parametrize("document", DOCUMENTS, ids=named)


def blocks(text: str, language: str = "") -> list[str]:
    """Return the fenced blocks of a language; the empty one stands for shell commands and what they print."""
    return [code for found, code in re.findall(r"^```(\w*)\n(.*?)^```$", text, re.M | re.S) if found == language]


def spans(text: str) -> list[str]:
    """Return what stands between single backticks in the prose."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S))


def anchor(heading: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@each_document
def test_links_lead_somewhere(document: Path) -> None:
    """Every relative link and picture exists, and every heading that a link names."""
    for target in re.findall(r"\]\(([^)]+)\)", document.read_text()):
        if target.startswith("http"):
            continue
        path, _, heading = target.partition("#")
        found = document.parent / path if path else document
        assert found.exists(), target
        if heading:
            assert heading in {anchor(line) for line in re.findall(r"^#+ (.*)$", found.read_text(), re.M)}, target


def test_pictures_are_shown_and_small() -> None:
    """Each picture stands in a document and loads at once."""
    shown = {target for path in DOCUMENTS for target in re.findall(r"pictures/([\w.]+)\)", path.read_text())}
    pictures = list((ROOT / "docs" / "pictures").iterdir())
    assert {picture.name for picture in pictures} == shown
    assert [picture.name for picture in pictures if picture.stat().st_size > 150_000] == []


@each_document
def test_measured_sections_have_content(document: Path) -> None:
    """Every mark ``<!-- name -->`` has its end, and between them stands what was measured."""
    text = document.read_text()
    marks = re.findall(r"^<!-- (/?\w+) -->$", text, re.MULTILINE)
    assert [f"/{name}" for name in marks[::2]] == marks[1::2]
    for name in marks[::2]:
        assert text.split(f"<!-- {name} -->")[1].split(f"<!-- /{name} -->")[0].strip(), name


@each_document
def test_table_cells_are_short(document: Path) -> None:
    """A cell of a table holds a figure or a phrase, not a paragraph."""
    rows = [line for line in document.read_text().splitlines() if line.startswith("|")]
    cells = [cell.strip() for row in rows for cell in re.split(r"(?<!\\)\|", row)]
    assert [cell for cell in cells if len(cell) > WIDTH] == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_lines_wrap(document: Path) -> None:
    """Lines end before column 120, but for table rows."""
    assert [line for line in document.read_text().splitlines() if len(line) > WIDTH and not line.startswith("|")] == []


def test_readme_is_short() -> None:
    """The first page is read in three minutes."""
    text = (ROOT / "README.md").read_text()
    assert len(text.split()) <= 700
    (code,) = blocks(text, "python")
    assert len([line for line in code.splitlines() if line]) <= 10


def test_pages_are_short() -> None:
    """A page answers one question; the words that are written by hand fit in a few minutes."""
    counts = words(ROOT)
    limits = {name: PAGE for name in counts} | {"CHANGELOG.md": sum(counts.values())}
    assert {name: count for name, count in counts.items() if count > limits[name]} == {}
    assert sum(counts.values()) <= ALL


def test_every_page_is_found_from_the_readme() -> None:
    """The README leads to each document."""
    text = (ROOT / "README.md").read_text()
    assert [named(path) for path in DOCUMENTS if path.parent != ROOT and f"({named(path)})" not in text] == []


def shown_commands(text: str) -> Iterator[str]:
    """Yield the ``cirl`` command lines of a document, from its blocks and its prose."""
    lines = "\n".join(blocks(text)).replace("\\\n", " ").splitlines()
    parts = [part.strip() for line in lines for part in line.split("&&")]
    for line in parts + spans(text):
        if line.startswith("cirl "):
            yield line.split("  #")[0].replace("…", "").replace("cirl --allow-code ", "cirl ")


@each_document
def test_commands_are_those_of_the_command_line(document: Path) -> None:
    """Each ``cirl`` command shown has a name, options and arguments that the program takes."""
    for line in shown_commands(document.read_text()):
        _, name, *arguments = shlex.split(line)
        assert name in COMMANDS, line
        if arguments:
            COMMANDS[name].make_context(name, arguments)  # raises what the program would print


def test_a_renamed_option_is_noticed() -> None:
    """The test of the commands can fail."""
    with pytest.raises(Exception, match="No such option: --learner"):
        COMMANDS["train"].make_context("train", ["copper_net", "--learner", "independent_ppo"])


@each_document
def test_make_targets_exist(document: Path) -> None:
    """What the documents say to make, the Makefile makes."""
    text = document.read_text()
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M)
    shown = re.findall(r"^make ([\w-]+)", "\n".join(blocks(text) + spans(text)), re.M)
    assert set(shown) <= set(targets)


CODE = {
    **{f"{named(path)} {i}": code for path in DOCUMENTS for i, code in enumerate(blocks(path.read_text(), "python"))},
    **{named(path): path.read_text() for path in sorted(ROOT.glob("examples/**/*.py"))},
}
"""The Python of documents, programs and notebooks."""


@pytest.mark.parametrize("code", CODE.values(), ids=CODE)
def test_code_comes_in_by_one_door(code: str) -> None:
    """It imports ``cirl_marl`` and nothing below it but adapters, and what it takes from there is public."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            assert [alias.name for alias in node.names if alias.name.startswith("cirl_marl.")] == []
        elif isinstance(node, ast.ImportFrom):
            assert not re.match(r"cirl_marl\.(?!adapters\.)", str(node.module))
            if node.module == "cirl_marl":
                assert {alias.name for alias in node.names} <= set(cirl_marl.__all__)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "cirl_marl":
            assert node.attr in cirl_marl.__all__ or node.attr.startswith("__")


@each_document
def test_python_names_resolve(document: Path) -> None:
    """Python blocks compile, and what they import exists; so does each dotted name of the library in the prose."""
    text = document.read_text()
    for code in blocks(text, "python"):
        for statement in ast.walk(ast.parse(code)):
            if isinstance(statement, ast.ImportFrom):
                for alias in statement.names:
                    resolve(f"{statement.module}.{alias.name}")
            elif isinstance(statement, ast.Import):
                for alias in statement.names:
                    resolve(alias.name)
    for name in re.findall(r"(?<![\w/])cirl_marl(?:\.\w+)+", "\n".join(spans(text))):
        resolve(name)


@each_document
def test_tests_that_are_named_exist(document: Path) -> None:
    """What a page says to run with pytest is there."""
    for command in spans(document.read_text()):
        if command.startswith("pytest "):
            (path,) = re.findall(r"tests/\w+\.py", command)
            tests = re.findall(r"def (test_\w+)", (ROOT / path).read_text())
            word = command.partition(" -k ")[2]
            assert any(word in test for test in tests), command


def test_the_citation_is_of_this_version() -> None:
    """``CITATION.cff`` names the version, and the paper whose environments are repeated."""
    text = (ROOT / "CITATION.cff").read_text()
    assert text.startswith("cff-version: 1.2.0\n") and "arXiv:2505.21536" in text
    assert re.findall(r"^version: (.*)$", text, re.M) == [cirl_marl.__version__]


def resolve(name: str) -> object:
    """Return what a dotted name stands for."""
    parts = name.split(".")
    found: object = importlib.import_module(parts[0])
    for i, part in enumerate(parts[1:], start=2):
        if not hasattr(found, part):
            importlib.import_module(".".join(parts[:i]))
        found = getattr(found, part)
    return found


def test_reference_lists_the_catalogue_and_the_commands() -> None:
    """Tables of the reference name exactly the networks, recipes and commands that there are."""
    text = (ROOT / "docs" / "reference.md").read_text()
    assert set(re.findall(r"^\| `cirl (\w+)", text, re.MULTILINE)) == set(COMMANDS)
    for names in families().values():
        row = next(line for line in text.splitlines() if any(line.startswith(f"| `{name}`") for name in names))
        network = cirl_marl.load_network(names[0])
        assert f"| {len(network.compartments)} ({len(network.nodes)} nodes, {len(network.arcs)} arcs) |" in row
        assert f"| {len(network.agents)} |" in row
    section = text.split("## Learner recipes")[1].split("## ")[0]
    assert set(re.findall(r"^\| `(\w+)`", section, re.MULTILINE)) == set(cirl_marl.recipes())


def test_reference_is_written_from_the_code() -> None:
    """Its tables are those of ``make written``."""
    text = (ROOT / "docs" / "reference.md").read_text()
    for name, lines in reference_tables().items():
        assert text.split(f"<!-- {name} -->\n")[1].split(f"\n<!-- /{name} -->")[0] == lines, "make written"


def test_architecture_draws_the_imports() -> None:
    """The drawing names every package once, and each imports only from lines below its own."""
    drawing = blocks((ROOT / "docs" / "architecture.md").read_text())[0]
    house = rooms(arrows(modules(ROOT)))
    packages = set(house) - {"__init__"}
    names = [line.split("  ")[0].split(", ") for line in drawing.splitlines()]
    floor = {name: -i for i, row in enumerate(names) for name in row}
    assert sorted(name for row in names for name in row) == sorted(packages)
    up = [(a, b) for a, b in house.edges if "__init__" not in (a, b) and floor[b] >= floor[a]]
    assert up == []
    assert max(floor[name] for name in house.successors("__init__")) == floor["report"]


def test_readme_results_are_those_of_the_study() -> None:
    """Each row of the README's table stands, rounded, in the study."""
    study = (ROOT / "docs" / "study.md").read_text()
    who = {"neutral control": "neutral"}
    rows = re.findall(
        r"^\| `(\w+_net)` \| ([^|]+) \| (\S+) (k?t) \| (\S+) \| ([^|]+) \|$", (ROOT / "README.md").read_text(), re.M
    )
    assert len(rows) == 4
    for network, acting, circularity, unit, service, gap in rows:
        section = study.split(f"<!-- {network} -->")[1].split(f"<!-- /{network} -->")[0]
        name = who.get(acting, re.sub(r"`(\w+)`.*", r"\1", acting))
        cells = [cell.strip() for cell in re.search(rf"^\| {name} \|.*$", section, re.M)[0].split("|")]  # type: ignore[index]
        assert f"λ̄ ({unit})" in section
        measured = float(cells[6].split()[0])
        assert abs(float(circularity) - measured) <= 0.5 * 10.0 ** -len(circularity.partition(".")[2]), (network, name)
        assert cells[8].startswith(service)
        assert abs(float(gap.split("%")[0]) - float(cells[10].split("%")[0])) <= 0.5
        if "steps" in acting:
            assert cells[5].replace(",", " ") in acting


@pytest.mark.medium
def test_readme_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ten lines of Python run as printed, but for a shorter training."""
    (code,) = blocks((ROOT / "README.md").read_text(), "python")
    assert 'directory="runs/mine", seed=0' in code
    recipe = load_recipe("exact_gradients")
    short = recipe.model_copy(update={"run": recipe.run.model_copy(update={"evaluations": 1, "episodes": 8})})
    monkeypatch.setattr("cirl_marl.learners.interface.load_recipe", lambda name: short)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code.replace('runs/mine", seed=0', 'runs/mine", steps=5_120, seed=0'), "README.md", "exec"), names)
    assert "PPO" in type(names["training"].learners["mine"].model).__name__  # type: ignore[attr-defined]
    assert (tmp_path / "runs" / "mine" / "status.json").is_file()


@pytest.mark.medium
def test_example_of_one_agent_runs() -> None:
    """One compartment learns as printed, but for a shorter training."""
    (code,) = blocks((ROOT / "docs" / "environments.md").read_text(), "python")
    assert ".learn(20_000)" in code
    names: dict[str, Any] = {}
    exec(compile(code.replace("20_000", "2_048"), "environments.md", "exec"), names)
    assert names["model"].num_timesteps == 2_048


@pytest.mark.medium
def test_getting_started_prints_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first network is valid, and what its commands print before the training is what the page shows."""
    text = (ROOT / "docs" / "getting_started.md").read_text()
    monkeypatch.chdir(tmp_path)
    Path("pallets.toml").write_text(blocks(text, "toml")[0])
    for command in (
        "check pallets.toml",
        "simulate pallets.toml --control neutral",
        "plan pallets.toml --control optimum",
    ):
        shown = text.split(f"```\ncirl {command}\n```\n")[1].split("```\n")[1].strip()
        monkeypatch.setattr(sys, "argv", ["cirl", *command.split()])
        with pytest.raises(SystemExit):
            cli.main()
        assert shown in capsys.readouterr().out
    exec(compile(blocks(text, "python")[0], "getting_started.md", "exec"), {})
    assert capsys.readouterr().out.startswith(text.split("print(cirl_marl.bound(")[1].split("```\n")[2].split("...")[0])


def test_definition_in_the_guide_is_valid(tmp_path: Path) -> None:
    """The whole network shown to newcomers reads without a mistake and can be run."""
    definition = tmp_path / "bottles.toml"
    definition.write_text(blocks((ROOT / "envs" / "README.md").read_text(), "toml")[0])
    network = Definition(definition).network()
    env = cirl_marl.parallel_env(network)
    env.reset(seed=0)
    env.step({agent: [0.0] for agent in env.agents})
    assert network.scenario("crisis").nodes[0].initial == (1000.0, 1000.0)


BREWERY = """
[episode]
control_interval = { value = 0.5, unit = "day", source = "two decisions a day" }
horizon = { value = 20, unit = "1", source = "ten days" }
solver = "rk4"
solver_step = { value = 0.05, unit = "day", source = "a tenth of the control interval" }

[nodes.tank]
role = "technosphere"
initial = { low = 90, high = 90, unit = "kg", source = "more than ten days give off" }
control = { kind = "input", low = 0.05, neutral = 0.2, high = 0.5, unit = "1/day", source = "dilution of the tank" }

[nodes.air]
role = "environment"
initial = { low = 0, high = 0, unit = "kg", source = "counted from today" }
"""
"""The rest of a network for the tables of a model of one's own."""


def test_own_model_in_the_guide_is_valid(tmp_path: Path) -> None:
    """The tables shown for a model of one's own belong to a network that can be run."""
    (whole,) = blocks((ROOT / "envs" / "README.md").read_text(), "toml")
    (parts,) = blocks((ROOT / "docs" / "compartments.md").read_text(), "toml")
    definition = tmp_path / "brewery.toml"
    definition.write_text(
        re.sub(r"\[episode\].*?\n\n", "", whole.split("[nodes.")[0], flags=re.DOTALL) + BREWERY + parts
    )
    env = cirl_marl.parallel_env(cirl_marl.load_network(definition, allow_code=True))
    env.reset(seed=0)
    infos = env.step({"tank": [0.5]})[-1]
    assert infos["tank"]["flows"][0] > 0.0


@pytest.mark.medium
def test_recipe_in_the_guide_is_valid(tmp_path: Path) -> None:
    """The recipe shown to newcomers learns in the network that it is shown for, and what is added to it reads."""
    path = tmp_path / "my_recipe.toml"
    whole, start, addition = blocks((ROOT / "agents" / "README.md").read_text(), "toml")
    path.write_text(whole)
    training = train("copper_net", path, steps=640, envs=8)
    assert type(training.learners["mine"].model).__name__ == "SAC"
    path.write_text(whole + start + addition)
    added = load_recipe(path).match[1:]
    assert added[0].start is not None and added[1].algorithm == "TQC"


@pytest.mark.slow
def test_examples_run() -> None:
    """Each example runs to its end."""
    examples = sorted((ROOT / "examples").glob("*.py"))
    assert examples
    for example in examples:
        names: dict[str, object] = {"__name__": "__main__"}
        exec(compile(example.read_text(), str(example), "exec"), names)
        assert re.search(r"λ.*\d|paid.*\d", str(names["summary"]), re.S)
