"""The catalogue, its schema, and what a mistake in a definition file says."""

from __future__ import annotations

import json
import os
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import tomlkit
from numpy.typing import NDArray
from small_networks import ONE_OF_EACH, constant

from cirl_marl import (
    Arc,
    CirlError,
    DefinitionError,
    MultiAgentVectorEnv,
    Network,
    Node,
    Role,
    load_network,
    parallel_env,
)
from cirl_marl.definitions.catalogue import folder
from cirl_marl.definitions.reader import Definition, write_network
from cirl_marl.network.elements import ControlKind
from cirl_marl.records import files
from docs.site.schemas import network_schema

FILES = sorted(folder("envs").glob("*.toml"))
COPPER = (Path(__file__).parent / "reference" / "definition.toml").read_text(encoding="utf-8")
SIZES = {"copper_net": (17, 15), "carbo_net": (15, 8)}
"""Compartments, and how many agents there are at least."""


def scenarios(name: str) -> list[str]:
    """Return every scenario of a network."""
    return ["default", *load_network(name).scenarios]


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_every_network_reads_in_every_scenario(name: str) -> None:
    """A network is one file, named like it."""
    for scenario in scenarios(name):
        network = load_network(name, scenario=scenario)
        assert network.name == name
        assert network.scenario_name == scenario
        assert set(network.graph) == set(network.node_index)
        assert sum(len(arcs) for _, _, arcs in network.graph.edges(data="arcs")) == len(network.arcs)
    assert load_network(name).services, "a network states its service: zero throughput maximises λ"


@pytest.mark.parametrize("name", SIZES)
def test_sizes(name: str) -> None:
    """Compartments of the paper; every one that could act, acts."""
    network = load_network(name)
    compartments, agents = SIZES[name]
    assert len(network.compartments) == compartments
    assert agents <= len(network.agents) < compartments
    spaces = [parallel_env(network).observation_space(agent).shape for agent in network.agents]
    assert len(set(spaces)) > 1, "observations are heterogeneous"


def test_schema_is_up_to_date() -> None:
    """The published schema is the one that the code implies; network_schema() writes it anew."""
    published = (folder("envs") / "network.schema.json").read_text(encoding="utf-8")
    assert published == json.dumps(network_schema(), indent=2, ensure_ascii=False) + "\n"


def test_files_pass_the_schema() -> None:
    """Editors accept what the library accepts."""
    schema = network_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    assert len(FILES) >= 10
    for path in FILES:
        errors = [error.message for error in validator.iter_errors(tomllib.loads(path.read_text(encoding="utf-8")))]
        assert errors == [], path


def test_schema_refuses_what_the_library_refuses() -> None:
    """A misspelt key, also inside a scenario, is underlined."""
    for old, new in (("rate = { value = 0.82", "rat = { value = 0.82"), ("tracked = [", "trakced = [")):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(tomllib.loads(COPPER.replace(old, new)), network_schema())


def initial_circularity(name: str, scenario: str) -> tuple[dict[str, float], float]:
    """Return the stocks and λ at the start under neutral control."""
    env = MultiAgentVectorEnv(name, scenario=scenario, num_envs=1)
    env.reset(0)
    stock = env.physical.stock[:-1]
    return dict(zip(env.network.node_index, stock[:, 0].tolist(), strict=True)), float(
        env.network.circularity(env.physical.flow)[0]
    )


def test_circularity_of_copper_net() -> None:
    """λ = −(a17·x1 + a84·x4)."""
    x, circularity = initial_circularity("copper_net", "paper")
    assert circularity == pytest.approx(-(0.72 * x["refinery"] + 0.25 * x["use"]), rel=1e-14)


@pytest.mark.parametrize("capture", [0.0, 0.25, 1.0])
def test_circularity_of_carbo_net(capture: float) -> None:
    """λ = −(a22·x2 + a33·x3 + emissions − u); with "abs" over-removal counts against it."""
    network = load_network("carbo_net", scenario="paper")
    flows: NDArray[np.float64] = np.zeros(len(network.arcs))
    vehicles, heaters, u = 210.0, 500.0, 4000 * capture
    for id_, flow in (
        ("vehicles_to_urban", 0.5 * vehicles),
        ("vehicles_to_adjacent", 0.5 * vehicles),
        ("heaters_to_urban", 0.5 * heaters),
        ("heaters_to_adjacent", 0.5 * heaters),
        ("reserve_to_vehicles", 0.3 * vehicles),
        ("reserve_to_heaters", 0.6 * heaters),
        ("urban_to_capture", u),
        ("urban_to_adjacent", 183.08),
        ("adjacent_to_urban", 183.08),
    ):
        flows[network.arc_index[id_]] = flow
    mined, net = 0.3 * vehicles + 0.6 * heaters, vehicles + heaters - u
    assert network.circularity(flows) == pytest.approx(-(mined + net), rel=1e-14)
    absolute = network.with_options(objective={"net_zero": "abs"})
    assert absolute.circularity(flows) == pytest.approx(-(mined + abs(net)), rel=1e-14)


