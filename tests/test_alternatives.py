"""Scenarios and controllers side by side: each as it is alone, what differs first, whole files or none."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from cirl_marl import CirlError, MultiAgentVectorEnv, cli
from cirl_marl.controllers.rollout import Rollout, episode_start
from cirl_marl.evaluation.compared_quantities import ComparedQuantity, rank_quantities
from cirl_marl.evaluation.simulations import Simulation, simulate_alternatives
from cirl_marl.optimum.registry import named_controller
from cirl_marl.report import differences as report
from cirl_marl.report import panels, trajectory

GUIDE = Path(__file__).parent.parent / "envs" / "README.md"
SCENARIOS = """
[scenarios.ban]
without = ["arcs.disposal", "services.bottles_in_use"]
[scenarios.same]
title = "What is so already"
[scenarios.fine.episode]
control_interval = { value = 0.25, unit = "day", source = "test" }
horizon = { value = 12, unit = "1", source = "test" }
[scenarios.long.episode]
horizon = { value = 7, unit = "1", source = "test" }
[scenarios.hours.units]
time = "hour"
[scenarios.pounds.units]
mass = "pound"
[scenarios.weekly.objective]
reference_interval = { value = 7, unit = "day", source = "test" }
[scenarios.dated.episode]
start = 2020-02-28
"""


MORE = """
[services.reserve]
provider = "quarry"
quantity = "stock"
low = { value = 20000, unit = "t", source = "test" }
weight = { value = 1, unit = "1", source = "test" }
[services.more]
provider = "households"
quantity = "stock"
low = { value = 150, unit = "t", source = "test" }
weight = { value = 1, unit = "1", source = "test" }
[services.most]
provider = "households"
quantity = "stock"
low = { value = 1500, unit = "t", source = "test" }
weight = { value = 1, unit = "1", source = "test" }
[nodes.world]
role = "technosphere"
initial = { low = 3, high = 3, unit = "t", source = "too little" }
[arcs.imports]
from = "world"
to = "households"
law = "controlled"
control = { kind = "flow", low = 0, neutral = 10, high = 20, unit = "t/day", source = "trade" }
"""
"""Further services, and an order that is cut."""


@pytest.fixture(autouse=True)
def definition(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write the network of the guide, for six intervals of half a day, with more scenarios, and run the test there."""
    text = GUIDE.read_text().split("```toml\n")[1].split("```")[0]
    text = text.replace("control_interval = { value = 1,", "control_interval = { value = 0.5,")
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "bottles.toml"
    path.write_text(text.replace("horizon = { value = 60", "horizon = { value = 6") + SCENARIOS)
    return path


def alone(
    network: str | Path, scenario: str | None, control: str, seed: int | None
) -> tuple[MultiAgentVectorEnv, Rollout]:
    """Return what a single simulation finds."""
    env = MultiAgentVectorEnv(network, num_envs=1, scenario=scenario)
    begun = episode_start(env, seed)
    return env, begun.play(env, named_controller(control))


def figures(network: str | Path, scenario: str | None, control: str, seed: int | None) -> dict[str, float]:
    """Return the figures of a single simulation by name, summed up from its trajectory."""
    env, run = alone(network, scenario, control, seed)
    found = {"mean circularity": float(run.circularity_mean[0].mean())}
    for i, service in enumerate(env.network.services):
        found[f"mean level of service {service.id}"] = float(run.levels[0, i].mean())
    for k, arc in enumerate(env.network.arcs):
        found[f"total flow of {arc.id}"] = float(run.flow[:, k].sum() * env.network.episode.control_interval)
    for i, node in enumerate(env.network.stores):
        found[f"final stock of {node.id}"] = float(run.stock[-1, i])
    return found


