"""Plans as they are read: levers in words, what they save, and the workbook beside the table."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from openpyxl import load_workbook
from small_networks import ONE_OF_EACH
from typer.testing import CliRunner

from cirl_marl import MultiAgentVectorEnv
from cirl_marl.cli import app
from cirl_marl.controllers import Constant
from cirl_marl.controllers.schedule import Schedule, schedule
from cirl_marl.report.decisions import NO_WORKBOOK, levers, savings, write_decisions

EXAMPLE = Path(__file__).parent.parent / "examples" / "metal_cycle.toml"


def planned(network: str, held: dict[str, float], scenario: str | None = None) -> Schedule:
    """Return an episode in which some agents hold an action and the others are neutral."""
    env = MultiAgentVectorEnv(network, num_envs=1, scenario=scenario)
    return schedule(env, Constant(held))


def test_levers_are_said_in_words() -> None:
    """A share in percent and points, a flow with its change, a lifetime in percent; what nobody moved comes last."""
    found = planned("copper_net", {"mine": -1.0})
    first = levers(found)[0]
    assert first.name == found.network.compartments["mine"].label
    assert first.text(0) == "flow -100 %" and first.change > 0.3
    assert all(lever.change < 1e-9 for lever in levers(found)[1:])
    lives = planned("steel_japan", {"vehicles": 1.0, "old_scrap": 1.0}, "longer_lives")
    by_name = {lever.name: lever for lever in levers(lives)}
    assert by_name["Vehicles"].text(0) == "lifetime +0 %" and by_name["Vehicles"].text(25) == "lifetime +25 %"
    share = by_name["collection of old scrap"]
    assert share.text(25).startswith("88.0 % of Discards (+") and share.text(25).endswith("points)")
    np.testing.assert_allclose(share.usual, share.usual[0])


@pytest.mark.medium
@pytest.mark.sample(3)
@pytest.mark.parametrize("network", [name for name in ONE_OF_EACH if name not in ("solids_net", "net_zero")])
def test_savings_are_what_circularity_is_made_of(network: str) -> None:
    """Reservoirs, landfills and the environment add up to −λ̄, as planned and as usual."""
    found = planned(network, {})
    assert np.isclose(found.rollout.episode_circularity[0], found.usual.episode_circularity[0])
    moved = planned(network, {found.agents[0]: 1.0})
    length = found.network.episode.horizon * found.network.episode.control_interval
    for k, run in enumerate((moved.rollout, moved.usual)):
        total = sum(float(each[1 + k]) for each in savings(moved.network, moved.rollout, moved.usual))
        expected = -run.episode_circularity[0] * length / moved.network.objective.reference_interval
        assert total == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_what_is_saved_is_told_apart() -> None:
    """What leaves reservoirs, and what is put into landfills."""
    found = planned("steel_japan", {"old_scrap": 1.0})
    told = {what: (plan, usual) for what, plan, usual in savings(found.network, found.rollout, found.usual)}
    arcs = found.network.arcs
    for what, ends in (
        ("taken from reservoirs", [arc.donor in ("mine", "mine_abroad") for arc in arcs]),
        ("put into landfills", [arc.recipient in ("losses", "uncollected") for arc in arcs]),
    ):
        masses = [float(run.flow[:, np.array(ends)].sum()) for run in (found.rollout, found.usual)]
        assert told.pop(what) == pytest.approx(masses) and masses[0] < masses[1]
    assert not told


def test_the_workbook_has_everything(tmp_path: Path) -> None:
    """Decisions with years, stocks, flows and savings; the numbers are those of the episode."""
    found = planned(str(EXAMPLE), {"old_scrap": 1.0})
    book, picture = write_decisions(tmp_path / "plan.csv", found, title="a plan")
    assert picture.read_bytes().startswith(b"\x89PNG")
    sheets = {sheet.title: list(sheet.iter_rows(values_only=True)) for sheet in load_workbook(book)}
    assert list(sheets) == ["decisions", "stocks", "flows", "savings"]
    header, first, *_ = sheets["decisions"]
    assert header == ("when", "lever", "in words", "value", "as usual", "unit")
    assert first[0] == "2020" and first[1].startswith("old scrap") and first[3] == pytest.approx(0.5)
    stocks = np.array([row[1:] for row in sheets["stocks"][1:]], dtype=float)
    np.testing.assert_allclose(stocks[:, ::2], found.rollout.stock)
    np.testing.assert_allclose(stocks[:, 1::2], found.usual.stock)
    flows = np.array([row[1:] for row in sheets["flows"][1:]], dtype=float)
    np.testing.assert_allclose(flows[:, ::2], found.rollout.flow)
    assert sheets["savings"][0] == ("in all (Mt)", "as usual", "plan", "saved")


def test_the_command_says_what_to_do(tmp_path: Path) -> None:
    """Levers in words, what they save, business as usual; three files."""
    out = tmp_path / "plan.csv"
    run = CliRunner().invoke(app, ["plan", str(EXAMPLE), "--control", "random", "--out", str(out)])
    assert run.exit_code == 0, run.output
    assert "what to do, beside business as usual" in run.output and "as usual: λ̄ = " in run.output
    assert "taken from reservoirs" in run.output
    assert sorted(each.name for each in tmp_path.iterdir()) == ["plan.csv", "plan.png", "plan.xlsx"]


def test_without_openpyxl_there_is_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The CSV and the picture are written, and a line says how to get the workbook."""
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    run = CliRunner().invoke(app, ["plan", str(EXAMPLE), "--control", "random", "--out", str(tmp_path / "plan.csv")])
    assert run.exit_code == 0 and NO_WORKBOOK in run.output and "pip install 'cirl-marl[excel]'" in NO_WORKBOOK
    assert sorted(file.name for file in tmp_path.iterdir()) == ["plan.csv", "plan.png"]