def broken(tmp_path: Path, *changes: tuple[str, str]) -> str:
    """Return what reading copper_net with these changes says."""
    text = COPPER
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / "broken.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DefinitionError) as caught:
        Definition(path).check()
    message = str(caught.value)
    assert all(line.startswith(str(path)) for line in message.splitlines())
    return message


RATE = 'rate = { value = 0.82, unit = "1/day"'
ALONE = 'agents = ["use_to_collection"]'
HORIZON = 'horizon = { value = 160, unit = "1"'
REFINERY = 'initial = { low = 60.0, high = 90.0, unit = "kt"'


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            RATE,
            RATE.replace("rate", "rte"),
            ["arcs.refinery_to_fabrication.rte", "'rte'", "Did you mean 'rate'"],
        ),
        (
            RATE,
            RATE.replace("value", "vale"),
            ["arcs.refinery_to_fabrication.rate.vale", "Did you mean 'value'"],
        ),
        (
            'law = "donor"',
            'law = "donnor"',
            ["arcs.mine_to_refinery.law", "'donnor'", "Did you mean 'donor'"],
        ),
        ('from = "mine"', 'from = "mime"', ["arc 'mine_to_refinery'", "'mime'", "Did you mean 'mine'"]),
        (RATE, RATE.replace("0.82", "-0.82"), ["arc 'refinery_to_fabrication'", "-0.82", "negative"]),
        (RATE, RATE.replace("0.82", "nan"), ["arcs.refinery_to_fabrication.rate.value", "nan"]),
        (RATE, RATE.replace("0.82", "true"), ["arcs.refinery_to_fabrication.rate.value", "number", "True"]),
        (RATE, RATE.replace("0.82", '"0.82"'), ["arcs.refinery_to_fabrication.rate.value", "number", "'0.82'"]),
        (RATE, 'by = "mine"\n' + RATE, ["arc 'refinery_to_fabrication'", "by = 'mine'", "takes rate"]),
        (
            RATE,
            'delay = { value = 1, unit = "day", source = "x" }\n' + RATE,
            ["arc 'refinery_to_fabrication'", "delay = 1.0", "takes rate"],
        ),
        ("[episode]", '[episode]\nsolver_step = { value = 7, unit = "day", source = "x" }', ["solver steps of 7"]),
        ('quantity = "stock"', 'quantity = "stock"\nmeasure = "weight"', ["'copper_in_use'", "'weight'", "none"]),
        ("owed_by = [", 'owed_by = ["mine", "mine", ', ["'copper_in_use'", "owed_by", "'mine' twice"]),
        (RATE, RATE.replace("1/day", "kg"), ["arcs.refinery_to_fabrication.rate", "'kg'", "inconsistent"]),
        (RATE, RATE.replace("1/day", "1/dya"), ["arcs.refinery_to_fabrication.rate", "dya"]),
        (
            RATE,
            RATE.replace("1/day", "t/day"),
            ["refinery_to_fabrication.rate", "'t/day'", "the flow divided by the stock of its donor", '"exogenous"'],
        ),
        (REFINERY, REFINERY.replace("kt", "knot"), ["nodes.refinery.initial", "'knot'", "inconsistent"]),
        (REFINERY, REFINERY.replace("kt", "kton"), ["nodes.refinery.initial", "'kton'", "kt (kilotonne)"]),
        (REFINERY, REFINERY.replace("60.0", "-6.0"), ["node 'refinery'", "-6.0", "negative"]),
        (RATE, "rate = 0.82 # {", ["arcs.refinery_to_fabrication.rate", "{ value = …, unit = …, source = … }", "0.82"]),
        (REFINERY, REFINERY.replace("60.0", "95.0"), ["node 'refinery'", "95.0", "90.0", "empty"]),
        ('to = "refinery"', 'to = "mine"', ["arc 'mine_to_refinery'", "zero delay", "'mine'"]),
        ("[arcs.mine_to_refinery]", "[arcs.mine]", ["node and arc 'mine': the id is used twice", "one set of names"]),
        ("[nodes.fabrication]", "[nodes.refinery]", ["not valid TOML", "line"]),
        ("[units]", "[units", ["not valid TOML", "line 25"]),
        (
            'role = "landfill"',
            'role = "landfil"',
            ["nodes.landfill.role", "'landfil'", "Did you mean 'landfill'"],
        ),
        (
            'provider = "use"',
            'provider = "usage"',
            ["service 'copper_in_use'", "'usage'", "Did you mean 'use'"],
        ),
        ("horizon = { value = 160", "horizon = { value = 16.5", ["horizon", "16.5", "whole number"]),
        ("horizon = { value = 160", "horizon = { value = 0", ["horizon", "0"]),
        (
            HORIZON,
            HORIZON.replace('"1"', '"day"'),
            ["episode.horizon", "'day'", "counts control intervals", "unit '1'"],
        ),
        (HORIZON, HORIZON.replace('"1"', '"steps"'), ["episode.horizon", "'steps'", "counts control intervals"]),
        ('mass = "kt"', 'mass = "day"', ["units.mass", "'day'"]),
        ("neutral = 40, high = 120", "neutral = 140, high = 120", ["'use_to_collection'", "140", "120"]),
        (
            "neutral = 40, high = 120",
            "neutral = 40, high = { times = [], values = [] }",
            ["arcs.use_to_collection.control.high.values", "at least 1"],
        ),
        ("low = 0, neutral = 40", "low = -5, neutral = 40", ["'use_to_collection'", "-5", "reverse"]),
        (
            'kind = "flow", low = 0',
            'kind = "rate", low = 0',
            ["arcs.use_to_collection.control", "'kt/day'", "inconsistent"],
        ),
        ('mode = "local"', 'mode = "locl"', ["observation.mode", "'locl'", "Did you mean 'local'"]),
        (
            RATE + ', source = "CiRL (arXiv 2505.21536), CopperNet"',
            RATE,
            ["arcs.refinery_to_fabrication.rate.source", "missing"],
        ),
        (
            "solver_step = { value = 5e-5",
            "solver_step = { value = 3e-5",
            ["scenarios.paper", "3e-05", "whole number"],
        ),
        (
            'law = "recipient"',
            'law = "receiver"',
            ["scenarios.paper.", "arcs.mine_to_refinery.law", "'receiver'"],
        ),
        (
            "[scenarios.paper.nodes.use]",
            "[scenarios.paper.nodes.user]",
            ["scenarios.paper.nodes", "'user'", "'use'"],
        ),
        (
            ALONE,
            ALONE.replace("colle", "cole"),
            ["agents", "Did you mean 'use_to_collection'"],
        ),
        (
            ALONE,
            ALONE.replace("use_to_collection", "landfill"),
            ["scenarios.paper.agents: 'landfill' has no control, so that it cannot act"],
        ),
    ],
)
def test_a_mistake_is_named(tmp_path: Path, old: str, new: str, said: list[str]) -> None:
    """Each mistake names file, object, value and the nearest valid name."""
    message = broken(tmp_path, (old, new))
    for fragment in said:
        assert fragment in message


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('role = "landfill"', "role = landfill", ': landfill; text needs quotes, "landfill"'),
        ('mass = "kt"', "mass = kt  # metric", ': kt; text needs quotes, "kt"'),
        (RATE, RATE.replace('"1/day"', "1/day"), ': 1/day; text needs quotes, "1/day"'),
        (RATE, RATE.replace('"1/day"', "one per day"), ': one per day; text needs quotes, "one per day"'),
        (ALONE, ALONE.replace('"', ""), ': use_to_collection; text needs quotes, "use_to_collection"'),
        (RATE, RATE.replace("0.82", "0,82"), ": 0,82; write 0.82"),
        (RATE, "pollutant = True\n" + RATE, ": True; write true"),
        ('mass = "kt"', 'mass = "kt', ""),
        ('mass = "kt"', "mass = ", ""),
        ('mass = "kt"', 'mass = "kt" tonnes', ""),
        (RATE, RATE.replace("0.82", "0.82.1"), ""),
        (RATE, RATE.replace("0.82,", "0.82"), ""),
        ("[nodes.mine]", "[nodes.mine a]", ""),
    ],
)
def test_words_without_quotes(tmp_path: Path, old: str, new: str, said: str) -> None:
    """A bare word where a value should be needs quotes; other faults of TOML are told as its reader tells them."""
    message = broken(tmp_path, (old, new))
    line = COPPER[: COPPER.index(old)].count("\n") + 1
    assert re.search(rf"not valid TOML: .*\(at line {line}, column \d+\){re.escape(said)}$", message)


