"""What the documents promise exists and works."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import typer.main

import cirl_marl
from cirl_marl.cli import app
from cirl_marl.definitions.reading import read_network
from cirl_marl.learners import load_recipe, train

ROOT = Path(__file__).parent.parent
DOCUMENTS = sorted([ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("*/README.md")])


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    """Every relative link and picture exists."""
    targets = re.findall(r"\]\(([^)#]+)\)", document.read_text())
    missing = [t for t in targets if not t.startswith("http") and not (document.parent / t).exists()]
    assert missing == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_measured_sections_have_content(document: Path) -> None:
    """Every mark ``<!-- name -->`` has its end, and between them stands what was measured."""
    text = document.read_text()
    marks = re.findall(r"^<!-- (/?\w+) -->$", text, re.MULTILINE)
    assert [f"/{name}" for name in marks[::2]] == marks[1::2]
    for name in marks[::2]:
        assert text.split(f"<!-- {name} -->")[1].split(f"<!-- /{name} -->")[0].strip(), name


def test_readme_lists_the_catalogue_and_the_commands() -> None:
    """Tables of the README name exactly the networks, recipes and commands that there are."""
    text = (ROOT / "README.md").read_text()
    commands = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    assert set(re.findall(r"^\| `cirl (\w+)", text, re.MULTILINE)) == commands
    for name in cirl_marl.networks():
        network = cirl_marl.load_network(name)
        row = next(line for line in text.splitlines() if line.startswith(f"| `{name}`"))
        assert f"| {len(network.compartments)} (" in row
        assert f"| {len(network.agents)} |" in row
    section = text.split("## Learner recipes")[1].split("## ")[0]
    assert set(re.findall(r"^\| `(\w+)`", section, re.MULTILINE)) == set(cirl_marl.recipes())


def test_readme_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ten lines of Python run as printed, but for a shorter training."""
    code = (ROOT / "README.md").read_text().split("```python\n")[1].split("```")[0]
    assert "seed=0)" in code
    recipe = load_recipe("independent_ppo")
    short = recipe.model_copy(update={"run": recipe.run.model_copy(update={"steps": 1280})})
    monkeypatch.setattr("cirl_marl.learners.launch.load_recipe", lambda name: short)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    assert "PPO" in type(names["training"].learners["mine"].model).__name__  # type: ignore[attr-defined]
    assert (tmp_path / "runs" / "mine" / "status.json").is_file()


def test_readme_example_of_one_agent_runs() -> None:
    """One compartment learns as printed, but for a shorter training."""
    code = (ROOT / "README.md").read_text().split("```python\n")[2].split("```")[0]
    assert ".learn(20_000)" in code
    names: dict[str, Any] = {}
    exec(compile(code.replace("20_000", "2_048"), "README.md", "exec"), names)
    assert names["model"].num_timesteps == 2_048


def test_definition_in_the_guide_is_valid(tmp_path: Path) -> None:
    """The whole network shown to newcomers reads without a mistake and can be run."""
    definition = tmp_path / "bottles.toml"
    definition.write_text((ROOT / "envs" / "README.md").read_text().split("```toml\n")[1].split("```")[0])
    network = read_network(definition)
    env = cirl_marl.parallel_env(network)
    env.reset(seed=0)
    env.step({agent: [0.0] for agent in env.agents})
    assert network.scenario("crisis").nodes[0].initial == (1000.0, 1000.0)


def test_own_model_in_the_guide_is_valid(tmp_path: Path) -> None:
    """The tables shown for a model of one's own belong to a network that can be run."""
    whole, parts = (part.split("```")[0] for part in (ROOT / "envs" / "README.md").read_text().split("```toml\n")[1:])
    definition = tmp_path / "brewery.toml"
    definition.write_text(re.sub(r"\[episode\].*?\n\n", "", whole.split("[nodes.")[0], flags=re.DOTALL) + parts)
    env = cirl_marl.parallel_env(definition)
    env.reset(seed=0)
    infos = env.step({"tank": [0.5]})[-1]
    assert infos["tank"]["flows"][0] > 0.0


def test_recipe_in_the_guide_is_valid(tmp_path: Path) -> None:
    """The recipe shown to newcomers learns in the network that it is shown for, and what is added to it reads."""
    path = tmp_path / "my_recipe.toml"
    whole, addition = (
        part.split("```")[0] for part in (ROOT / "agents" / "README.md").read_text().split("```toml\n")[1:]
    )
    path.write_text(whole)
    training = train("copper_net", path, steps=1280)
    assert type(training.learners["mine"].model).__name__ == "SAC"
    path.write_text(whole + addition)
    assert load_recipe(path).match[1].algorithm == "TQC"


def test_examples_run() -> None:
    """Each example runs to its end."""
    examples = sorted((ROOT / "examples").glob("*.py"))
    assert examples
    for example in examples:
        names: dict[str, object] = {"__name__": "__main__"}
        exec(compile(example.read_text(), str(example), "exec"), names)
        assert "λ" in str(names["summary"])
