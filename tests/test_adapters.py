"""Adapters without what they adapt to; with it each is checked in an environment of its own, by ``make adapters``."""

from __future__ import annotations

import sys
import tomllib
from importlib import import_module, invalidate_caches
from pathlib import Path

import pytest
from adapters.run import CONTRACTS

import cirl_marl.adapters
from benchmarks.peers.contenders import CONTENDERS

ROOT = Path(__file__).parent.parent
PACKAGES = {"torchrl": "torchrl", "benchmarl": "benchmarl", "rllib": "ray", "supersuit": "supersuit"}


@pytest.mark.parametrize(("name", "package"), PACKAGES.items())
def test_what_to_install_is_said(name: str, package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose package is missing; the extra is one of this library, or the package one that it needs anyway."""
    module = f"cirl_marl.adapters.{name}"
    monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    invalidate_caches()
    with pytest.raises(ModuleNotFoundError) as missing:
        import_module(module)
    words, _, requirement = str(missing.value).rpartition("pip install ")
    assert words == f"this adapter needs the package {package}, which is not installed: "
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extra = requirement.removeprefix("'cirl-marl[").removesuffix("]'")
    wanted = project["dependencies"] if extra == requirement else project["optional-dependencies"][extra]
    assert any(each.startswith(package) for each in wanted)


def test_every_adapter_is_checked() -> None:
    """Each has a contract, and an example of at most thirty lines that trains on copper_net."""
    folder = Path(cirl_marl.adapters.__file__).parent
    needs_nothing_more = {"differentiable"}  # PyTorch is there; tests/test_differentiable.py checks it
    adapters = {path.stem for path in folder.glob("[!_]*.py")}
    assert adapters - needs_nothing_more == set(CONTRACTS) == set(PACKAGES)
    assert needs_nothing_more < adapters
    for name, contract in CONTRACTS.items():
        assert contract.is_file()
        lines = (ROOT / "examples" / "adapters" / f"train_{name}.py").read_text(encoding="utf-8").splitlines()
        assert len(lines) <= 30
        assert any(f"from cirl_marl.adapters.{name} import" in line for line in lines)
        assert any('"copper_net"' in line for line in lines)
    assert set(CONTRACTS) - {"supersuit"} <= set(CONTENDERS)