def test_a_default_is_refused_once(tmp_path: Path) -> None:
    """Not at each compartment that takes it, at a key that the file does not have."""
    stock, flow = 'stock = { value = 100, unit = "kt"', 'flow = { value = 86.8, unit = "kt/day"'
    for old, new, said in (
        (stock, stock.replace("kt", "kton"), "scales.stock: unit 'kton': 'kton' is read in several ways"),
        (stock, stock.replace("100", "0"), "scales.stock: 0.0 must be positive"),
        (flow, flow.replace("kt/day", "kt"), "scales.flow: unit 'kt' is inconsistent"),
    ):
        message = broken(tmp_path, (old, new))
        assert said in message
        assert len(message.splitlines()) == 1


def test_all_mistakes_are_named_at_once(tmp_path: Path) -> None:
    """A file is mended in one go."""
    shape = broken(tmp_path, (RATE, RATE.replace("rate", "rte")), ('role = "landfill"', 'role = "landfil"'))
    assert "'rte'" in shape
    assert "'landfil'" in shape
    sense = broken(tmp_path, ('from = "mine"', 'from = "mime"'), (RATE, RATE.replace("0.82", "-0.82")))
    assert "'mime'" in sense
    assert "-0.82" in sense
    units = broken(tmp_path, (RATE, RATE.replace("1/day", "kg")), (REFINERY, REFINERY.replace("kt", "s")))
    assert "'kg'" in units
    assert "'s'" in units