def cirl(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run ``cirl simulate`` and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["cirl", "simulate", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


def repeated(option: str, *values: str) -> tuple[str, ...]:
    """Give an option once for each value."""
    return tuple(word for value in values for word in (f"--{option}", value))


def named(quantities: list[ComparedQuantity]) -> dict[str, ComparedQuantity]:
    """Return quantities by their names."""
    return {each.name: each for each in quantities}


@pytest.mark.parametrize("seed", [None, 2])
def test_each_alternative_is_what_it_is_alone(definition: Path, seed: int | None) -> None:
    """Whoever acted before in the same environment; scenario by scenario, each from the same seed."""
    scenarios, controls = (None, "crisis", "ban"), ("random", "neutral")
    found = simulate_alternatives(definition, scenarios=scenarios, controls=controls, seed=seed)
    names = [f"{scenario or 'default'}, {control}" for scenario in scenarios for control in controls]
    assert [each.name for each in found] == names
    pairs = [(scenario, control) for scenario in scenarios for control in controls]
    for (scenario, control), each in zip(pairs, found, strict=True):
        env, run = alone(definition, scenario, control, seed)
        assert (each.network.scenario_name, each.control) == (scenario or "default", control)
        for array in ("circularity", "levels", "stock", "flow"):
            np.testing.assert_array_equal(getattr(each.rollout, array), getattr(run, array))
        episode_start(env, seed).reset(env)
        np.testing.assert_array_equal(each.rollout.start, env.physical.stock[env.rows.nodes, 0])
    assert (found[0].rollout.start != found[0].rollout.stock[-1]).any()


def test_names_say_what_there_are_several_of(definition: Path) -> None:
    """What all have in common need not be said."""
    assert [each.name for each in simulate_alternatives(definition)] == [""]
    assert [each.name for each in simulate_alternatives(definition, controls=["random", "neutral"])] == [
        "random",
        "neutral",
    ]
    found = simulate_alternatives(definition, scenarios=["crisis", None], controls=["random"], steps=2)
    assert [(each.name, len(each.rollout.stock)) for each in found] == [("crisis", 2), ("default", 2)]


def test_quantities_are_those_of_single_simulations(definition: Path) -> None:
    """Of λ̄, services, arcs and nodes; what a scenario lacks has no value, and neither has a difference to it."""
    scenarios = ("crisis", "default", "ban")
    quantities = named(rank_quantities(simulate_alternatives(definition, scenarios=scenarios, controls=["random"])))
    expected = [figures(definition, scenario, "random", None) for scenario in scenarios]
    assert set(quantities) == set(expected[0])
    assert len(quantities) == 7 and len(expected[2]) == 5
    for name, quantity in quantities.items():
        values = np.array([each.get(name, math.nan) for each in expected])
        np.testing.assert_allclose(quantity.values, values, rtol=1e-12)
        np.testing.assert_allclose(quantity.differences, values - values[0], rtol=1e-9, atol=1e-9)
        reference = math.nan if values[0] == 0 else abs(values[0])
        np.testing.assert_allclose(quantity.relative_differences, (values - values[0]) / reference, atol=1e-9)
        assert quantity.unit == ("1" if quantity.kind == "service" else "t")
    assert quantities["mean circularity"].values[0] < 0, "relative differences are to the magnitude"


def test_what_differs_most_comes_first(definition: Path) -> None:
    """By the largest relative difference of any alternative; what appears or goes before what changes."""
    found = rank_quantities(simulate_alternatives(definition, scenarios=["ban", "crisis", None]))
    ranks = [each.rank for each in found]
    assert ranks == sorted(ranks, reverse=True)
    assert {each.name for each in found[:3]} == {
        "mean level of service bottles_in_use",
        "total flow of disposal",
        "final stock of landfill",
    }
    changes = [np.nanmax(np.abs(each.relative_differences)) for each in found[3:]]
    np.testing.assert_allclose([each.rank for each in found[3:]], changes)
    same = rank_quantities(simulate_alternatives(definition, scenarios=[None, "same"]))
    assert [each.rank for each in same] == [0.0] * 7
    without = rank_quantities(simulate_alternatives(definition, scenarios=["ban"], controls=["random", "neutral"]))
    assert {each.kind for each in without} == {"circularity", "flow", "stock"}


@pytest.mark.parametrize(
    ("values", "rank"),
    [
        ((-2.0, -3.0, -1.5), 0.5),
        ((2.0, 1.0, 2.2), 0.5),
        ((0.0, 2.0, 0.0), 2e9),
        ((math.nan, 2.0, 1.0), 2e9),
        ((4.0, 4.0, math.nan), 1.0),
        ((5e-10, 6e-10, 0.0), 0.0),
        ((1.0, 1.0 + 5e-10, 1.0), 0.0),
        ((math.nan, 0.0, 0.0), 0.0),
    ],
)
def test_ranks(values: tuple[float, ...], rank: float) -> None:
    """Signs do not count, what does not exist is 0, and round-off is no difference."""
    quantity = ComparedQuantity("flow", "a", "t", np.array(values), 1e-9)
    assert quantity.rank == pytest.approx(rank, rel=1e-12)


def test_round_off_is_of_the_same_kind(definition: Path) -> None:
    """A service level is not lost in the tonnes of a reserve."""
    quantities = named(rank_quantities(simulate_alternatives(definition, scenarios=[None, "crisis"])))
    level, stock = quantities["mean level of service bottles_in_use"], quantities["final stock of landfill"]
    assert level.round_off == pytest.approx(1e-12 * level.values[0])
    assert stock.round_off == pytest.approx(1e-12 * quantities["final stock of quarry"].values[0])


def test_intervals_may_differ_if_episodes_last_alike(definition: Path) -> None:
    """Without anyone acting the same masses move in them."""
    found = simulate_alternatives(definition, scenarios=[None, "fine"])
    assert [len(each.rollout.flow) for each in found] == [6, 12]
    flows = [each for each in rank_quantities(found) if each.kind == "flow"]
    assert [each.values[1] for each in flows] == pytest.approx([each.values[0] for each in flows], rel=1e-9)


def test_only_controllers_that_take_values_hold_them(definition: Path) -> None:
    """The others act as they do."""
    found = simulate_alternatives(definition, controls=["neutral", "constant"], constants={"quarry": -1.0})
    flows = [each.rollout.flow[:, each.network.arc_index["glassworks"]] for each in found]
    assert (flows[0] > 4).all() and (flows[1] == 0).all()


def test_progress_is_that_of_all(definition: Path) -> None:
    """It never goes back, and ends when the last episode does."""
    shares: list[float] = []
    simulate_alternatives(
        definition, scenarios=[None, "crisis"], controls=["neutral", "random"], progress=shares.append
    )
    assert shares == pytest.approx([i / 24 for i in range(1, 25)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenarios": []}, "no scenario is given"),
        ({"controls": []}, "no control is given"),
        ({"scenarios": [None, "default"]}, "scenario 'default' is given 2 times"),
        (
            {"controls": ["random", "neutral"], "constants": {"quarry": 1.0}},
            "go with constant or scripted, not with random",
        ),
    ],
)
def test_alternatives_that_make_no_sense(options: dict[str, list[str]], message: str, definition: Path) -> None:
    """They are refused in Python too."""
    with pytest.raises(CirlError, match=message):
        simulate_alternatives(definition, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (repeated("scenario", "ban", "crysis"), "unknown scenario 'crysis'. Did you mean 'crisis'? Known: ban, crisis"),
        (repeated("control", "neutral", "randon"), "unknown control 'randon'. Did you mean 'random'? Known: neutral"),
        (repeated("scenario", "ban", "crisis", "ban"), "scenario 'ban' is given 2 times"),
        (repeated("control", "neutral", "neutral"), "control 'neutral' is given 2 times"),
        (
            repeated("scenario", "ban", "long"),
            "scenarios 'ban' and 'long' cannot be compared: horizon 6 intervals of 0.5 day and 7 intervals of 0.5 day; "
            "give a number of steps for both\n",
        ),
        (
            repeated("scenario", "long", "fine"),
            "cannot be compared: horizon 7 intervals of 0.5 day and 12 intervals of 0.25 day\n",
        ),
        (repeated("scenario", "default", "hours"), "cannot be compared: unit of time day and hour\n"),
        (repeated("scenario", "default", "pounds"), "cannot be compared: unit of mass t and pound\n"),
        (repeated("scenario", "default", "weekly"), "cannot be compared: reference interval of λ 1 and 7 day\n"),
        (repeated("scenario", "crisis", "dated"), "cannot be compared: start on the calendar none and 2020-02-28\n"),
        (
            (*repeated("control", "neutral", "random"), "--set", "quarry=1"),
            "--set goes with --control constant or scripted, not with neutral, random",
        ),
        ((*repeated("control", "neutral", "random"), "--out", "bottles.toml"), "--out bottles.toml: is a file"),
    ],
)
def test_bad_input_is_refused_before_anything_is_simulated(
    arguments: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The message names both values, or the nearest right one; nothing is written."""
    monkeypatch.setattr("cirl_marl.controllers.rollout.rollout", None)
    assert cirl(monkeypatch, "bottles.toml", *arguments) == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["bottles.toml"]


def test_a_controller_that_cannot_act_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With its scenario, if there are several of these; nothing is left of those that can."""
    held = ("--control", "constant", "--set", "disposal=1", "--out", "new")
    assert cirl(monkeypatch, "bottles.toml", *repeated("scenario", "crisis", "ban"), *held) == 2
    assert "error: ban: constant control: unknown agent 'disposal'" in capsys.readouterr().err
    assert cirl(monkeypatch, "bottles.toml", "--scenario", "ban", *held) == 2
    assert "error: constant control: unknown agent 'disposal'" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["bottles.toml"]


def table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_files_of_scenarios(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Each CSV is that of the scenario by itself, and the table is of their figures."""
    scenarios = ("default", "crisis", "ban")
    assert cirl(monkeypatch, "bottles.toml", *repeated("scenario", *scenarios), "--seed", "1", "--out", "all") == 0
    printed = capsys.readouterr().out
    stems = ("bottles_neutral", "bottles_crisis_neutral", "bottles_ban_neutral")
    both = ("bottles_differences.csv", "bottles_differences.png")
    assert {path.name for path in Path("all").iterdir()} == {*(f"{stem}.csv" for stem in stems), *both}
    assert [line for line in printed.splitlines() if line.startswith("wrote")] == [
        f"wrote all/{name}" for name in (*(f"{stem}.csv" for stem in stems), *both)
    ]
    for scenario, stem in zip(scenarios, stems, strict=True):
        assert cirl(monkeypatch, "bottles.toml", "--scenario", scenario, "--seed", "1", "--out", "one") == 0
        alone_said = capsys.readouterr().out.splitlines()
        assert Path(f"one/{stem}.csv").read_bytes() == Path(f"all/{stem}.csv").read_bytes()
        assert Path(f"one/{stem}.png").is_file()
        assert alone_said[0] == "start: the first episode of evaluation 1"
        figures_said = [line for line in alone_said if not line.startswith("wrote")]
        assert [f"{scenario}: {line}" for line in figures_said] == [
            line for line in printed.splitlines() if line.startswith(f"{scenario}: ")
        ]
    expected = [figures("bottles.toml", scenario, "neutral", 1) for scenario in scenarios]
    rows = table(Path("all/bottles_differences.csv"))
    assert {row["quantity"] for row in rows} == set(expected[0])
    for row in rows:
        first, *others = [each.get(row["quantity"]) for each in expected]
        assert row["unit"] == ("1" if "service" in row["quantity"] else "t")
        assert first is not None and float(row["default"]) == pytest.approx(first, rel=1e-12)
        for scenario, value in zip(scenarios[1:], others, strict=True):
            told = [row[f"{what}{scenario}"] for what in ("", "difference of ", "relative difference of ")]
            if value is None:
                assert told == [""] * 3
            else:
                assert float(told[0]) == pytest.approx(value, rel=1e-12)
                assert float(told[1]) == pytest.approx(value - first, abs=1e-9)
                assert float(told[2]) == pytest.approx((value - first) / abs(first), abs=1e-9)
    assert list(rows[0])[:3] == ["quantity", "unit", "default"]


def test_what_is_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A row for each quantity that differs, in the order of the file; a dash for what is not there."""
    assert cirl(monkeypatch, "bottles.toml", *repeated("scenario", "ban", "default", "crisis")) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any("differences to ban stand below the values" in line for line in lines)
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines if line.startswith("│")]
    rows = table(Path("bottles_differences.csv"))
    assert [row[0] for row in cells if row[0]] == [row["quantity"] for row in rows]
    disposal = next(i for i, row in enumerate(cells) if row[0] == "total flow of disposal")
    assert cells[disposal][1:3] == ["t", "–"]
    assert cells[disposal + 1][0] != "", "without a first value there is no difference"
    quarry = next(i for i, row in enumerate(cells) if row[0] == "final stock of quarry")
    ban, usual, crisis = (float(rows[[row["quantity"] for row in rows].index("final stock of quarry")][each])
                          for each in ("ban", "default", "crisis"))  # fmt: skip
    assert cells[quarry][2:] == [f"{value:.5g}" for value in (ban, usual, crisis)]
    assert cells[quarry + 1] == ["", "", "", "", f"{crisis - ban:+.4g} ({100 * (crisis - ban) / ban:+.3g}%)"]
    landfill = next(i for i, row in enumerate(cells) if row[0] == "final stock of landfill")
    assert cells[landfill][2] == "0" and "%" not in cells[landfill + 1][3], "nothing is relative to 0"
    assert "7 of 7 quantities differ; all are in bottles_differences.csv" in lines


def test_long_and_empty_tables(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Only the first rows are printed, and where the others are; where nothing differs there is no table."""
    options = ("--steps", "2", "--out", "long", *repeated("control", "random", "constant"), "--set", "mine=1")
    assert cirl(monkeypatch, "copper_net", *options) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(table(Path("long/copper_net_random.csv"))) == 1 + 2
    rows = [line.split("│")[1].strip() for line in lines if line.startswith("│")]
    in_file = [row["quantity"] for row in table(Path("long/copper_net_differences.csv"))]
    assert [row for row in rows if row] == in_file[:12]
    said = "quantities differ, of which 12 are shown; all are in long/copper_net_differences.csv"
    (told,) = [line for line in lines if line.endswith(said)]
    assert told.split()[1:3] == ["of", str(len(in_file))] and 12 < int(told.split()[0]) <= len(in_file)
    assert cirl(monkeypatch, "bottles.toml", *repeated("scenario", "default", "same")) == 0
    printed = capsys.readouterr().out
    assert "0 of 7 quantities differ; all are in bottles_differences.csv" in printed.splitlines()
    assert "│" not in printed


def test_whole_files_or_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the picture fails there is no table either."""

    def fail(*arguments: object, **options: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(report, "save_alternatives", fail)
    assert cirl(monkeypatch, "bottles.toml", *repeated("control", "random", "neutral"), "--out", "new") == 2
    assert [path.name for path in Path().iterdir()] == ["bottles.toml"]


def test_what_is_said_of_each(
    definition: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every line about an alternative begins with its name: levels of services, and flows that were cut."""
    definition.write_text(definition.read_text() + MORE)
    assert cirl(monkeypatch, "bottles.toml", *repeated("scenario", "default", "crisis")) == 0
    printed = capsys.readouterr().out.splitlines()
    for scenario in ("default", "crisis"):
        _, levels, shares, cut = (each for each in printed if each.startswith(f"{scenario}: ") and "λ̄" not in each)
        assert levels.startswith(f"{scenario}: service levels: bottles_in_use ")
        assert shares.startswith(f"{scenario}: end-of-life recycling rate ")
        assert cut.startswith(f"{scenario}: arc 'imports' moved ")


def test_titles(monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture names the network, and the controller if there is but one."""
    said: list[str] = []
    for module, name in ((trajectory, "save_trajectory"), (report, "save_alternatives")):
        monkeypatch.setattr(module, name, lambda *arguments, **options: said.append(options["title"]))
    for options in (("scenario", "ban"), ("scenario", "ban", "crisis"), ("control", "random", "neutral")):
        assert cirl(monkeypatch, "bottles.toml", *repeated(*options)) == 0
    assert said == ["Glass bottles of a town, neutral control", "bottles, neutral control", "bottles"]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Callable[[list[Simulation]], Figure]:
    """Return what draws alternatives without writing a file."""
    figures: list[Figure] = []
    monkeypatch.setattr(panels, "save", lambda figure, path: figures.append(figure))

    def draw(found: list[Simulation]) -> Figure:
        report.save_alternatives("x.png", found, rank_quantities(found), title="heading")
        return figures[-1]

    return draw


def test_picture_lays_trajectories_over_each_other(
    definition: Path, drawn: Callable[[list[Simulation]], Figure]
) -> None:
    """Means in the middle of their intervals, stocks from the start on; who lacks something has no line there."""
    found = simulate_alternatives(definition, scenarios=[None, "crisis", "ban"])
    figure = drawn(found)
    assert figure.get_suptitle() == "heading"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["default", "crisis", "ban"]
    panels = {axes.get_title(loc="left"): axes for axes in figure.axes if axes.axison}
    usual = found[0].rollout
    middle, ends = np.arange(6) * 0.5 + 0.25, np.arange(7) * 0.5
    expected: dict[str, tuple[str, Any, Any]] = {
        "Mean circularity": ("λ / t", middle, usual.circularity_mean[0]),
        "Service: bottles in use": ("service level", middle, usual.levels[0, 0]),
        "Flow: glassworks": ("t/day", middle, usual.flow[:, 0]),
        "Flow: disposal": ("t/day", middle, usual.flow[:, 1]),
        "Stock: quarry": ("t", ends, np.append(1e4, usual.stock[:, 0])),
        "Stock: households": ("t", ends, np.append(100, usual.stock[:, 1])),
        "Stock: landfill": ("t", ends, np.append(0, usual.stock[:, 2])),
    }
    assert list(panels)[:2] == ["Mean circularity", "Service: bottles in use"]
    assert set(panels) == set(expected)
    for title, (unit, time, values) in expected.items():
        axes = panels[title]
        assert (axes.get_ylabel(), axes.get_xlabel()) == (unit, "time / day")
        assert axes.get_xlim() == (0.0, 3.0)
        lines = [np.array(line.get_data(), dtype=float) for line in axes.lines]
        assert len(lines) == (2 if title in ("Service: bottles in use", "Flow: disposal") else 3)
        np.testing.assert_allclose(lines[0], [time, values], rtol=1e-12)
    for look in ("color", "linestyle"):  # by which lines that lie upon each other are told apart
        assert len({getattr(line, f"get_{look}")() for line in panels["Mean circularity"].lines}) == 3
    assert panels["Service: bottles in use"].get_ylim() == (-0.03, 1.06)
    crisis = panels["Flow: disposal"].lines[1]
    np.testing.assert_array_equal(crisis.get_ydata(), found[1].rollout.flow[:, 1])
    assert crisis.get_color() == panels["Mean circularity"].lines[1].get_color()


def test_picture_shows_what_differs_most(definition: Path, drawn: Callable[[list[Simulation]], Figure]) -> None:
    """At most eight panels, in the order of the table; what is the same in all is left out, λ and services are not."""
    found = simulate_alternatives("copper_net", controls=["random", "neutral"], steps=2)
    panels = [axes.get_title(loc="left") for axes in drawn(found).axes]
    most = [each.of.replace("_", " ") for each in rank_quantities(found) if each.kind in ("flow", "stock")]
    assert len(panels) == 8
    assert [panel.split(": ")[1] for panel in panels[2:]] == most[:6]
    assert len(most) > 6
    figure = drawn(simulate_alternatives(definition, scenarios=[None, "same"]))
    shown = [axes.get_title(loc="left") for axes in figure.axes if axes.axison]
    assert shown == ["Mean circularity", "Service: bottles in use"]


def test_single_intervals_and_years(definition: Path, drawn: Callable[[list[Simulation]], Figure]) -> None:
    """A lone mean is a dot; a network that begins on the calendar is drawn in years."""
    figure = drawn(simulate_alternatives(definition, controls=["random", "neutral"], steps=1))
    assert {line.get_marker() for line in figure.axes[0].lines} == {"o"}
    figure = drawn(simulate_alternatives(definition, scenarios=["dated"], controls=["random", "neutral"]))
    assert figure.axes[0].get_xlabel() == "year"
    low, high = figure.axes[0].get_xlim()
    assert low == pytest.approx(2020 + 58 / 365.25) and high == pytest.approx(low + 3 / 365.25)
    assert np.asarray(figure.axes[0].lines[0].get_xdata())[0] == pytest.approx(low + 0.25 / 365.25)


def test_picture_of_many(definition: Path, drawn: Callable[[list[Simulation]], Figure]) -> None:
    """Nine alternatives look different, and of four services the three that differ most are shown, each as it was."""
    definition.write_text(definition.read_text() + MORE)
    scenarios, controls = (None, "crisis", "long"), ("neutral", "random", "constant")
    found = simulate_alternatives(definition, scenarios=scenarios, controls=controls, steps=3)
    figure = drawn(found)
    assert len({(line.get_color(), line.get_linestyle()) for line in figure.axes[0].lines}) == 9
    services = [each.of for each in rank_quantities(found) if each.kind == "service"]
    assert len(services) == 4
    for axes, service in zip(figure.axes[1:4], services, strict=False):
        assert axes.get_title(loc="left") == f"Service: {service.replace('_', ' ')}"
        row = [each.id for each in found[4].network.services].index(service)
        np.testing.assert_array_equal(axes.lines[4].get_ydata(), found[4].rollout.levels[0, row])
    assert not figure.axes[4].get_title(loc="left").startswith("Service")
