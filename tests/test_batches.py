"""Batches: conservation with mass in transit, transit times, the paper's stages of λ, vehicles, snapshots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cirl_marl import Arc, Control, ControlKind, MultiAgentVectorEnv, Network, NetworkError, Node, Role
from cirl_marl.compartments import DiscreteTimeModel, ReleasingModel, RewardState, model_class
from cirl_marl.network import Floats
from cirl_marl.network.elements import Episode, Law, Objective, Service

INTERVAL = 0.04
ITEM = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Belt(DiscreteTimeModel, ReleasingModel):
    """A sorting belt without a robot: an item takes ``work`` steps; every ``nth`` one is missed."""

    kind: ClassVar[str] = "belt"
    state_names: ClassVar[tuple[str, ...]] = ("worked", "done", "sorted", "missed", "complete")
    input_names: ClassVar[tuple[str, ...]] = ()
    time_unit: ClassVar[str] = "s"
    reward_state: ClassVar[RewardState] = "after"
    interval: ClassVar[float] = INTERVAL
    context_names: ClassVar[tuple[str, ...]] = ("stock_kg",)
    ports: ClassVar[tuple[str, ...]] = ("sorted", "unsorted")

    work: int = 20
    nth: int = 3
    items: int = 4

    def start(self, stream: np.random.Generator) -> Floats:
        """Return an idle belt."""
        return np.zeros(5)

    def advance(self, state: Floats, inputs: Floats, *, stock_kg: Floats) -> Floats:
        """Work on an item, if there is one."""
        worked, done = state[0], state[1]
        worked = np.where(stock_kg >= ITEM * (1 - 1e-9), worked + 1, 0.0)
        ready = worked >= self.work
        done = done + ready
        missed = ready & (done % self.nth == 0)
        complete = ready & (done % self.items == 0)
        return np.stack([np.where(ready, 0.0, worked), done, ready & ~missed, missed, complete]).astype(float)

    def released_units(self, state: Floats) -> Floats:
        """Return items sorted and missed in the last step."""
        return state[2:4]

    def complete(self, state: Floats) -> NDArray[np.bool_]:
        """Return where a batch is complete."""
        complete: NDArray[np.bool_] = state[4] > 0
        return complete

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return nothing."""
        return np.zeros(state.shape[1])