def test_scenario_mistakes_are_all_named(tmp_path: Path) -> None:
    """Mistakes in a scenario name the scenario."""
    message = broken(
        tmp_path,
        ("[scenarios.paper.nodes.use]", "[scenarios.paper.nodes.user]"),
        ("[scenarios.paper.nodes.sorting]", "[scenarios.paper.nodes.sortng]"),
    )
    assert "'user'" in message
    assert "Did you mean 'sorting'" in message


def test_scenarios_bring_new_compartments_and_services(tmp_path: Path) -> None:
    """What says all that it must is new; what does not is a mistake that says what a new one needs."""
    new = """
[scenarios.more.nodes.exporter]
role = "technosphere"
stores = false

[scenarios.more.arcs.use_to_exporter]
from = "use"
to = "exporter"
law = "donor"
rate = { value = 0.01, unit = "1/day", source = "x" }

[scenarios.more.arcs.exported]
from = "exporter"
to = "landfill"
law = "share"
share = "rest"

[scenarios.more.services.exports]
provider = "exported"
quantity = "flow"
low = { value = 1, unit = "kt/day", source = "x" }
weight = { value = 1, unit = "1", source = "x" }
"""
    path = tmp_path / "more.toml"
    path.write_text(COPPER + new, encoding="utf-8")
    usual, more = load_network(path), load_network(path, scenario="more")
    assert [node.id for node in more.nodes if node not in usual.nodes] == ["exporter"]
    assert [arc.id for arc in more.arcs if arc not in usual.arcs] == ["use_to_exporter", "exported"]
    assert [service.id for service in more.services] == [*(service.id for service in usual.services), "exports"]
    for key, needs in (
        ('role = "tech', "role and an arc"),
        ('from = "use"', "from and to"),
        ('provider = "exp', "provider"),
    ):
        lines = [line for line in new.splitlines() if not line.startswith(key)]
        path.write_text(COPPER + "\n".join(lines), encoding="utf-8")
        with pytest.raises(DefinitionError, match=f"scenarios.more.*unknown.*A new one needs {needs}\\."):
            load_network(path, scenario="more")
    for more_, said in (('[scenarios.more.nodes.yous]\nrole = "landfill"', "Did you mean 'use'.*role and an arc"),
                        ("[scenarios.more.nodes]\nyard = 3", "nodes.yard: must be a table")):  # fmt: skip
        path.write_text(COPPER + "\n" + more_, encoding="utf-8")
        with pytest.raises(DefinitionError, match=said):
            load_network(path, scenario="more")


