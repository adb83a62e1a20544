"""Versioned ids: the table is that of the catalogue, its figures hold, and an old version names its successor."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import pytest
from environment_ids import figures_of, has_changed, names

import cirl_marl
from cirl_marl import CirlError, MultiAgentVectorEnv, load_network, parallel_env, single_agent_env
from cirl_marl.definitions import ids as table
from cirl_marl.environments.registration import register

ROOT = Path(cirl_marl.__file__).parent.parent


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let a table know a second version of copper_net."""
    path = tmp_path / "ids.json"
    path.write_text(json.dumps({"cirl_marl/copper_net-v1": [0.0], "cirl_marl/copper_net.paper-v0": [0.0]}))
    monkeypatch.setattr(table, "TABLE", path)
    table.figures.cache_clear()
    table.ids.cache_clear()
    yield
    table.figures.cache_clear()
    table.ids.cache_clear()


@pytest.mark.slow
def test_the_table_is_that_of_the_catalogue() -> None:
    """Every network, scenario and environment of the paper has one id, and there is no other."""
    assert sorted(table.ids()) == sorted(names()), "run python tests/environment_ids.py"
    assert len(table.figures()) == len(table.ids())


@pytest.mark.sample(12)
@pytest.mark.parametrize("name", table.ids())
def test_figures_are_those_of_the_version(name: str) -> None:
    """Who changes the numbers of an environment raises its version."""
    id_ = table.ids()[name]
    if has_changed(table.figures()[id_], figures_of(name)):
        pytest.fail(
            f"{id_} has other numbers: if they are meant, run python tests/environment_ids.py: its version rises"
        )


def test_functions_take_ids() -> None:
    """An id stands for a network under a scenario wherever a name does."""
    assert load_network("cirl_marl/copper_net-v0") is load_network("copper_net")
    paper = load_network("cirl_marl/copper_net.paper-v0")
    assert (
        paper
        == load_network("cirl_marl/copper_net-v0", scenario="paper")
        == load_network("copper_net", scenario="paper")
    )
    assert str(parallel_env("cirl_marl/copper_net-v0")) == parallel_env("copper_net").metadata["name"] == "copper_net"
    assert str(MultiAgentVectorEnv("cirl_marl/copper_net.paper-v0", num_envs=1)) == "copper_net.paper"
    alone = single_agent_env("cirl_marl/net_zero.paper_monod-v0")
    assert str(alone) == alone.metadata["name"] == "net_zero.paper_monod"
    with pytest.raises(CirlError, match=r"unknown environment .*Did you mean 'cirl_marl/copper_net-v0'"):
        load_network("cirl_marl/coper_net-v0")
    with pytest.raises(CirlError, match="unknown environment"):
        load_network("cirl_marl/copper_net-v7")
    with pytest.raises(CirlError, match="unknown scenario"):
        load_network("cirl_marl/copper_net.paper-v0", scenario="papers")


def test_an_old_version_names_its_successor(planted: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers of another version are not passed off as those that were asked for."""
    with pytest.raises(CirlError, match=r"out of date, as its numbers have changed: use 'cirl_marl/copper_net-v1'"):
        parallel_env("cirl_marl/copper_net-v0")
    assert parallel_env("cirl_marl/copper_net-v1").network.name == "copper_net"
    ours = [id_ for id_ in gymnasium.registry if id_.startswith("cirl_marl/")]
    for id_ in ours:
        monkeypatch.delitem(gymnasium.registry, id_)
    register()
    try:
        with (
            pytest.warns(DeprecationWarning, match="out of date"),
            pytest.raises(gymnasium.error.DeprecatedEnv, match="Please use `cirl_marl/copper_net-v1` instead"),
        ):
            gymnasium.make("cirl_marl/copper_net-v0")
    finally:
        del gymnasium.registry["cirl_marl/copper_net-v1"]
        gymnasium.registry.pop("cirl_marl/copper_net.paper-v0", None)


@pytest.mark.parametrize(
    "code",
    [
        "import cirl_marl, gymnasium; gymnasium.make('cirl_marl/net_zero-v0')",
        "import gymnasium; gymnasium.make('cirl_marl:cirl_marl/net_zero.droop-v0').close(); "
        "gymnasium.make_vec('cirl_marl:cirl_marl/CopperNet-v0', num_envs=2)",
    ],
)
@pytest.mark.medium
@pytest.mark.sample(1)
def test_gymnasium_knows_them_whoever_comes_first(code: str, tmp_path: Path) -> None:
    """In a checkout that is not installed, in either order of imports."""
    command = [sys.executable, "-W", "error", "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r}); {code}.close()"]
    subprocess.run(command, check=True, cwd=tmp_path)
