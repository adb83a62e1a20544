"""Compartment models of the user's own: in networks, in files, and in training runs on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from own_models import Fermenter

from cirl_marl import Arc, CirlError, Control, Episode, Law, Network, Node, Role, VectorEnv, load_network
from cirl_marl.comparison import compare
from cirl_marl.compartments import kind_of, model_class
from cirl_marl.compartments.digester import Digester
from cirl_marl.definition import write_network
from cirl_marl.learners import Recipe, train


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
        env = VectorEnv(each, num_envs=3)
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
        ("no_such_module:Fermenter", "No module named 'no_such_module'"),
        ("own_models:np", "is no class of compartment models"),
        ("fermenter", "unknown compartment kind 'fermenter'"),
    ],
)
def test_places_without_a_model_are_named(kind: str, said: str) -> None:
    """Module, class and what is there instead."""
    with pytest.raises(CirlError, match=said):
        model_class(kind)


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