def test_units_are_converted(tmp_path: Path) -> None:
    """A rate per year is a rate per day, 365.25 times smaller."""
    path = tmp_path / "yearly.toml"
    yearly = COPPER.replace(RATE, RATE.replace("0.82", str(0.82 * 365.25)).replace("1/day", "1/year"))
    path.write_text(yearly, encoding="utf-8")
    arc = load_network(path).arcs[load_network(path).arc_index["refinery_to_fabrication"]]
    assert arc.rate == pytest.approx(0.82, rel=1e-14)


@pytest.mark.parametrize(("unit", "share"), [("1/day", 1.0), ("1/hour", 1 / 24), ("1/week", 7.0)])
def test_inputs_of_models_are_converted(tmp_path: Path, unit: str, share: float) -> None:
    """Bounds of an input control are in the unit of the model's inputs, whatever they are written in."""
    text = (folder("envs") / "net_zero.toml").read_text(encoding="utf-8")
    written = 'low = 0.3, neutral = 0.5, high = 0.7, unit = "1/day"'
    assert written in text
    path = tmp_path / "net_zero.toml"
    bounds = f'low = {0.3 * share}, neutral = {0.5 * share}, high = {0.7 * share}, unit = "{unit}"'
    path.write_text(text.replace(written, bounds), encoding="utf-8")
    control = load_network(path).compartments["digester"].control
    assert control is not None
    assert (control.low, control.neutral, control.high) == pytest.approx((0.3, 0.5, 0.7), rel=1e-12)
    for other in ("N", "banana"):
        path.write_text(text.replace(written, written.replace("1/day", other)), encoding="utf-8")
        with pytest.raises(CirlError, match=rf"nodes.digester.control: unit '{other}'"):
            load_network(path)


def test_a_compartment_may_be_called_source(tmp_path: Path) -> None:
    """Scenarios replace a quantity whole, known by its source; a table with a member of that name is none."""
    text = COPPER.replace("[nodes.mine]", "[nodes.source]").replace('"mine"', '"source"')
    path = tmp_path / "copper.toml"
    path.write_text(text + "\n[scenarios.poor.nodes.source.initial]\nlow = 1\nhigh = 2\nunit = 'kt'\nsource = 'x'\n")
    usual, poor = load_network(path), load_network(path, scenario="poor")
    assert [node.id for node in poor.nodes] == [node.id for node in usual.nodes]
    first = usual.nodes[usual.node_index["source"]]
    assert poor.nodes[poor.node_index["source"]] == replace(first, initial=(1.0, 2.0))


@pytest.mark.parametrize(("name", "scenario"), [(name, each) for name in ONE_OF_EACH for each in scenarios(name)])
@pytest.mark.sample(14)
def test_what_is_written_reads_back(name: str, scenario: str, tmp_path: Path) -> None:
    """Every network of the catalogue, to the last bit, as the default scenario of its own file; without a title too."""
    network = load_network(name, scenario=scenario)
    path = tmp_path / "written.toml"
    for titled in (network, replace(network, title="")):
        write_network(titled, path)
        assert load_network(path) == replace(titled, scenario_name="default", scenarios={})


