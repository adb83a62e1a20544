"""Scenarios: tables that lie over the default ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cirl_marl import DefinitionError, load_network
from cirl_marl.definitions.catalogue import folder
from cirl_marl.definitions.reader import Definition


@pytest.mark.parametrize(
    ("scenario", "message"),
    [
        ('[scenarios.default]\ntitle = "x"', "scenarios.default: the default scenario is what stands outside"),
        ('[scenarios.other]\nname = "x"', "scenarios.other.name: a scenario cannot set it"),
        ("[scenarios.other]\narcs = 5", "scenarios.other.arcs: must be a table"),
        ("[scenarios.other.nodes.mine.initial]\nlow = 1", "scenarios.other.nodes.mine.initial.high: missing"),
        (
            '[scenarios.other]\nwithout = ["services", "services.copper_in_use"]',
            "scenarios.other.without: 'services.copper_in_use' lies in 'services'",
        ),
        (
            '[scenarios.other.nodes.mine]\nwithout = ["control"]',
            "scenarios.other.nodes.mine.without: unknown key 'without'",
        ),
    ],
)
def test_scenarios_are_strict(tmp_path: Path, scenario: str, message: str) -> None:
    """A scenario replaces whole quantities, with their sources, and nothing that it must not."""
    path = tmp_path / "net.toml"
    path.write_text((folder("envs") / "copper_net.toml").read_text(encoding="utf-8") + "\n" + scenario + "\n")
    with pytest.raises(DefinitionError) as raised:
        Definition(path).check()
    assert message in str(raised.value)


MODEL = "[scenarios.other.nodes.microalgae.model"


@pytest.mark.parametrize(
    ("scenario", "same"),
    [
        (MODEL + '.initial]\nnutrient_umol_l = { low = 5, high = 6, source = "x" }', {"inner": ((20, 30), (5, 6))}),
        (MODEL + ']\nreward_scale = { value = 2, unit = "1", source = "x" }', {"reward_scale": 2.0}),
        (MODEL + ']\nkind = "microalgae_monod"', {}),
        ("[scenarios.other.nodes.microalgae.control]\nhigh = 75", {"high": 75.0}),
    ],
)
def test_scenarios_change_models_and_controls_key_by_key(tmp_path: Path, scenario: str, same: dict[str, Any]) -> None:
    """What they do not give, stays; to repeat the kind changes nothing."""
    path = tmp_path / "net.toml"
    path.write_text((folder("envs") / "net_zero.toml").read_text(encoding="utf-8") + "\n" + scenario + "\n")
    network = Definition(path).network()
    usual, other = (net.compartments["microalgae"] for net in (network, network.scenarios["other"]))
    assert usual.control is not None
    if "high" in same:
        same = {"control": replace(usual.control, **same)}
    assert other == replace(usual, **same)


def test_a_model_or_control_of_another_kind_is_a_new_one(tmp_path: Path) -> None:
    """Nothing of the old one is left: its ranges and its scale would mean something else."""
    path, text = tmp_path / "net.toml", (folder("envs") / "net_zero.toml").read_text(encoding="utf-8")
    droop = text[text.index("[scenarios.droop.nodes.microalgae.model]") : text.index("[scenarios.paper_monod]")]
    path.write_text(text + droop.replace("scenarios.droop", "scenarios.other"))  # without ``without``
    network = Definition(path).network()
    assert network.scenarios["other"].compartments == network.scenarios["droop"].compartments
    path.write_text(text + "\n" + MODEL + ']\nkind = "microalgae_droop"\nsource = "x"\n')
    with pytest.raises(DefinitionError, match="biomass_um3_l"):
        Definition(path).check()


def test_scenarios_are_built_when_asked_for(tmp_path: Path) -> None:
    """A fault in a scenario is told by whoever asks for it, and by a check of the file; the others can be used."""
    text = (folder("envs") / "copper_net.toml").read_text(encoding="utf-8")
    path = tmp_path / "copper.toml"
    path.write_text(text.replace('law = "recipient"', 'law = "receiver"'), encoding="utf-8")
    usual = load_network(path)
    assert list(usual.scenarios) == ["paper", "outages"]
    said = r"copper.toml: scenarios.paper.arcs.mine_to_refinery.law: unknown value 'receiver'"
    with pytest.raises(DefinitionError, match=said):
        usual.scenario("paper")
    with pytest.raises(DefinitionError, match=said):
        Definition(path).check()
    sound = load_network("copper_net")
    assert sound.scenario("paper") is sound.scenario("paper")
    assert sound.scenario("paper").scenario("default") == sound
    with pytest.raises(KeyError):
        sound.scenarios["default"]


def test_scenarios_do_not_repeat_what_is_wrong_by_default(tmp_path: Path) -> None:
    """A fault outside [scenarios] is told once."""
    text = (folder("envs") / "net_zero.toml").read_text(encoding="utf-8")
    assert 'to = "atmosphere"' in text
    path = tmp_path / "net.toml"
    path.write_text(text.replace('to = "atmosphere"', 'to = "atmosfere"'), encoding="utf-8")
    with pytest.raises(DefinitionError) as raised:
        Definition(path).check()
    (line,) = str(raised.value).splitlines()
    assert "unknown node 'atmosfere'" in line
