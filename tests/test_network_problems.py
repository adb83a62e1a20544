"""What a network is refused for when it is built in Python, before anything stands on it."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_networks import constant

from cirl_marl import (
    Arc,
    Control,
    ControlKind,
    DefinitionError,
    Episode,
    Law,
    Network,
    NetworkError,
    Node,
    Objective,
    Service,
    load_network,
)
from cirl_marl.compartments.delivery_truck import DeliveryTruck
from cirl_marl.compartments.digester import Digester
from cirl_marl.compartments.digester_published import DigesterPublished
from cirl_marl.compartments.troposphere_temperature import TroposphereTemperature
from cirl_marl.definitions.catalogue import folder
from cirl_marl.definitions.reader import write_network
from cirl_marl.network.series import Series


def steps(*times: float) -> Series:
    """Return a series of the numbers 1, 2 and so on."""
    return Series(times=times, values=tuple(float(i + 1) for i in range(len(times))))


A, B = Node(id="a", initial=(10.0, 10.0)), Node(id="b")
LINK = Arc(id="k", donor="a", recipient="b", rate=0.1)
DELAYED = Arc(id="k", donor="a", recipient="b", law=Law.BATCH, delay=1.0, batches=((0.0, 1.0),))
FED = Arc(id="k", donor="a", recipient="b", law=Law.EXOGENOUS, flow=1.0)
ORDER = Arc(id="k", donor="a", recipient="b", law=Law.CONTROLLED)
BACKWARD = Control(kind=ControlKind.FLOW, low=-5.0, neutral=0.0, high=5.0)
VALVE = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=2.0)
DILUTION = Control(kind=ControlKind.INPUT, low=0.3, neutral=0.5, high=0.7)
OWED = Service(id="s", provider="b", quantity="stock", low=1.0)
DIGESTER: dict[str, Any] = {"model": Digester(), "inner": ((1.0, 1.0),) * 6}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"nodes": (replace(A, control=BACKWARD), B), "arcs": (replace(LINK, law=Law.CONTROLLED, rate=0.0),)},
            "low -5 kg/day would reverse the flow",
        ),
        ({"nodes": (replace(A, control=replace(VALVE, neutral=3.0)), B)}, "neutral <= high .*, got 0, 3, 2$"),
        ({"arcs": (replace(LINK, flow=steps(0.0, 5.0)),)}, "flow = .* law 'donor' takes rate"),
        ({"arcs": (replace(DELAYED, delay=1e-7),)}, "delay 1e-07 is not a whole number"),
        ({"arcs": (DELAYED,), "episode": Episode(control_interval=0.0)}, "control_interval 0.0 must be positive"),
        ({"episode": Episode(control_interval=math.nan, solver="rk4", solver_step=1.0)}, "control_interval nan"),
        ({"episode": Episode(control_interval=math.inf, solver="rk4", solver_step=1.0)}, "control_interval inf"),
        ({"episode": Episode(solver="rk4", solver_step=math.nan)}, "positive solver_step, got nan"),
        (
            {"episode": Episode(control_interval=0.25, solver="rk4", solver_step=0.25 / 1_728_000)},
            r"0.25 day is 1.728e\+06 solver steps of 1.4.*e-07 day, more than 10,000. Is solver_step in the wrong unit",
        ),
        (
            {"episode": Episode(control_interval=1e40, solver="euler", solver_step=1e-40)},
            r"is 1e\+80 solver steps of 1e-40 day",
        ),
        (
            {"arcs": (replace(DELAYED, delay=86400.0),)},
            "delay 86400 day is 86400 control intervals.*wrong unit",
        ),
        (
            {"arcs": (replace(FED, flow=Series(times=(0.0,), values=(1.0, 2.0), origin="x.csv, t")),)},
            r"arc 'k': flow: series has 1 times and 2 values: one for each \(x.csv, t\)$",
        ),
        ({"arcs": (replace(FED, flow=Series(times=(), values=())),)}, "series has 0 times and 0 values"),
        (
            {"arcs": (replace(ORDER, control=replace(BACKWARD, low=0.0, neutral=Series(times=(), values=()))),)},
            "series has 0 times and 0 values",
        ),
        ({"arcs": (replace(FED, flow=steps(0.0, math.nan)),)}, "times must increase and be finite, but nan follows 0"),
        ({"arcs": (replace(FED, flow=steps(0.0, math.inf)),)}, "times must increase and be finite, but inf follows 0"),
        ({"arcs": (replace(FED, flow=steps(0.0, 2.0, 1.0)),)}, "times must increase and be finite, but 1 follows 2"),
        ({"arcs": (replace(FED, flow=steps(math.nan)),)}, "times and values must be finite"),
        ({"arcs": (replace(FED, flow=steps(0.5)),)}, "series begins at 0.5, after the episode does"),
        (
            {"arcs": (replace(FED, flow=replace(steps(0.0, 5.0), interpolation="linear")),)},
            "arc 'k': flow: series ends at 5, but the episode at 50",
        ),
        ({"arcs": (replace(FED, flow=replace(steps(0.0), until=49.0)),)}, "series ends at 49, but the episode at 50"),
        ({"arcs": (replace(LINK, rate=Series(times=(0.0, 1.0), values=(1.0, -2.0))),)}, "rate -2.0 must be finite and"),
        (
            {"nodes": (replace(A, control=replace(VALVE, neutral=steps(0.0, 1.0, 3.0))), B), "arcs": (LINK,)},
            "low <= neutral <= high and low < high, got .* in interval 3",
        ),
        ({"services": (OWED, OWED)}, "service 's': the id is used twice$"),
        ({"nodes": (A, B, B)}, "node 'b': the id is used twice$"),
        ({"arcs": (replace(LINK, id="b"),)}, "node and arc 'b': the id is used twice; nodes and arcs share one set"),
        ({"default_agents": ("b",)}, "agents: 'b' has no control, so that it cannot act"),
        ({"default_agents": ("c",)}, "agents: unknown agent 'c'. Known: none"),
        (
            {"arcs": (DELAYED,), "services": (replace(OWED, provider="a", quantity="outflow"),)},
            "service 's': quantity 'outflow': 'a' gives batches to k, which count on arrival; ask for the 'flow'",
        ),
        ({"objective": Objective(tracked=("a", "a"))}, "tracked: names 'a' twice"),
        ({"nodes": (replace(A, id="Mine 1"), B), "arcs": ()}, "node 'Mine 1': an id begins with a letter"),
        ({"nodes": (replace(A, **DIGESTER), B)}, "'digester' needs a control of kind 'input' for dilution_per_day"),
        ({"nodes": (replace(A, control=VALVE, **DIGESTER), B)}, "needs a control of kind 'input'.*not rate"),
        (
            {"nodes": (replace(A, control=replace(DILUTION, low=-0.7), **DIGESTER), B)},
            r"holds for dilution_per_day",
        ),
        (
            {"nodes": (replace(A, control=DILUTION, model=Digester(), inner=((-1.0, 1.0),) * 6), B)},
            r"in \[0, inf\], not for \[-1, 1\]",
        ),
        ({"name": "Glass-2030"}, "name 'Glass-2030': begins with a letter"),
        ({"mass_unit": "pieces"}, "units.mass: unit 'pieces' cannot be read"),
        ({"time_unit": "kg"}, "units.time: unit 'kg' is inconsistent"),
        ({"arcs": (replace(LINK, law=Law.COMPARTMENT, by="a"),)}, "solver 'exact' knows no"),
    ],
)
def test_networks_that_cannot_be_simulated(changes: dict[str, Any], said: str) -> None:
    """Each is refused with what is wrong and where."""
    network = Network(name="two", nodes=(A, B), arcs=(LINK,))
    with pytest.raises(NetworkError, match=said):
        replace(network, **changes)


@pytest.mark.parametrize(
    ("element", "changes", "said"),
    [
        (A, {"initial": 5.0}, "node 'a': initial must be (low, high), got 5.0; write (5.0, 5.0)"),
        (A, {"initial": (1.0, 2.0, 3.0)}, "node 'a': initial must be (low, high), got (1.0, 2.0, 3.0)"),
        (A, {"initial": ("1", "2")}, "node 'a': initial must be (low, high), got ('1', '2')"),
        (A, {"inner": (4.0, 6.0)}, "one pair for each inner state, got (4.0, 6.0); write ((4.0, 6.0),)"),
        (A, {"inner": 4.0}, "node 'a': inner must be ((low, high), …), one pair for each inner state, got 4.0"),
        (A, {"set_point": (4.0, 6.0)}, "node 'a': set_point must be a number, got (4.0, 6.0)"),
        (DELAYED, {"batches": (0.0, 1.0)}, "batches must be ((time, mass), …), got (0.0, 1.0); write ((0.0, 1.0),)"),
        (DELAYED, {"batches": ((0.0, 1.0), (2.0,))}, "batches must be ((time, mass), …), got ((0.0, 1.0), (2.0,))"),
        (FED, {"flow": (1.0, 2.0)}, "arc 'k': flow must be a number, got (1.0, 2.0)"),
        (steps(0.0), {"times": 0.0}, "series: times must be (time, …), got 0.0; write (0.0,)"),
        (
            LINK,
            {"delay": steps(0.0)},
            "interpolation='step', until=None, factor=None, origin='')",
        ),
        (LINK, {"rate": None}, "arc 'k': rate must be a number, got None"),
        (VALVE, {"low": (0.0, 2.0)}, "control: low must be a number, got (0.0, 2.0)"),
    ],
)
def test_numbers_are_given_as_they_are_needed(element: Any, changes: dict[str, Any], said: str) -> None:
    """A single number for a pair, a pair for a list of pairs: named at once, with what to write."""
    with pytest.raises(NetworkError) as raised:
        replace(element, **changes)
    assert str(raised.value).endswith(said)


def test_numbers_may_come_from_arrays() -> None:
    """Lists and arrays of numbers are numbers too."""
    given: list[Any] = [[1, 2], np.array([1.0, 2.0]), (np.float32(1.0), np.int64(2))]
    for initial in given:
        assert tuple(replace(A, initial=initial).initial) == (1, 2)  # type: ignore[arg-type]


TRUCK: dict[str, Any] = {
    "model": DeliveryTruck(),
    "inner": ((0.0, 0.0),) * 3,
    "control": Control(kind=ControlKind.INPUT, low=-1e3, neutral=0.0, high=1e3),
}
AIR: dict[str, Any] = {"model": TroposphereTemperature(), "inner": ((280.0, 290.0),)}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"nodes": (replace(A, **TRUCK), B)},
            r"node 'a': model 'delivery_truck': context_names: unknown quantity .* 'load_kg'.* Known: stock_kg",
        ),
        (
            {"arcs": (replace(LINK, **AIR),)},
            r"arc 'k': model 'troposphere_temperature': context_names: unknown .* 'stock_kg'\. Known: none",
        ),
        ({"arcs": (replace(LINK, **TRUCK),)}, r"arc 'k': model 'delivery_truck': .* 'load_kg'\. Known: none"),
    ],
)
def test_models_are_told_what_they_ask_for(changes: dict[str, Any], said: str) -> None:
    """A node tells its stock and a vehicle's arc its load; one is never handed over for the other."""
    episode = Episode(solver="rk4", solver_step=0.5)
    network = Network(name="two", nodes=(A, B), arcs=(LINK,), episode=episode)
    with pytest.raises(NetworkError, match=said):
        replace(network, **changes)
    assert replace(network, nodes=(replace(A, **AIR), B)).nodes[0].model == AIR["model"]