def network(nth: int = 3, work: int = 20, starts: tuple[float, ...] = (0.0, 10.0), horizon: int = 700) -> Network:
    """N_s with a belt instead of the robot: two batches of four items."""
    truck = model_class("delivery_truck")()
    return Network(
        name="belt_net",
        nodes=(
            Node(id="reservoir", role=Role.NONRENEWABLE_RESERVOIR, initial=(800.0, 800.0)),
            Node(id="sorter", initial=(0.0, 0.0), model=Belt(nth=nth, work=work)),
            Node(id="incinerator", role=Role.INCINERATOR),
        ),
        arcs=(
            Arc(
                id="first_use",
                donor="reservoir",
                recipient="sorter",
                law=Law.BATCH,
                batches=tuple((time, 400.0) for time in starts),
                delay=2.0,
            ),
            Arc(
                id="recycling",
                donor="sorter",
                recipient="incinerator",
                law=Law.BATCH,
                by="sorter",
                port="sorted",
                rate=ITEM,
                delay=8.0,
            ),
            Arc(
                id="truck",
                donor="sorter",
                recipient="incinerator",
                law=Law.BATCH,
                by="sorter",
                port="unsorted",
                rate=ITEM,
                model=truck,
                inner=((0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
                control=Control(kind=ControlKind.INPUT, low=-12e3, neutral=0.0, high=12e3),
            ),
        ),
        services=(Service(id="second_use", provider="recycling", quantity="stock", low=400.0),),
        episode=Episode(control_interval=INTERVAL, horizon=horizon, solver="rk4", solver_step=INTERVAL),
        time_unit="s",
    )


def drive(env: MultiAgentVectorEnv) -> dict[str, Floats]:
    """Return the action of a driver who aims for the truck's destination: a damped spring."""
    rows = {name: i for i, name in enumerate(env.dynamics.inner.names)}
    position, speed, destination = (
        env.physical.inner[rows[f"truck.{n}"]] for n in ("position_m", "speed_m_s", "destination_m")
    )
    force = np.clip(3000 * (destination - position) - 6000 * speed, -12e3, 12e3)
    return {"truck": (force / 12e3)[:, None]}


def masses(env: MultiAgentVectorEnv) -> Floats:
    """Return all the mass there is, shape (B,)."""
    total: Floats = env.physical.stock[:-1].sum(axis=0)
    return total


@pytest.mark.medium
@settings(max_examples=settings().max_examples // 3)
@given(seed=st.integers(0, 2**31), nth=st.integers(1, 5), work=st.integers(1, 40))
def test_mass_in_transit_is_conserved(seed: int, nth: int, work: int) -> None:
    """Under any driving, what left the reservoir is at a node, on the way or aboard."""
    env = MultiAgentVectorEnv(network(nth, work, horizon=400), num_envs=2)
    env.reset(seed)
    rng = np.random.default_rng(seed)
    for _ in range(400):
        env.advance(rng.uniform(-1, 1, (1, 2)))
        np.testing.assert_allclose(masses(env), 800.0, rtol=1e-13)
        assert (env.physical.stock >= 0).all()


@pytest.mark.medium
@pytest.mark.parametrize(("nth", "success"), [(1, 0.0), (2, 0.5), (4, 0.75), (9, 1.0)])
def test_stages_of_circularity(nth: int, success: float) -> None:
    """λ is −m, then −(m + m_u), then −2m for each batch, at the realised T_s and arrival times."""
    env = MultiAgentVectorEnv(network(nth), num_envs=1)
    env.reset(0)
    found, arrivals = [], []
    for _ in range(env.network.episode.horizon):
        before = env.physical.stock[2, 0]
        found.append(env.advance(env.stack(drive(env))).circularity[0])
        if env.physical.stock[2, 0] > before:
            arrivals.append(len(found) * INTERVAL)
    sorting = 4 * 20 * INTERVAL
    time = np.arange(1, len(found) + 1) * INTERVAL
    expected = np.zeros(len(time))
    for start in (0.0, 10.0):
        entered = start + 2.0
        unsorted_kg = 400.0 * (1 - success)
        used = entered + sorting + 8.0
        assert success == 0 or any(abs(arrival - used) < 1e-9 for arrival in arrivals)
        trips = [a for a in arrivals if entered + sorting < a < used - 1e-9 or (success == 0 and a > entered + sorting)]
        driven = trips[0] if unsorted_kg else used
        assert driven <= used
        expected -= np.where(time > start + 1e-9, 400.0, 0.0) + np.where(time >= driven - 1e-9, unsorted_kg, 0.0)
        expected -= np.where(time >= used - 1e-9, 400.0 - unsorted_kg, 0.0)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_batch_arrives_after_its_delay() -> None:
    """A batch sent at the start of interval i arrives at the end of interval i + n − 1, whole."""
    env = MultiAgentVectorEnv(network(starts=(0.4,)), num_envs=1)
    env.reset(0)
    sorter, leaves, arrives = [], round(0.4 / INTERVAL), round(2.4 / INTERVAL)
    for step in range(arrives + 1):
        env.advance(np.zeros((1, 1)))
        sorter.append(env.physical.stock[1, 0])
        assert env.physical.stock[0, 0] == (800.0 if step < leaves else 400.0)
    assert sorter[:-2] == [0.0] * (arrives - 1)
    assert sorter[-2:] == [400.0, 400.0]


@given(
    stocks=st.lists(st.floats(0.0, 50.0) | st.floats(0.0, 1e-320), min_size=1, max_size=4),
    asked=st.lists(st.floats(1e-3, 40.0), min_size=1, max_size=12),
)
def test_an_empty_donor_sends_what_it_has(stocks: list[float], asked: list[float]) -> None:
    """Batches asked of one donor never overdraw it, however little it holds; what it holds otherwise goes, or stays."""
    network = Network(
        name="rush",
        nodes=(Node(id="store", initial=(0.0, 0.0)), Node(id="market")),
        arcs=tuple(
            Arc(id=f"lot_{i}", donor="store", recipient="market", law=Law.BATCH, delay=1.0, batches=((0.0, mass),))
            for i, mass in enumerate(asked)
        ),
    )
    env = MultiAgentVectorEnv(network, num_envs=len(stocks))
    env.reset(seed=0)
    stock = env.physical.stock.copy()
    stock[0] = stocks
    env.dynamics.batches.dispatch(stock, env.physical.step)
    assert (stock >= 0.0).all()
    np.testing.assert_allclose(stock[:-1].sum(axis=0), stocks, rtol=1e-13)
    np.testing.assert_allclose(stock[0], np.maximum(np.array(stocks) - sum(asked), 0.0), rtol=1e-9, atol=1e-10)


def test_load_makes_the_truck_slower() -> None:
    """The same force moves a truck with 400 kg less far than an empty one, by the ratio of the masses."""
    env = MultiAgentVectorEnv(network(nth=1), num_envs=1)
    env.reset(0)
    rows = {name: i for i, name in enumerate(env.dynamics.inner.names)}
    speeds = {}
    while "loaded" not in speeds:
        loaded = env.physical.inner[rows["truck.destination_m"], 0] > 0
        env.advance(np.array([[1.0 if loaded or env.physical.step[0] == 0 else 0.0]]))
        speed = env.physical.inner[rows["truck.speed_m_s"], 0]
        if loaded:
            speeds["loaded"] = speed
        elif env.physical.step[0] == 1:
            speeds["empty"] = speed
            state = {f"truck.{n}": 0.0 for n in ("position_m", "speed_m_s", "destination_m")}
            env.reset(0, options={"initial_state": state})
            env.advance(np.array([[0.0]]))
    friction = 0.01 * 9.80665
    assert speeds["empty"] == pytest.approx((12e3 / 3000 - friction) * INTERVAL, rel=0.03)
    assert speeds["loaded"] == pytest.approx((12e3 / 3400 - friction) * INTERVAL, rel=0.03)


@pytest.mark.medium
def test_snapshot_with_mass_on_the_way() -> None:
    """From a snapshot with slots, dock and truck in use all comes again; copies do not mix over restarts."""
    env = MultiAgentVectorEnv(network(horizon=500), num_envs=3)
    env.reset(0)
    for _ in range(300):
        env.step(drive(env))
    snapshot = env.snapshot()
    assert (env.physical.stock[3:-1].sum(axis=0) > 0).all()
    first = []
    for _ in range(400):
        env.step(drive(env))
        first.append(env.state())
        np.testing.assert_allclose(masses(env), 800.0, rtol=1e-13)
    env.restore(snapshot)
    for expected in first:
        env.step(drive(env))
        np.testing.assert_array_equal(env.state(), expected)


def test_service_of_material_on_the_way() -> None:
    """A service may ask for mass on a batch arc."""
    env = MultiAgentVectorEnv(network(nth=9), num_envs=1)
    env.reset(0)
    levels = [env.advance(env.stack(drive(env))).service_level[0] for _ in range(200)]
    assert levels[0] == 0.0
    assert levels[-1] == 1.0
    assert set(levels) == {0.0, 0.25, 0.5, 0.75, 1.0}


def faulty(**changes: object) -> Network:
    """Return the network with its recycling arc changed."""
    good = network()
    return replace(good, arcs=(good.arcs[0], replace(good.arcs[1], **changes), good.arcs[2]))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"delay": 0.0}, "needs a delay or a vehicle"),
        ({"delay": -0.04}, "arc 'recycling': delay -0.04 must not be negative"),
        ({"delay": 0.05}, "delay 0.05 is not a whole number of control intervals of 0.04"),
        ({"port": "sortd"}, "unknown port 'sortd'. Did you mean 'sorted'"),
        ({"by": "reservoir"}, "batches are released by the model of the donor 'sorter'"),
        ({"rate": 0.0}, "needs a positive rate"),
        ({"batches": ((0.0, 1.0),)}, "not both"),
        ({"set_point": 3.0}, "takes no set_point"),
    ],
)
def test_faults_are_named(changes: dict[str, object], message: str) -> None:
    """What cannot be simulated is refused, with the reason."""
    with pytest.raises(NetworkError, match=message):
        faulty(**changes)


