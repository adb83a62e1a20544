"""``cirl check``: what it says of definitions and recipes, and what it has nothing to say of."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from command import SOURCE, bottles, guide, run
from small_networks import ONE_OF_EACH

import cirl_marl
from cirl_marl import Arc, Control, ControlKind, Law, Network, Node, cli
from cirl_marl.definitions.catalogue import folder
from cirl_marl.definitions.reader import write_network

pytestmark = pytest.mark.usefixtures("elsewhere")

LOSS = """
[arcs.loss]
from = "households"
to = "landfill"
law = "donor"
rate = { value = 0.02, unit = "1/day", source = "what nobody collects" }
"""


@pytest.mark.medium
@pytest.mark.sample(2)
@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_check_has_nothing_to_say_of_the_catalogue(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither of the default scenarios nor of the paper's, whose one agent owes no service and is paid for none."""
    assert run(monkeypatch, "check", name) == 0
    printed = capsys.readouterr().out
    assert "no mistakes" in printed
    assert "remark" not in printed


def test_check_tells_how_far_it_is(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Scenario by scenario, file by file, up to all of it, whether or not there are mistakes."""
    bottles()
    Path("wrong.toml").write_text("name = 'wrong'")
    told: list[float] = []

    @contextmanager
    def bar(what: str) -> Iterator[Callable[[float], None]]:
        yield told.append

    monkeypatch.setattr(cli.common, "bar", bar)
    assert run(monkeypatch, "check", "bottles.toml", "wrong.toml") == 2
    assert told == [0.25, 0.5, 0.5, 1.0]  # two scenarios, then the file, then the one that cannot be read
    assert "no mistakes" in capsys.readouterr().out


def test_check_names_every_mistake(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Mistakes of different kinds in one file are all named, with key and nearest name; the exit code is 2.

    Units are read once all keys are known, and how the compartments fit together once every value can be read; each
    time all that is wrong is named.
    """
    bad = (folder("envs") / "copper_net.toml").read_text()
    planted = (
        ("reference_interval", "reference_intervall", "'reference_intervall'. Did you mean 'reference_interval'?"),
        ('law = "controlled"', 'law = "controled"', "'controled'. Did you mean 'controlled'?"),
        ('unit = "kt/day", source = "neutral', 'unit = "kg", source = "neutral', "control: unit 'kg' is inconsistent"),
        (
            'to = "landfill"',
            'to = "landfil"',
            "to: unknown node 'landfil'. Did you mean 'landfill'?",
        ),
        ('provider = "use"', 'provider = "us"', "provider: unknown node 'us'. Did you mean 'use'?"),
    )
    for right, wrong, _ in planted:
        assert right in bad
        bad = bad.replace(right, wrong)
    for corrected, named in (((), {0, 1}), ((0,), {1, 2}), ((1, 2), {3, 4})):
        for place in corrected:
            right, wrong, _ = planted[place]
            bad = bad.replace(wrong, right)
        Path("bad.toml").write_text(bad)
        assert run(monkeypatch, "check", "bad.toml", str(folder("envs") / "carbo_net.toml")) == 2
        captured = capsys.readouterr()
        assert "no mistakes" in captured.out
        assert "bad.toml" in captured.err
        assert {place for place, (_, _, said) in enumerate(planted) if said in captured.err} == named, captured.err
    assert run(monkeypatch, "check", "missing.toml") == 2
    assert "missing.toml: no such file" in capsys.readouterr().err


def test_check_takes_names_and_recipes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever there is can be checked, by its name or as a file; mistakes of recipes are named too."""
    recipe = (folder("agents") / "independent_ppo.toml").read_text()
    Path("mine.toml").write_text(recipe)
    told = "--material tin --mass kt --in-use 900 --lifetime 25 --recycled 0.2".split()
    assert run(monkeypatch, "new", "tin.toml", *told) == 0
    assert run(monkeypatch, "check", "copper_net", "independent_ppo", "mine.toml", "tin.toml") == 0
    said = capsys.readouterr().out
    assert said.count("no mistakes") == 4
    assert "tin.toml: 11 compartments, 1 agent, scenarios" in said
    assert "mine.toml: recipe of PPO, 600,000 steps in 32 copies" in said
    Path("mine.toml").write_text(recipe.replace('algorithm = "PPO"', 'algorithm = "PPQ"'))
    assert run(monkeypatch, "check", "mine.toml") == 2
    assert "Did you mean 'PPO'?" in capsys.readouterr().err
    assert run(monkeypatch, "check", "coper_net", "mine.toml") == 2
    said = capsys.readouterr().err
    assert "Did you mean 'copper_net'?" in said
    assert "Did you mean 'PPO'?" in said


def test_check_tries_recipes_in_a_network(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Scenario, agents, matches and what the algorithms refuse; nothing is trained or written."""
    network = str(folder("envs") / "carbo_net.toml")
    good = 'name = "mine"\ntitle = "mine"\n[learner]\nalgorithm = "A2C"\n'
    agent = cirl_marl.load_network(network).agents[0]
    named = f'[[match]]\nagents = ["{agent}"]\nalgorithm = "PPO"\n'

    def check(text: str, *options: str) -> tuple[int, str, str]:
        Path("mine.toml").write_text(text)
        code = run(monkeypatch, "check", "mine.toml", *options)
        return code, *capsys.readouterr()

    code, said, _ = check(good + named, "--network", network)
    assert code == 0
    assert f"mine.toml: recipe of A2C, PPO, 200,000 steps in 16 copies, in {network}: no mistakes" in said
    assert "remark" not in said
    _, said, _ = check(good + named + named, "--network", "carbo_net")
    assert "mine.toml: remark on carbo_net: nobody learns by match.1" in said
    for text, message in (
        (good + '[environment]\nscenario = "papr"\n', "unknown scenario 'papr'. Did you mean 'paper'?"),
        (
            good + named.replace(agent, f"{agent}x"),
            f"match.0.agents: unknown agent '{agent}x'. Did you mean '{agent}'?",
        ),
        (
            good.replace("A2C", "PPO") + "parameters.policy_kwargs.optimizer_kwargs = { lrr = 1.0 }\n",
            "PPO refuses its parameters {'policy_kwargs': {'optimizer_kwargs': {'lrr': 1.0}}}",
        ),
    ):
        assert check(text)[0] == 0
        code, _, said = check(text, "--network", "carbo_net")
        assert code == 2
        assert "mine.toml in carbo_net: " in said
        assert message in said
    assert [path.name for path in Path().iterdir()] == ["mine.toml"]
    assert "Did you mean 'carbo_net'?" in check(good, "--network", "crbo_net")[2]


@pytest.mark.parametrize("source", ["carbo_net", str(folder("envs") / "carbo_net.toml"), "independent_pp"])
def test_check_tries_only_recipes_in_a_network(
    source: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A network has no other to fit."""
    assert run(monkeypatch, "check", source, "--network", "carbo_net") == 2
    assert f"check {source}: is no recipe; --network names the network that recipes must fit" in capsys.readouterr().err


def test_check_runs_into_what_simulations_would(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A rate that no solver follows is a mistake; a control that none follows is a remark."""
    network = idle_network()
    fast = Arc(id="fast", donor="depot", recipient="shop", rate=1e9)
    write_network(replace(network, arcs=(*network.arcs, fast)), Path("fast.toml"))
    assert run(monkeypatch, "check", "fast.toml") == 2
    assert "more than 10,000 solver steps" in " ".join(capsys.readouterr().err.split())
    wild = (folder("envs") / "net_zero.toml").read_text()
    assert 'low = 0.3, neutral = 0.5, high = 0.7, unit = "1/day"' in wild
    wild = wild.replace('neutral = 0.5, high = 0.7, unit = "1/day"', 'neutral = 0.5, high = 250.0, unit = "1/day"', 1)
    Path("wild.toml").write_text(wild.partition("[scenarios.")[0])
    run(monkeypatch, "check", "wild.toml")
    assert "became nan: solver 'rk4' cannot follow" in " ".join(capsys.readouterr().out.split())


def test_check_remarks_on_services_that_nobody_owes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a debtor that acts, stopping everything would pay: that is said, and is no mistake."""
    owed = 'owed_by = ["quarry", "disposal"]'
    assert owed in guide()
    for changed, said in (
        (owed, ""),
        ("", "owed_by is left out, so the provider owes it; households: does not act"),
        ('owed_by = ["households"]', "owed_by households: does not act"),
        ('owed_by = ["quarry", "households"]', "owed_by: households does not act and cannot be paid less"),
    ):
        Path("bottles.toml").write_text(guide().replace(owed, changed))
        assert run(monkeypatch, "check", "bottles.toml") == 0
        printed = capsys.readouterr().out
        assert ("remark" in printed) == bool(said)
        assert said in printed


def test_check_remarks_on_what_has_no_effect(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A valve on a node that only batches leave, and a pollutant that enters no environment."""
    write_network(idle_network(), Path("idle.toml"))
    assert run(monkeypatch, "check", "idle.toml") == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "node 'depot': its valve scales no flow, as nothing but batches leaves it" in printed
    assert "arc 'burn': pollutant = false says nothing here, as 'depot' is no environment" in printed
    assert "node 'attic': no arc begins or ends here" in printed
    assert "there is no service, so that agents with reward 'mixed' do best to stop whatever flows" in printed
    assert "node 'shop'" not in printed


def test_check_remarks_on_what_is_always_zero_too_small_or_too_late(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Roles without which λ is 0, a source that cannot feed its flow, a series whose times are in another unit."""
    text = re.sub('role = "(nonrenewable_reservoir|landfill)"', 'role = "technosphere"', guide())
    text += """
[nodes.imports]
role = "technosphere"
initial = { low = 0, high = 0, unit = "t", source = "forgotten" }
[arcs.imported]
from = "imports"
to = "households"
law = "exogenous"
flow = { times = [0, 1], time_unit = "year", values = [5, 6], unit = "t/day", source = "trade" }
"""
    Path("bottles.toml").write_text(text)
    assert run(monkeypatch, "check", "bottles.toml") == 0
    printed = capsys.readouterr().out
    assert "remark on scenario 'default': λ is always 0" in printed
    assert "arc 'imported': under neutral control 'imports' holds too little for its flow from 0 day on" in printed
    assert "arc 'imported': series: an episode ends at 7 day, so that what begins at 365.25 day never comes" in printed
    half = (
        '[nodes.imports]\ncontrol = { kind = "rate", low = 0, neutral = 0.5, high = 1, unit = "1", source = "valve" }'
    )
    full = text.replace("low = 0, high = 0", "low = 1e6, high = 1e6")
    for enough in (full, full.replace("[nodes.imports]", half)):
        Path("bottles.toml").write_text(enough)
        assert run(monkeypatch, "check", "bottles.toml") == 0
        assert "holds too little" not in capsys.readouterr().out


def test_check_remarks_on_sources(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Material from the technosphere costs λ nothing; a source may be too small for today or for the highest order."""
    free = "node 'world': nothing enters it, and what it delivers counts nothing in λ; if it stands for mining"
    little = "control 'world' holds too little for its flow from {} day on"
    for stock, role, said in (
        ("30", "technosphere", [free, "under neutral " + little.format(3)]),
        ("100", "technosphere", [free, "under the highest " + little.format(5)]),
        ("140", "technosphere", [free]),
        ("140", "nonrenewable_reservoir", []),
        ("0", "technosphere", ["under neutral " + little.format(0)]),
    ):
        source = SOURCE.replace("30", stock).replace("technosphere", role)
        Path("bottles.toml").write_text(guide() + source)
        assert run(monkeypatch, "check", "bottles.toml") == 0
        printed = capsys.readouterr().out
        assert printed.count("remark on scenario 'default'") == len(said)
        assert all(each in printed for each in said)


def test_check_remarks_on_valves_that_are_no_shares(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A valve on one of two outflows; none where it is the only outflow, on the node, or on both."""
    valve = 'control = { kind = "rate", low = 1, neutral = 1, high = 1.33, unit = "1", source = "more collection" }'
    rate = 'rate = { value = 0.05, unit = "1/day", source = "a bottle lives 20 days" }'
    old = next(line for line in guide().splitlines() if line.startswith("control") and "deposit scheme" in line)
    text = guide({old: valve})
    highest = "arc 'disposal': at its highest its valve lets through 77% of what leaves 'households' in proportion to "
    on_node = guide({old: "", "set_point = { value = 100": f"{valve}\nset_point = {{ value = 100"})
    for definition, said in (
        (text + LOSS, highest + 'its stock, not 95%: 1.33 × 71%; law = "share" with control.kind = "share" sets a'),
        (guide() + LOSS, "at its lowest its valve lets through 33% of what leaves 'households'"),
        (text, ""),
        (on_node + LOSS, ""),
        (text + LOSS + valve, ""),
    ):
        assert rate in definition
        Path("bottles.toml").write_text(definition)
        assert run(monkeypatch, "check", "bottles.toml") == 0
        printed = capsys.readouterr().out
        assert said in printed
        assert ("its valve lets through" in printed) == bool(said)


def test_check_names_the_scenario_that_cannot_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A rate that no solver can follow is told with its file and scenario."""
    wrong = '\n[scenarios.crisis.arcs.disposal]\nrate = { value = 0.05, unit = "1/us", source = "slip" }\n'
    Path("bottles.toml").write_text(guide() + wrong)
    assert run(monkeypatch, "check", "bottles.toml") == 2
    assert "bottles.toml, scenario 'crisis': network 'bottles': node 'households'" in capsys.readouterr().err


@pytest.mark.slow
def test_check_remarks_on_batches_that_never_leave_or_never_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Departures at the end of the episode or later, and masses that are no whole batches of the station."""
    text = (folder("envs") / "solids_net.toml").read_text(encoding="utf-8")
    usual = 'times = [0, 8], time_unit = "s", masses = [300, 300]'
    assert usual in text
    Path("late.toml").write_text(text.replace(usual, 'times = [0, 28], time_unit = "s", masses = [250, 600]'))
    assert run(monkeypatch, "check", "late.toml") == 0
    printed = capsys.readouterr().out
    first = "arc 'first_use': batch at 0 s: 250 kg are no whole number of batches of 300 kg, as 'sorter' makes them"
    assert f"remark on scenario 'default': {first}" in printed
    assert "arc 'first_use': batch at 28 s: an episode ends at 28 s, so that it never leaves" in printed
    assert "600 kg" not in printed


def idle_network() -> Network:
    """Return a network whose only valve is in vain."""
    valve = Control(kind=ControlKind.RATE, low=0.0, neutral=0.5, high=1.0)
    return Network(
        name="idle",
        nodes=(
            Node(id="depot", initial=(5.0, 5.0), control=valve),
            Node(id="shop", initial=(0.0, 0.0)),
            Node(id="attic"),
        ),
        arcs=(
            Arc(id="send", donor="depot", recipient="shop", law=Law.BATCH, delay=1.0, batches=((0.0, 1.0),)),
            Arc(id="burn", donor="shop", recipient="depot", rate=0.1, pollutant=False),
        ),
    )


@pytest.mark.parametrize("step", ["0.125", "0.25"])
@pytest.mark.slow
def test_check_remarks_on_steps_that_are_too_long(
    step: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Fast inner physics do not show in the turnover of stocks; half the step shows them."""
    text = (folder("envs") / "net_zero.toml").read_text(encoding="utf-8")
    found = re.search(r"solver_step = \{ value = [0-9.]+", text)
    assert found is not None
    Path("long.toml").write_text(text.replace(found.group(), f"solver_step = {{ value = {step}"))
    assert run(monkeypatch, "check", "long.toml") == 0
    printed = capsys.readouterr().out
    assert "remark on scenario 'default': episode.solver_step" in printed
