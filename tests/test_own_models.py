"""Compartment models of the user's own: in networks, in files, and in training runs on disk."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from own_models import Fermenter, LeakyFermenter

from cirl_marl import (
    Arc,
    CirlError,
    Control,
    DefinitionError,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    Role,
    load_network,
)
from cirl_marl.compartments import kind_of, model_class
from cirl_marl.compartments.digester import Digester
from cirl_marl.definitions.reader import write_network
from cirl_marl.evaluation import compare
from cirl_marl.learners.interface import train
from cirl_marl.learners.recipe import Recipe


def brewery() -> Network:
    """Return a network of a fermenter and the air that its gas goes to; kinds are written as definitions spell them."""
    said: dict[str, Any] = {"kind": "input", "role": "environment", "law": "compartment"}
    dilution = Control(kind=said["kind"], low=0.05, neutral=0.2, high=0.5)
    return Network(
        name="brewery",
        nodes=(
            Node(id="tank", initial=(90.0, 90.0), control=dilution, model=Fermenter(), inner=((4.0, 6.0), (1.0, 2.0))),
            Node(id="air", role=said["role"]),
        ),
        arcs=(Arc(id="gas", donor="tank", recipient="air", law=said["law"], rate=0.1, by="tank"),),
        episode=Episode(control_interval=0.5, horizon=20, solver="rk4", solver_step=0.05),
    )


def test_own_models_are_kept_and_come_back(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """A definition names where the class is; figures are those of the network built; runs on disk can be compared."""
    network = brewery()
    assert network.nodes[1].role is Role.ENVIRONMENT
    assert network.arcs[0].law is Law.COMPARTMENT
    path = tmp_path / "brewery.toml"
    write_network(network, path)
    assert 'kind = "own_models:Fermenter"' in path.read_text()
    again = load_network(path)
    assert again.compartments == network.compartments
    lambdas = []
    for each in (network, again):
        env = MultiAgentVectorEnv(each, num_envs=3)
        env.reset(seed=0)
        for _ in range(20):
            infos = env.step({"tank": np.full((3, 1), 0.3)})[-1]
        lambdas.append(infos["tank"]["circularity"])
    np.testing.assert_array_equal(*lambdas)
    assert (lambdas[0] < 0.0).all()
    train(network, ppo_recipe, directory=tmp_path / "run")
    assert [row.name for row in compare([tmp_path / "run"], ["neutral"], episodes=2).rows] == ["small", "neutral"]


def test_kinds_of_the_library_keep_their_names() -> None:
    """Also where a class of one's own takes the name of one of them."""
    for kind in ("digester", "delivery_truck", "incinerator", "reacher"):
        assert kind_of(model_class(kind)()) == kind

    class Other(Digester):
        """Another digester."""

    assert kind_of(Other()).endswith("Other")


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("own_models:Fermentor", "has no attribute 'Fermentor'"),
        ("no_such_module:Fermenter", "No module named 'no_such_module'; install it, or run with PYTHONPATH pointing"),
        ("no_such_package.models:Fermenter", "No module named 'no_such_package'; install it, or run with PYTHONPATH"),
        ("own_models.inner:Fermenter", "No module named 'own_models.inner'; 'own_models' is not a package$"),
        ("own_models:np", "is no class of compartment models, but <module 'numpy'"),
        (":Fermenter", "kind ':Fermenter': write where the class is, as 'package.module:Class'"),
        (".own_models:Fermenter", "kind '.own_models:Fermenter': write where the class is"),
        ("own_models:", "kind 'own_models:': write where the class is"),
        ("own_models:Aimless", "it lacks derivative, reward_state, state_names, time_unit$"),
        ("own_models:Stray", "it inherits from none of ContinuousModel, OwnStepModel, DiscreteTimeModel; it has deriv"),
        ("own_models:Stray", "it has derivative and does not inherit from ContinuousModel$"),
        ("cirl_marl.compartments:CompartmentModel", "inherits from none of ContinuousModel, OwnStepModel, Discret"),
        ("fermenter", "unknown compartment kind 'fermenter'"),
    ],
)
def test_places_without_a_model_are_named(kind: str, said: str) -> None:
    """Module, class and what is there instead."""
    with pytest.raises(CirlError, match=said):
        model_class(kind)