@pytest.mark.parametrize("delay", [-0.04, -0.02])
def test_a_vehicle_takes_no_delay_below_zero(delay: float) -> None:
    """It would be a line of less than no slots."""
    good = network()
    with pytest.raises(NetworkError, match=rf"(?s)a delay or a vehicle.*delay {delay} must not be negative"):
        replace(good, arcs=(*good.arcs[:2], replace(good.arcs[2], delay=delay)))


def test_the_clock_of_a_model_is_that_of_the_network() -> None:
    """A model in discrete time refuses another control interval."""
    with pytest.raises(NetworkError, match=r"model 'belt' moves in steps of 0\.04 s; the control interval is 0\.08 s"):
        replace(network(), episode=Episode(control_interval=0.08, solver="rk4", solver_step=0.08))


def test_wrong_units_of_time_hide_nothing_else() -> None:
    """That of the network is told once, that of a model with its compartment, and all other problems beside them."""
    with pytest.raises(NetworkError) as raised:
        replace(network(), time_unit="kg", name="Bad Name", mass_unit="Gton")
    told = [problem.split(":")[0] for problem in raised.value.problems]
    assert told == ["name 'Bad Name'", "units.mass", "units.time"]

    class Hasty(Belt):
        """A belt whose unit of time is none."""

        time_unit: ClassVar[str] = "sec0nds"

    good = network()
    sorter = replace(good.nodes[1], model=Hasty())
    with pytest.raises(NetworkError) as raised:
        replace(good, nodes=(good.nodes[0], sorter, good.nodes[2]), name="Bad Name")
    assert len(raised.value.problems) == 2
    assert raised.value.problems[1].startswith("'sorter': model 'belt': time_unit: unit 'sec0nds' cannot be read")


@pytest.mark.parametrize(("net_zero", "circularity"), [("signed", 10.0), ("abs", -10.0)])
def test_over_removal_in_batches_is_no_merit_under_abs(net_zero: str, circularity: float) -> None:
    """A batch taken out of the environment counts like a continuous flow: by its absolute value if so asked."""
    arc = Arc(id="taken", donor="air", recipient="store", law=Law.BATCH, delay=1.0, batches=((0.0, 10.0),))
    network = Network(
        name="removal",
        nodes=(Node(id="air", role=Role.ENVIRONMENT, initial=(50.0, 50.0)), Node(id="store")),
        arcs=(arc,),
        episode=Episode(horizon=3),
        objective=Objective(net_zero=net_zero),
    )
    env = MultiAgentVectorEnv(network, num_envs=2)
    env.reset(seed=0)
    outcome = env.advance(np.empty((0, 2)))
    np.testing.assert_allclose(outcome.circularity, circularity)
    np.testing.assert_allclose(outcome.circularity_mean, circularity)