def test_what_a_station_releases_fits_its_arcs() -> None:
    """Each port has one arc, and an arc carries units of the mass that the station knows."""
    network = load_network("solids_net", scenario="reacher")
    sorted_, unsorted = (next(arc for arc in network.arcs if arc.port == port) for port in ("sorted", "unsorted"))
    for changed, said in (
        (replace(unsorted, port="sorted"), "port 'sorted' of 'sorter' has the arc .* already"),
        (replace(unsorted, rate=1.5 * constant(unsorted.rate)), "150 kg a unit, but 'sorter' releases units of 100 kg"),
    ):
        with pytest.raises(NetworkError, match=said):
            replace(network, arcs=tuple(changed if arc is unsorted else arc for arc in network.arcs))
    with pytest.raises(NetworkError, match="node 'sorter': what its model releases to port 'unsorted' would stay"):
        replace(network, arcs=tuple(arc for arc in network.arcs if arc is not unsorted))
    assert sorted_.rate == unsorted.rate


@pytest.mark.parametrize(
    ("kind", "given", "said"),
    [
        ("digester_published", "misprint = 0.5", "parameters.misprint: needs true or false, got 0.5"),
        ("digester_published", "process = 1.0", "parameters.process: is no number"),
        ("digester", "k1 = true", "parameters.k1: needs a number, got True"),
        ("digester", "k7 = 1.0", "'k7'"),
        ("delivery_truck", "load_kg = 210.0", "load_kg = 210.0, but the network knows what is aboard: leave it out"),
    ],
)
def test_parameters_of_models_are_of_their_kind(kind: str, given: str, said: str, tmp_path: Path) -> None:
    """Truth values are truth values and numbers numbers; what is neither cannot be given."""
    text = (folder("envs") / "net_zero.toml").read_text()
    assert 'kind = "digester"\n' in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace('kind = "digester"\n', f'kind = "{kind}"\nparameters = {{ {given} }}\n', 1))
    with pytest.raises(DefinitionError, match=said):
        load_network(path)