def test_a_network_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that fails leaves the file that was there, and nothing beside it."""
    path = tmp_path / "kept.toml"
    write_network(load_network("copper_net"), path)
    before = path.read_bytes()

    def fail(_: Path) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(files, "sync", fail)
    with pytest.raises(OSError, match="disk full"):
        write_network(load_network("carbo_net"), path)
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["kept.toml"]


ROLE = {role.value: role for role in Role}
SIGNS = {
    ("nonrenewable_reservoir", "nonrenewable_reservoir"): (0, 0),
    ("nonrenewable_reservoir", "technosphere"): (1, 1),
    ("nonrenewable_reservoir", "environment"): (1, 1),
    ("technosphere", "nonrenewable_reservoir"): (-1, -1),
    ("technosphere", "technosphere"): (0, 0),
    ("technosphere", "landfill"): (1, 1),
    ("technosphere", "incinerator"): (1, 1),
    ("technosphere", "environment"): (1, 0),
    ("environment", "nonrenewable_reservoir"): (-1, -1),
    ("environment", "technosphere"): (-1, -1),
    ("environment", "landfill"): (0, 0),
    ("environment", "environment"): (0, 0),
    ("landfill", "technosphere"): (0, 0),
}


@pytest.mark.parametrize(("roles", "signs"), SIGNS.items())
def test_what_counts_as_finite_time_sustainable(roles: tuple[str, str], signs: tuple[int, int]) -> None:
    """σ by the roles of donor and recipient: of a pollutant, and of what is none."""
    nodes = (Node(id="a", role=ROLE[roles[0]], initial=(1.0, 1.0)), Node(id="b", role=ROLE[roles[1]]))
    for pollutant, sign in zip((True, False), signs, strict=True):
        arc = Arc(id="k", donor="a", recipient="b", rate=0.1, pollutant=pollutant)
        assert Network(name="two", nodes=nodes, arcs=(arc,)).sustainability.tolist() == [sign]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{'.'.join('a' * 3000)} = 1", r"nested too deeply"),
        (f"x = {'[' * 600}{']' * 600}", r"nested too deeply"),
        (f"x = 1\ny = {'9' * 5000}", r"line 2: is an integer of thousands of digits; more than 18 are not possible"),
        (f"x = {'9' * 30}", r"x: is an integer of 30 digits; more than 18 are not possible"),
    ],
)
def test_files_that_are_too_deep_or_too_long(text: str, message: str, tmp_path: Path) -> None:
    """They are refused in a line, however deep or long they are."""
    (tmp_path / "x.toml").write_text(text)
    with pytest.raises(DefinitionError, match=message) as error:
        load_network(tmp_path / "x.toml")
    assert len(str(error.value)) < 500


def test_a_missing_column_is_said_itself(tmp_path: Path) -> None:
    """Not what follows from it: a history that is read from a file needs the file."""
    text = (folder("envs") / "plastics_world.toml").read_text()
    (tmp_path / "x.toml").write_text(text)
    with pytest.raises(DefinitionError, match=r"nodes\.\w+\.history: file 'plastics_world.csv': is not there") as error:
        load_network(tmp_path / "x.toml")
    assert "must be a series" not in str(error.value)


@pytest.mark.parametrize(
    ("table", "value"),
    [(table, value) for table in ("nodes", "arcs", "services") for value in ("[]", "5", '"x"')]
    + [("agents", value) for value in ("{}", "5", '"x"')],
)
def test_mutated_copies_are_refused(table: str, value: str, tmp_path: Path) -> None:
    """A definition with copies whose tables are something else is refused by name."""
    (tmp_path / "steel.toml").write_text((folder("envs") / "steel.toml").read_text())
    document = tomllib.loads((folder("envs") / "steel_world.toml").read_text())
    others = {key: entry for key, entry in document.items() if key not in (table, "scenarios")}
    (tmp_path / "x.toml").write_text(f"{table} = {value}\n{tomlkit.dumps(others)}")
    with pytest.raises(DefinitionError, match=rf"{table}: must be a (table|list of names)"):
        load_network(tmp_path / "x.toml")


def test_missing_file(tmp_path: Path) -> None:
    """A missing file is named."""
    with pytest.raises(DefinitionError, match=r"nowhere\.toml.*no such file"):
        load_network(tmp_path / "nowhere.toml")


def test_unknown_names_give_the_nearest() -> None:
    """Networks and scenarios; agents and options are in test_bad_input."""
    with pytest.raises(CirlError, match=r"unknown network 'coper_net'. Did you mean 'copper_net'"):
        load_network("coper_net")
    with pytest.raises(CirlError, match=r"unknown scenario 'papers'. Did you mean 'paper'"):
        load_network("copper_net", scenario="papers")


def test_an_edit_is_noticed(tmp_path: Path) -> None:
    """A definition changed on disk is read again."""
    path = tmp_path / "mine.toml"
    path.write_text(COPPER, encoding="utf-8")
    assert load_network(path).episode.horizon == 160
    path.write_text(COPPER.replace("horizon = { value = 160", "horizon = { value = 7"), encoding="utf-8")
    os.utime(path, ns=(1, 1))
    assert load_network(path).episode.horizon == 7
    assert load_network(path) is load_network(path)


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_physical_scenario_is_physical(name: str) -> None:
    """Stocks are kept non-negative by the solver, and flows that are set are bounded below by 0."""
    network = load_network(name)
    assert network.episode.solver in ("exact", "rk4")
    for compartment in network.compartments.values():
        control = compartment.control
        assert control is None or control.kind is not ControlKind.FLOW or constant(control.low) >= 0


def test_network_can_be_built_in_python() -> None:
    """A network without a definition file obeys the same checks."""
    source = load_network("copper_net")
    with pytest.raises(CirlError, match="used twice"):
        Network(name="twice", nodes=(*source.nodes, source.nodes[0]), arcs=())
