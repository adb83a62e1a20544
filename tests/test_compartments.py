"""What holds for every compartment model: it is found, tested, pure, batched, and agrees with scipy."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from cirl_marl import Network, NetworkError, Node, compartments
from cirl_marl.compartments import model_class, models
from cirl_marl.compartments.atmosphere import Atmosphere
from cirl_marl.compartments.delivery_truck import DeliveryTruck
from cirl_marl.compartments.digester import Digester
from cirl_marl.compartments.digester_published import DigesterPublished
from cirl_marl.compartments.incinerator import Incinerator
from cirl_marl.compartments.microalgae_droop import MicroalgaeDroop
from cirl_marl.compartments.microalgae_monod import MicroalgaeMonod
from cirl_marl.compartments.transport_truck import TransportTruck
from cirl_marl.compartments.troposphere_temperature import TroposphereTemperature
from cirl_marl.errors import CirlError
from cirl_marl.network.compartment_model import (
    MOTIONS,
    OFFERS,
    CompartmentModel,
    ContinuousModel,
    DiscreteTimeModel,
    GoalTask,
    MeasuringModel,
    OutflowModel,
    OwnStepModel,
    ReleasingModel,
    Task,
    Vehicle,
    model_faults,
)
from cirl_marl.network.rowsum import Floats
from cirl_marl.network.units import factor

HELPERS = {"microalgae", "nutrient"}
"""Modules of the package that hold no model."""

DISCRETE = {"fetch", "reacher", "sorting_station"}
"""Kinds in discrete time: MuJoCo moves them, they have no derivative. test_robots.py tests what they do."""

OWN_STEP = {"microalgae_monod", "microalgae_droop"}
"""Kinds that bring their own step besides a derivative. test_microalgae_step.py tests the step."""

FORMS: list[ContinuousModel] = [
    TransportTruck(form="published"),
    TransportTruck(),
    DeliveryTruck(form="published"),
    DeliveryTruck(),
    Incinerator(form="published"),
    Incinerator(form="energy_balance"),
    Incinerator(),
    MicroalgaeMonod(form="published"),
    MicroalgaeMonod(),
    MicroalgaeDroop(form="published"),
    MicroalgaeDroop(),
    Digester(),
    DigesterPublished(),
    Atmosphere(),
    TroposphereTemperature(),
]
"""Every form of every model that is continuous in time."""

RANGES: dict[str, tuple[list[float], list[float], list[float], list[float]]] = {
    "transport_truck": ([0, -5], [1000, 25], [-12e3], [12e3]),
    "delivery_truck": ([-1, -5, 0], [11, 5, 10], [-12e3], [12e3]),
    "incinerator": ([500, 20, 200, 20, 20, 800], [3000, 200, 500, 60, 60, 1200], [-1e5], [6e5]),
    "microalgae_monod": ([10, 0.5], [40, 20], [1], [150]),
    "microalgae_droop": ([10, 2, 0.5], [40, 4, 20], [1], [150]),
    "digester": ([1, 1, 4, 3, 205, 220], [2, 4, 8, 8, 215, 245], [0.3], [0.7]),
    "digester_published": ([1, 1, 4, 3, 205, 230], [2, 4, 8, 8, 215, 240], [0.4] * 6, [0.6] * 6),
    "atmosphere": ([1], [9], [0, 0], [5, 5]),
    "troposphere_temperature": ([280], [300], [], []),
}
"""State and input ranges from which samples are drawn."""

CONTEXT: dict[str, tuple[float, float]] = {"load_kg": (0.0, 600.0), "stock_kg": (6e5, 1.5e6)}
"""Ranges of what a network tells a model."""

OFFERED = {
    "derivative": "ContinuousModel",
    "integrate": "OwnStepModel",
    "advance": "DiscreteTimeModel",
    "outflow": "OutflowModel",
    "measures": "MeasuringModel",
    "success": "Task",
    "goal_reward": "GoalTask",
    "released_units": "ReleasingModel",
    "can_board": "Vehicle",
}
"""A method of every contract that a model may inherit from."""

SPAN: dict[str, float] = {"s": 5.0, "min": 5.0, "day": 0.5}
"""How long a model runs, in its unit."""

every_form = pytest.mark.parametrize("model", FORMS, ids=lambda model: f"{model.kind}-{getattr(model, 'form', 'only')}")


def sample(model: ContinuousModel, size: int) -> tuple[Floats, Floats, dict[str, Floats]]:
    """Return states (k, B), inputs (c, B) and context (B,) drawn from the model's ranges."""
    rng = np.random.default_rng(7)
    low, high, input_low, input_high = (np.array(bound, dtype=np.float64)[:, None] for bound in RANGES[model.kind])
    state = rng.uniform(low, high, size=(len(low), size))
    inputs = rng.uniform(input_low, input_high, size=(len(input_low), size))
    return state, inputs, {name: rng.uniform(*CONTEXT[name], size) for name in model.context_names}


