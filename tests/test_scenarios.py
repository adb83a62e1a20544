"""Scenarios: tables that lie over the default ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cirl_marl import DefinitionError
from cirl_marl.definitions.catalogue import folder
from cirl_marl.definitions.reading import read_network


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
        read_network(path)
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
    network = read_network(path)
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
    network = read_network(path)
    assert network.scenarios["other"].compartments == network.scenarios["droop"].compartments
    path.write_text(text + "\n" + MODEL + ']\nkind = "microalgae_droop"\nsource = "x"\n')
    with pytest.raises(DefinitionError, match="biomass_um3_l"):
        read_network(path)