def test_modules_that_cannot_be_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fault in the user's own module is told as such; what it imports itself is not taken for it."""
    (tmp_path / "faulty_models.py").write_text("rate = 1 / 0\n")
    (tmp_path / "needy_models.py").write_text("import no_such_library\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(CirlError, match="'faulty_models:Mine': importing it failed: ZeroDivisionError: division by"):
        model_class("faulty_models:Mine")
    with pytest.raises(CirlError, match=r"'needy_models:Mine': No module named 'no_such_library'$"):
        model_class("needy_models:Mine")


@pytest.mark.parametrize(
    ("unit", "stated", "said"),
    [
        ("1/day", True, None),
        ("1/hour", True, None),
        ("parsec", True, "unit 'parsec' is inconsistent: a quantity in '1/day' is needed"),
        ("1", True, "unit '1' is inconsistent: a quantity in '1/day' is needed"),
        ("1", False, None),
        ("1/hour", False, "unit '1/hour': model 'fermenter' states no input_unit to convert to"),
        ("parsec", False, "unit 'parsec': model 'fermenter' states no input_unit to convert to"),
    ],
)
def test_units_of_inputs_of_own_models(
    unit: str, stated: bool, said: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Converted to the unit that the class states; of one that states none only numbers without unit are read."""
    if not stated:
        monkeypatch.delattr(Fermenter, "input_unit")
    network, path = brewery(), tmp_path / "brewery.toml"
    write_network(network, path)
    text = path.read_text()
    own = "1/day" if stated else "1"
    written = f'low = 0.05, neutral = 0.2, high = 0.5, unit = "{own}"'
    assert written in text
    path.write_text(text.replace(written, written.replace(own, unit)))
    if said is not None:
        with pytest.raises(DefinitionError, match=f"nodes.tank.control: {said}"):
            load_network(path)
        return
    control = load_network(path).nodes[0].control
    assert control is not None
    hours = 24.0 if unit == "1/hour" else 1.0
    assert (control.low, control.neutral, control.high) == pytest.approx((0.05 * hours, 0.2 * hours, 0.5 * hours))


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ("", ["nodes.tank.model: parameters.leak_per_day: missing", "nodes.tank.model: parameters.stirred: missing"]),
        ("leak_per_day = true, stirred = true", ["model: parameters.leak_per_day: needs a number, got True"]),
        ("leak_per_day = 0.1, stirred = 1", ["nodes.tank.model: parameters.stirred: needs true or false, got 1.0"]),
        (
            "leak_per_day = -0.1, stirred = true",
            ["'own_models:LeakyFermenter' refuses its parameters: ValueError: leak_per_day = -0.1: a leak takes away"],
        ),
        (
            "leak_per_dy = 0.1, stirred = true",
            ["unknown parameter 'leak_per_dy'. Did you mean 'leak_per_day'?", "parameters.leak_per_day: missing"],
        ),
    ],
)
def test_parameters_of_own_models(parameters: str, said: list[str], tmp_path: Path) -> None:
    """File and key of what is missing, of another kind, or refused by the class itself; all of it at once."""
    path = tmp_path / "brewery.toml"
    network = brewery()
    tank = replace(network.nodes[0], model=LeakyFermenter(leak_per_day=0.1, stirred=True))
    write_network(replace(network, nodes=(tank, network.nodes[1])), path)
    assert load_network(path).nodes[0].model == tank.model
    text = path.read_text()
    path.write_text(re.sub(r"parameters = \{.*?\}", f"parameters = {{ {parameters} }}", text))
    with pytest.raises(DefinitionError) as raised:
        load_network(path)
    assert all(line.startswith(str(path)) for line in str(raised.value).splitlines())
    for fragment in said:
        assert fragment in str(raised.value)


ENDS = {"donor": "a", "recipient": "b"}
VALVE = {"low": 0.0, "neutral": 1.0, "high": 2.0}


@pytest.mark.parametrize(
    ("part", "given", "said"),
    [
        (
            Node,
            {"id": "a", "role": "reservoir"},
            "node 'a': unknown role 'reservoir'. Did you mean 'nonrenewable_reser",
        ),
        (Arc, {"id": "k", "law": "doner", **ENDS}, "arc 'k': unknown law 'doner'. Did you mean 'donor'"),
        (Control, {"kind": "rat", **VALVE}, "control: unknown kind 'rat'. Did you mean 'rate'"),
    ],
)
def test_words_that_are_none_are_refused(part: Any, given: dict[str, Any], said: str) -> None:
    """Roles, laws and kinds may be spelt as in definitions, but must exist."""
    with pytest.raises(CirlError, match=said):
        part(**given)
