"""What importing the library costs, and which way imports go: all of them, wherever in a file they stand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from imports import PACKAGE, arrows, circles, drawing, floors, imported, modules, room_of, rooms
from some import some

CHECKOUT = Path(__file__).parent.parent
LAYERS = (
    ("errors",),
    ("records",),
    ("network",),
    ("compartments", "drawing"),
    ("definitions",),
    ("dynamics", "jobs"),
    ("environments",),
    ("controllers", "testing"),
    ("importing", "optimum"),
    ("learners",),
    ("evaluation", "paper"),
    ("reasons", "suite"),
    ("adapters", "report", "sweeps"),
    ("__init__", "cli"),
)
"""From the ground up; a room imports from layers below its own, and from itself."""

MOST_FLOORS = 12
TRAINING = ("learners", "paper", "adapters")
"""Rooms whose modules may load torch."""


def wrong_way(graph: object) -> list[str]:
    """Return the imports that do not lead to a lower layer."""
    layer = {room: i for i, rooms_ in enumerate(LAYERS) for room in rooms_}
    pairs = [(a, b, room_of(a), room_of(b)) for a, b in graph.edges]  # type: ignore[attr-defined]
    return [f"{a} imports {b}" for a, b, above, below in pairs if above != below and layer[below] >= layer[above]]


def test_every_room_has_a_layer() -> None:
    """The layers name the sub-packages and top modules that there are; little stands at the top."""
    found = {room_of(module) for module in modules(CHECKOUT)}
    assert found == {room for layer in LAYERS for room in layer}
    assert {path.stem for path in (CHECKOUT / PACKAGE).glob("*.py")} == {"__init__", "errors"}


def test_imports_go_one_way() -> None:
    """No import leads up or round, within a room neither; there are few floors."""
    graph = arrows(modules(CHECKOUT))
    assert not wrong_way(graph)
    assert not circles(graph)
    assert not circles(rooms(graph))
    assert max(floors(rooms(graph)).values()) <= MOST_FLOORS


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("errors", "from cirl_marl.network import Network"),
        ("network/units", "if TYPE_CHECKING:\n    from cirl_marl.dynamics.integrator import Dynamics"),
        ("optimum/matrices", "def late():\n    from cirl_marl.optimum import bound"),
    ],
)
def test_a_planted_circle_is_found(tmp_path: Path, module: str, line: str) -> None:
    """One line is enough, at the top, for types only, inside a function, and between modules of one room."""
    for path in modules(CHECKOUT).values():
        copy = tmp_path / path.relative_to(CHECKOUT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    planted = tmp_path / PACKAGE / f"{module}.py"
    planted.write_text(f"{planted.read_text(encoding='utf-8')}\n{line}\n", encoding="utf-8")
    graph = arrows(modules(tmp_path))
    assert circles(graph)
    assert "none" not in "\n".join(drawing(tmp_path)).split("circles of modules")[1].splitlines()[0]
    if module != "optimum/matrices":
        assert wrong_way(graph)


def test_every_kind_of_import_is_read() -> None:
    """Names, modules and packages, plain and from, nested; what is not of the library is nothing."""
    known = [PACKAGE, f"{PACKAGE}.errors", f"{PACKAGE}.network", f"{PACKAGE}.network.units"]
    text = "import numpy\ndef f():\n    import cirl_marl.network.units as u\nfrom cirl_marl.network import Network\n"
    assert imported(text, known) == {f"{PACKAGE}.network", f"{PACKAGE}.network.units"}
    assert imported("from cirl_marl import errors, load_network", known) == {PACKAGE, f"{PACKAGE}.errors"}
    with pytest.raises(ValueError, match="relative imports"):
        imported("from ..optimum import bound", known)


def test_packages_say_their_subject() -> None:
    """The first line of every sub-package is one sentence."""
    for path in some(list((CHECKOUT / PACKAGE).rglob("__init__.py"))):
        first = path.read_text(encoding="utf-8").splitlines()[0]
        assert first.startswith('"""') and first.rstrip('"').endswith("."), path


@pytest.mark.medium
def test_imports_are_light() -> None:
    """Each step in a process loads no more than it needs: what trains nothing neither torch nor mujoco nor pictures."""
    light = [name for name in modules(CHECKOUT) if room_of(name) not in TRAINING and ".robots." not in name]
    light += [
        f"{PACKAGE}.adapters",
        f"{PACKAGE}.learners",
        f"{PACKAGE}.learners.run_directory",
        f"{PACKAGE}.learners.recipe",
        f"{PACKAGE}.paper.row_selection",
    ]
    done = subprocess.run([sys.executable, "-c", LIGHT, *light], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr


LIGHT = """
import sys, importlib
def absent(step, *names):
    assert not {*names} & {*sys.modules}, (step, {*names} & {*sys.modules})
trainers = "torch", "stable_baselines3"
import cirl_marl
from cirl_marl.definitions import catalogue
assert catalogue._read.cache_info().misses == 0, "registering the ids of the catalogue reads its files"
env = cirl_marl.parallel_env("copper_net")
env.reset(seed=0)
env.step(env.neutral_action)
absent("an episode", *trainers, "mujoco", "matplotlib")
for name in sys.argv[1:]:
    importlib.import_module(name)
    absent(name, *trainers, "mujoco", "matplotlib.pyplot")
from cirl_marl import compartments
compartments.model_class("digester")
absent("a kind that is no robot", *trainers, "mujoco")
compartments.models()
absent("asking for all kinds", *trainers)
assert "mujoco" in sys.modules, "robots are none of the kinds"
"""
"""Run in a process of its own, with names of modules that are light."""

TRAINERS = {"torch", "stable_baselines3", "mujoco", "matplotlib", "SALib", "pandas"}
SIMULATOR = {"scipy", "pint", "pydantic", "tomlkit", "cirl_marl.network", "cirl_marl.dynamics"}

BUILDERS = {"pint", "scipy.integrate", "scipy.optimize", "gymnasium_robotics"}


@pytest.mark.parametrize(
    ("arguments", "absent"),
    [
        (["-c", "import cirl_marl"], TRAINERS | SIMULATOR | {"typer", "rich", "pettingzoo"}),
        (["-m", "cirl_marl.cli", "--help"], TRAINERS | SIMULATOR | {"pettingzoo"}),
        (["-m", "cirl_marl.cli", "networks"], TRAINERS | BUILDERS | {"cirl_marl.dynamics", "cirl_marl.optimum"}),
        (["-m", "cirl_marl.cli", "check", "copper_net"], TRAINERS | {"pettingzoo", "cirl_marl.optimum"}),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
@pytest.mark.sample(2)
def test_what_a_start_does_not_load(arguments: list[str], absent: set[str]) -> None:
    """Commands load what they need: seconds would depend on the machine, modules do not."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", *arguments], capture_output=True, text=True, check=True, cwd=CHECKOUT
    )
    loaded = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines() if line.startswith("import time:")}
    assert {"numpy", "typer", PACKAGE} & loaded
    assert sorted(absent & loaded) == []