def outputs(
    model: CompartmentModel, state: Floats, inputs: Floats, context: dict[str, Floats]
) -> dict[str, NDArray[Any]]:
    """Return everything that the model computes of a state, by name."""
    found: dict[str, NDArray[Any]] = {"reward": model.reward(state, inputs)}
    if type(model).receive is not CompartmentModel.receive:
        found["receive"] = model.receive(state, np.full(state.shape[1], 50.0))
    if isinstance(model, ContinuousModel):
        found["derivative"] = model.derivative(state, inputs, **context)
    if isinstance(model, OwnStepModel):
        found["integrate"], found["mean outflow"] = model.integrate(state, inputs, 0.01)
    if isinstance(model, DiscreteTimeModel):
        found["advance"] = model.advance(state, inputs, **context)
    if isinstance(model, OutflowModel):
        found["outflow"] = model.outflow(state, inputs)
    if isinstance(model, MeasuringModel):
        found["measures"] = model.measures(state, inputs)
    if isinstance(model, Task):
        found["success"] = model.success(state, inputs)
    if isinstance(model, ReleasingModel):
        found |= {"released": model.released_units(state), "complete": model.complete(state)}
    if isinstance(model, Vehicle):
        found |= {"boarding": model.can_board(state), "arrived": model.has_arrived(state)}
        found |= {"depart": model.depart(state, found["boarding"])}
        found |= {"turn_back": model.turn_back(state, found["arrived"])}
    return found


