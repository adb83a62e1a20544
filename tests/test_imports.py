"""What importing the library costs, and which way imports go."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import cirl_marl

PACKAGE = Path(cirl_marl.__file__).parent
LAYERS = (
    {
        "errors",
        "machine",
        "units",
        "fields",
        "elements",
        "rowsum",
        "validate",
        "validate_services",
        "validate_settings",
        "network",
        "staged",
        "statistics",
    },
    {"compartments"},
    {"schema", "mistakes", "conversion", "definition", "writing", "catalogue"},
    {"batches", "flows", "inner", "simulate", "actuators", "starts", "state", "observe", "reward", "credit"},
    {"vector_env"},
    {"parallel_env", "single_env", "goal_env", "registration"},
    {
        "controllers",
        "optimum",
        "learners",
        "evaluate",
        "remarks",
        "results",
        "schedule",
        "pareto",
        "comparison",
        "report",
        "nested",
        "testing",
    },
    {"paper"},
    {"cli"},
)
"""From the network to the command line; a module imports from its own layer or earlier ones."""


def test_import_is_light() -> None:
    """``import cirl_marl`` loads neither torch nor mujoco."""
    heavy = ("torch", "mujoco", "stable_baselines3")
    code = f"import sys, cirl_marl; print([module for module in {heavy} if module in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def imported(path: Path) -> set[str]:
    """Return the modules of this library that a file imports when it is loaded."""
    names: list[str] = []
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.ImportFrom):
            names += [f"{statement.module}.{alias.name}" for alias in statement.names]
        elif isinstance(statement, ast.Import):
            names += [alias.name for alias in statement.names]
    return {name.split(".")[1] for name in names if name.startswith("cirl_marl.")}


def test_imports_go_one_way() -> None:
    """No module imports, when it is loaded, from a later layer."""
    layer = {module: i for i, modules in enumerate(LAYERS) for module in modules}
    files = [path for path in PACKAGE.rglob("*.py") if path.name != "__init__.py" or path.parent != PACKAGE]
    for path in files:
        own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        assert own in layer, f"{own} belongs to no layer"
        for other in imported(path):
            assert layer[other] <= layer[own], f"{path.name} imports {other}"