@pytest.mark.parametrize("misprint", [True, False])
def test_truth_values_of_models_are_kept(misprint: bool, tmp_path: Path) -> None:
    """A definition says them as such, and they come back."""
    network = load_network("net_zero")
    nodes = tuple(
        replace(node, model=DigesterPublished(misprint=misprint)) if node.id == "digester" else node
        for node in network.nodes
    )
    path = tmp_path / "mine.toml"
    write_network(replace(network, nodes=nodes, services=()), path)
    assert f"misprint = {str(misprint).lower()}" in path.read_text()
    assert load_network(path).compartments["digester"].model == DigesterPublished(misprint=misprint)


def test_models_that_cannot_be_written(tmp_path: Path) -> None:
    """A parameter that is itself a model is refused unless it is the default; nothing is written."""
    inputs = Control(kind=ControlKind.INPUT, low=0.3, neutral=0.5, high=0.7)
    digester = replace(A, model=DigesterPublished(), inner=((1.0, 1.0),) * 6, control=inputs)
    episode = Episode(control_interval=0.1, solver="rk4", solver_step=0.1)
    usual = Network(name="one", nodes=(digester,), arcs=(), episode=episode)
    write_network(usual, tmp_path / "usual.toml")
    assert load_network(tmp_path / "usual.toml").nodes == usual.nodes
    (tmp_path / "usual.toml").unlink()
    other = replace(digester, model=DigesterPublished(process=Digester(released_share=0.1)))
    network = replace(usual, nodes=(other,))
    with pytest.raises(NetworkError, match="compartment 'a': parameter 'process' of its model 'digester_published'"):
        write_network(network, tmp_path / "one.toml")
    assert not list(tmp_path.iterdir())


def test_errors_come_back_from_other_processes() -> None:
    """With their kind, subject and problems."""
    for error in (NetworkError("network 'x'", ["a", "b"]), DefinitionError("x.toml", ["c"])):
        again = pickle.loads(pickle.dumps(error))
        assert (type(again), str(again), again.problems) == (type(error), str(error), error.problems)