def shapes(model: CompartmentModel, size: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each of these, where it is not that of the state."""
    found: dict[str, tuple[int, ...]] = dict.fromkeys(
        ("reward", "mean outflow", "outflow", "success", "complete", "boarding", "arrived"), (size,)
    )
    if isinstance(model, MeasuringModel):
        found["measures"] = (len(model.measure_names), size)
    if isinstance(model, ReleasingModel):
        found["released"] = (len(model.ports), size)
    return found


def rk4(rate: Callable[[Floats], Floats], state: Floats, span: float, steps: int) -> Floats:
    """Return the state after ``span``, by the classical Runge-Kutta method."""
    h = span / steps
    for _ in range(steps):
        k1 = rate(state)
        k2 = rate(state + h / 2 * k1)
        k3 = rate(state + h / 2 * k2)
        k4 = rate(state + h * k3)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state


class TestRegistry:
    """What lies in the folder is what there is, and all of it is tested."""

    def test_every_model_is_in_the_tables(self) -> None:
        """A model without a test fails here, and so does a test without a model."""
        assert {model.kind for model in FORMS} == set(RANGES) == set(models()) - DISCRETE
        assert set(models()) > DISCRETE

    def test_every_form_is_in_the_tables(self) -> None:
        """Each value of ``form`` that a model accepts is among the forms; a made-up one is refused."""
        for kind in RANGES:
            tested = {getattr(model, "form", None) for model in FORMS if model.kind == kind}
            if tested == {None}:
                continue
            with pytest.raises(CirlError, match="Known") as refused:
                model_class(kind)(form="neither")
            known = str(refused.value).split("Known: ")[1].rstrip(".").split(", ")
            assert tested == set(known), kind

    def test_ways_to_move(self) -> None:
        """Which kinds the generic tests cannot integrate, and which bring a step of their own."""
        moves = {kind: {motion for motion in MOTIONS if issubclass(model, motion)} for kind, model in models().items()}
        for kind, ways in moves.items():
            own = {ContinuousModel, OwnStepModel} if kind in OWN_STEP else {ContinuousModel}
            assert ways == ({DiscreteTimeModel} if kind in DISCRETE else own), kind

    @pytest.mark.parametrize("kind", models())
    def test_models_keep_their_contract(self, kind: str) -> None:
        """Names belong together, nothing that is offered is left abstract, and every result has its shape."""
        assert not list(model_faults(model_class(kind)))
        model = model_class(kind)()
        assert model.kind == kind
        assert not hasattr(model, "__dict__")
        states, names = model.state_names, {*model.state_names, *model.input_names}
        assert len(names) == len(states) + len(model.input_names)
        assert set(model.observed_states) <= set(states)
        assert set(model.bounds) <= names
        assert set(model.context_names) <= set(CONTEXT)
        assert model.ranged_states == (() if isinstance(model, DiscreteTimeModel) else states)
        assert bool(model.input_names) == (model.input_unit is not None)
        assert isinstance(model.robot, CompartmentModel)
        if isinstance(model, GoalTask):
            parts = (*model.observation_names, *model.achieved_names, *model.desired_names)
            assert set(parts) <= set(model.observed_states)
            assert len(model.achieved_names) == len(model.desired_names)
        if isinstance(model, DiscreteTimeModel):
            assert model.interval > 0.0
            state = np.stack([model.start(np.random.default_rng(i)) for i in range(2)], axis=1)
            inputs = np.zeros((len(model.input_names), 2))
            context = {name: np.full(2, CONTEXT[name][0]) for name in model.context_names}
        else:
            state, inputs, context = sample(model, 2)
        assert len(states) == len(state)
        expected = shapes(model, 2)
        for name, value in outputs(model, state, inputs, context).items():
            assert value.shape == expected.get(name, state.shape), name

    @pytest.mark.parametrize(
        ("bases", "offered", "said"),
        [
            ((), "derivative", "it inherits from none of ContinuousModel, OwnStepModel, DiscreteTimeModel"),
            ((OutflowModel,), "outflow", "it inherits from none of ContinuousModel, OwnStepModel, DiscreteTimeModel"),
            ((ContinuousModel,), "reward", "it lacks derivative, input_names, kind, reward_state, state_names, time_"),
            ((DiscreteTimeModel,), "advance", "it lacks input_names, interval, kind, reward, reward_state, start, st"),
            *(((), name, f"it has {name} and does not inherit from {offer}") for name, offer in OFFERED.items()),
        ],
    )
    def test_what_is_missing_is_named(self, bases: tuple[type[Any], ...], offered: str, said: str) -> None:
        """A class is told what it lacks, and which contract goes with what it has; Python makes no model of it."""
        given = type("Given", bases, {offered: lambda *_: None})
        assert any(fault.startswith(said) for fault in model_faults(given))
        if bases:
            with pytest.raises(TypeError, match="Can't instantiate abstract class Given"):
                given()

    def test_a_network_refuses_what_is_no_model(self) -> None:
        """By its compartment, with the other mistakes there."""
        with pytest.raises(NetworkError, match="'tank': model Strange: it inherits from none of Conti") as raised:
            Network(name="One", nodes=(Node(id="tank", model=type("Strange", (), {})()),), arcs=())
        assert [problem.split(":")[0] for problem in raised.value.problems] == ["name 'One'", "'tank'"]

    def test_every_module_holds_a_model(self) -> None:
        """Each module but the helpers is found by the registry; robots lie in a package of their own."""
        modules = {info.name for info in pkgutil.iter_modules(compartments.__path__) if not info.ispkg}
        found = {kind: model.__module__.removeprefix(f"{compartments.__name__}.") for kind, model in models().items()}
        assert {module for kind, module in found.items() if kind not in DISCRETE} == modules - HELPERS
        assert {found[kind] for kind in DISCRETE} == {f"robots.{kind}" for kind in DISCRETE}
        assert all(model_class(kind) is model for kind, model in models().items())

    def test_unknown_kind(self) -> None:
        """The error names the nearest match, robots included."""
        with pytest.raises(CirlError, match="Did you mean 'digester'"):
            model_class("digestor")
        with pytest.raises(CirlError, match="Did you mean 'sorting_station'"):
            model_class("sorting_staton")

    def test_every_offer_is_in_the_table(self) -> None:
        """Each contract has the method that gives it away."""
        assert set(OFFERED.values()) == {offer.__name__ for offer in OFFERS}

    def test_models_returns_a_copy(self) -> None:
        """Nobody can empty the registry."""
        models().clear()
        assert models()

    @pytest.mark.parametrize(
        ("build", "message"),
        [
            (lambda: TransportTruck(form="publised"), "Did you mean 'published'"),  # type: ignore[arg-type]
            (lambda: TransportTruck(truck_kg=-1.0), "truck_kg -1.0"),
            (lambda: TransportTruck(force_weight=-1.0), "force_weight -1.0"),
            (lambda: TransportTruck(target_m=float("nan")), "target_m nan"),
            (lambda: DeliveryTruck(target_m=0.0), "target_m 0.0"),
            (lambda: DeliveryTruck(target_m=1.0), "reach_m = 0.5"),
            (lambda: DeliveryTruck(rest_m_s=-1.0), "rest_m_s -1.0"),
            (lambda: Incinerator(gas_residence_min=0.0), "gas_residence_min 0.0"),
            (lambda: Incinerator(reference_degc=-300.0), "reference_degc"),
            (lambda: Incinerator(ambient_degc=float("nan")), "ambient_degc"),
            (lambda: Incinerator(bed_share=1.5), "bed_share 1.5"),
            (lambda: MicroalgaeMonod(light_half_saturation=0.0), "light_half_saturation 0.0"),
            (lambda: MicroalgaeDroop(dilution_per_day=float("nan")), "dilution_per_day nan"),
            (lambda: Digester(k1=0.0), "k1 0.0"),
            (lambda: Digester(released_share=1.2), "released_share 1.2"),
            (lambda: Digester().equilibrium(3.0), "no equilibrium"),
            (lambda: Digester().equilibrium(0.0), "no equilibrium"),
            (lambda: DigesterPublished(settling_day=0.0), "settling_day"),
            (lambda: TroposphereTemperature(albedo=1.1), "albedo 1.1"),
            (lambda: TroposphereTemperature(greenhouse_m3_mg=float("inf")), "greenhouse_m3_mg inf"),
        ],
    )
    def test_bad_parameters(self, build: Callable[[], Any], message: str) -> None:
        """Parameters without a meaning are refused by name."""
        with pytest.raises(CirlError, match=message):
            build()


@every_form
class TestEveryModel:
    """The contract of a compartment model."""

    def test_shapes_units_purity(self, model: ContinuousModel) -> None:
        """Shapes and dtypes are as stated, arguments stay as they were, the time unit can be read."""
        state, inputs, context = sample(model, 5)
        kept = state.copy(), inputs.copy(), {name: values.copy() for name, values in context.items()}
        assert state.shape[0] == len(model.state_names)
        assert inputs.shape[0] == len(model.input_names)
        expected = shapes(model, 5)
        for name, value in outputs(model, state, inputs, context).items():
            assert value.shape == expected.get(name, state.shape), name
            assert value.dtype == (np.bool_ if name in ("boarding", "arrived") else np.float64), name
            assert np.isfinite(value).all(), name
            assert not any(np.shares_memory(value, given) for given in (state, inputs, *context.values())), name
        np.testing.assert_array_equal(state, kept[0])
        np.testing.assert_array_equal(inputs, kept[1])
        for name, values in context.items():
            np.testing.assert_array_equal(values, kept[2][name])
        assert factor(model.time_unit, "s") > 0.0
        with pytest.raises((AttributeError, TypeError)):
            setattr(model, next((each.name for each in fields(model)), "kind"), 1.0)  # type: ignore[arg-type]

    @pytest.mark.parametrize("size", [2, 7, 64])
    def test_batched_equals_alone(self, model: ContinuousModel, size: int) -> None:
        """A column's bits do not depend on the batch it is in."""
        state, inputs, context = sample(model, size)
        together = outputs(model, state, inputs, context)
        for b in range(size):
            column = slice(b, b + 1)
            own = {name: values[column].copy() for name, values in context.items()}
            alone = outputs(model, state[:, column].copy(), inputs[:, column].copy(), own)
            for name, value in alone.items():
                np.testing.assert_array_equal(value, together[name][..., column], err_msg=name)

    @pytest.mark.sample(5)
    def test_agrees_with_scipy(self, model: ContinuousModel) -> None:
        """Runge-Kutta at a fine step and scipy's DOP853 at 1e-11 agree."""
        state, inputs, context = sample(model, 3)
        span = SPAN[model.time_unit]
        fine = rk4(lambda z: model.derivative(z, inputs, **context), state, span, 4000)
        for b in range(3):
            held = inputs[:, b : b + 1]
            told = {name: values[b : b + 1] for name, values in context.items()}

            def rate(_: float, z: Floats, held: Floats = held, told: dict[str, Floats] = told) -> Floats:
                return model.derivative(z[:, None], held, **told)[:, 0]

            exact = solve_ivp(rate, (0.0, span), state[:, b], method="DOP853", rtol=1e-11, atol=1e-11)
            assert exact.success
            np.testing.assert_allclose(fine[:, b], exact.y[:, -1], rtol=2e-9, atol=1e-9)


@pytest.mark.parametrize("model", [model for model in FORMS if model.context_names])
def test_context_matters(model: ContinuousModel) -> None:
    """What the network tells a model changes how it moves."""
    state, inputs, context = sample(model, 6)
    assert context
    plain = model.derivative(state, inputs, **context)
    for name, value in context.items():
        told = model.derivative(state, inputs, **context | {name: 2.0 * value})
        assert not np.allclose(told, plain, rtol=1e-6, atol=0.0), name
