"""The solids network with its robots: conservation, the stages of λ, snapshots, equal views, couplings, its KPI."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from batch_circularity import staged_circularity, time_window_circularity
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from cirl_marl import MultiAgentVectorEnv, Network, SingleAgentEnv, load_network, parallel_env
from cirl_marl.compartments.delivery_truck import DeliveryTruck
from cirl_marl.controllers import Constant, Neutral, Random, ScriptController
from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.controllers.rollout import rollout
from cirl_marl.evaluation.figures import summary
from cirl_marl.network import Floats
from cirl_marl.network.elements import REWARDS, Law
from cirl_marl.testing.nested import same_or_raise

pytestmark = pytest.mark.medium
BATCH_KG, ITEMS = 300.0, 3
both = pytest.mark.parametrize("scenario", ["default", "reacher"])


class Mixed(Controller):
    """Scripted, but every other item is left alone, and the truck and the incinerator start with random actions."""

    def __init__(self, erratic: int) -> None:
        """Let truck and incinerator act at random for the first ``erratic`` intervals."""
        self._erratic = erratic
        self._scripted, self._random = ScriptController(), Random()

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Start both."""
        self._env, self._steps = env, 0
        self._scripted.start(env, seed)
        self._random.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Mix the actions of both."""
        actions, anything = dict(self._scripted.act(observations)), self._random.act(observations)
        odd = column(self._env, "sorter.attempt") % 2 == 1
        actions["sorter"] = np.where(odd[:, None], 0.0, actions["sorter"])
        if self._steps < self._erratic:
            actions |= {agent: anything[agent] for agent in ("truck", "incinerator")}
        self._steps += 1
        return actions


CONTROLLERS: dict[str, tuple[Controller, bool]] = {
    "scripted": (ScriptController(), True),
    "random": (Random(), False),
    "mixed": (Mixed(1), True),
    "late": (Mixed(350), True),
    "idle": (ScriptController({"sorter": 0.0}), True),
}
"""Controllers, and whether all the mass arrives under them."""
controlled = pytest.mark.parametrize("name", CONTROLLERS)


def column(env: MultiAgentVectorEnv, state: str) -> Floats:
    """Return an inner state, shape (B,)."""
    values: Floats = env.physical.inner[env.dynamics.inner.names.index(state)]
    return values


def mass(env: MultiAgentVectorEnv, row: str) -> Floats:
    """Return the mass in a row of a batch arc, shape (B,)."""
    values: Floats = env.physical.stock[env.rows.batches][env.rows.batch_names.index(row)]
    return values


@dataclass(frozen=True)
class Recorded:
    """What was seen before the first interval and after each, shape (steps + 1, B); λ and its means, (steps, B)."""

    network: Network
    rows: Mapping[str, Floats]
    circularity: Floats
    mean: Floats

    @property
    def ends(self) -> Floats:
        """Ends of the intervals, shape (steps,)."""
        ends: Floats = np.arange(1.0, len(self.mean) + 1.0) * self.network.episode.control_interval
        return ends


STOCKS = ("reservoir", "sorter", "incinerator")
BOOKS = tuple(f"sorter.{name}" for name in ("sorted_now", "missed_now", "complete_now"))
WAITING = ("truck.packed", "truck.aboard")


def record(env: MultiAgentVectorEnv, controller: Controller, seed: int) -> Recorded:
    """Run an episode; check that at every interval all mass is somewhere."""
    observations = env.reset(seed)
    controller.start(env, seed)
    states, circularity, mean = [env.physical], [], []
    for _ in range(env.network.episode.horizon):
        outcome = env.advance(env.stack(controller.act(observations)))
        observations = env.by_agent(outcome.observation)
        states.append(env.physical)
        circularity.append(outcome.circularity)
        mean.append(outcome.circularity_mean)
    nodes = np.stack([state.stock[: len(STOCKS)] for state in states])
    loads = np.stack([env.dynamics.batches.loads(state.stock) for state in states])
    assert min(state.stock.min() for state in states) >= 0.0
    np.testing.assert_allclose(nodes.sum(axis=1) + loads.sum(axis=1), 2 * BATCH_KG, rtol=1e-14)
    lines = [line.id for line in env.dynamics.batches.lines]
    carried = {line for line, load in zip(lines, loads.max(axis=(0, 2)), strict=True) if load > 0.0}
    assert "first_use" in carried
    assert carried & {"truck", "recycling"}
    names, rows = env.dynamics.inner.names, env.rows.batch_names
    seen = {name: nodes[:, i] for i, name in enumerate(STOCKS)}
    seen |= {name: np.stack([state.inner[names.index(name)] for state in states]) for name in BOOKS}
    seen |= {name: np.stack([state.stock[len(STOCKS) + rows.index(name)] for state in states]) for name in WAITING}
    return Recorded(env.network, seen, np.array(circularity), np.array(mean))


@dataclass(frozen=True)
class Stages:
    """The realised stages of one batch, in intervals from the start; −1 for what did not happen."""

    left: int
    entered: int
    complete: int
    success: float
    trucked: int
    used: int


def first(where: NDArray[np.bool_], after: int) -> int:
    """Return the first interval from ``after`` on at whose end the condition holds, or −1."""
    found = np.flatnonzero(where[after:])
    return after + int(found[0]) if len(found) else -1


def stages(run: Recorded, copy: int) -> list[Stages]:
    """Read the stages of both batches off the reservoir, the robot's books and the truck's load."""
    rows = {name: values[:, copy] for name, values in run.rows.items()}
    dt, recycling = run.network.episode.control_interval, run.network.arcs[run.network.arc_index["recycling"]]
    departures = np.flatnonzero(np.diff(rows["reservoir"]) < 0)
    arrivals = np.flatnonzero(np.diff(rows["sorter"]) > BATCH_KG - 100.0 - 1e-9) + 1
    completions = np.flatnonzero(rows["sorter.complete_now"] > 0)
    results = np.flatnonzero(rows["sorter.sorted_now"] + rows["sorter.missed_now"] > 0)
    assert len(departures) == len(arrivals) == 2
    found = []
    for batch, (left, entered) in enumerate(zip(departures, arrivals, strict=True)):
        items = results[ITEMS * batch : ITEMS * (batch + 1)]
        done = len(items) == ITEMS
        complete = int(items[-1]) if done else -1
        assert not done or complete == completions[batch]
        success = 100.0 * float(rows["sorter.sorted_now"][items].mean()) if done else 0.0
        trucked = -1
        if done and success < 100.0:
            boarded = first(rows["truck.packed"] == 0.0, complete)
            trucked = first(rows["truck.aboard"] == 0.0, boarded) if boarded >= 0 else -1
        used = complete + round(recycling.delay / dt) if done and success > 0.0 else -1
        found.append(Stages(int(left), int(entered), complete, success, trucked, used))
    return found


def staged(found: list[Stages], time: Floats, interval: float) -> Floats:
    """Return the sum over batches of the paper's formula; what did not happen happens after the end of time."""
    total = np.zeros_like(time)
    for batch in found:
        trucked, used = (k * interval if k >= 0 else np.inf for k in (batch.trucked, batch.used))
        total += staged_circularity(
            time,
            mass=BATCH_KG,
            success=batch.success,
            departure=batch.left * interval,
            truck_arrival=trucked,
            use_end=used,
        )
    return total


@pytest.mark.sample(1)
@both
@controlled
def test_circularity_is_the_sum_of_the_stages(scenario: str, name: str) -> None:
    """Mass is conserved, λ(t) is the staged formula for the realised s, T_s and arrivals, and its mean is its mean."""
    controller, arrives = CONTROLLERS[name]
    run = record(MultiAgentVectorEnv("solids_net", num_envs=2, scenario=scenario), controller, 5)
    interval = run.network.episode.control_interval
    for copy in range(2):
        found = stages(run, copy)
        np.testing.assert_allclose(run.circularity[:, copy], staged(found, run.ends, interval), atol=1e-9)
        # λ is constant within an interval, so its mean is that of the formula in the middle of each
        during = staged(found, run.ends - interval / 2, interval)
        np.testing.assert_allclose(run.mean[:, copy], during, atol=1e-9)
        np.testing.assert_allclose(run.mean[:, copy].mean(), during.mean(), rtol=1e-12)
        assert all(batch.entered - batch.left == round(1.0 / interval) for batch in found)
        assert all(ITEMS < batch.complete - batch.entered <= ITEMS * 51 for batch in found)
        assert (run.circularity[-1, copy] == -4 * BATCH_KG) == arrives
    if name in ("mixed", "late"):
        assert {round(batch.success) for copy in range(2) for batch in stages(run, copy)} == {33, 67}
    if name == "late" and scenario == "default":
        assert any(batch.trucked > batch.used > 0 for batch in stages(run, 0)), "the truck was to come after second use"
    if name == "idle":
        assert {batch.success for batch in stages(run, 0)} == {0.0}


def quick(scenario: str, **episode: Any) -> Network:
    """Return the network with uses of a few intervals and attempts of eight, so that the robot works soon."""
    network = load_network("solids_net", scenario=scenario).with_options(episode=episode)
    interval = network.episode.control_interval
    first_use, recycling, truck = network.arcs
    first_use = replace(first_use, delay=2 * interval, batches=((0.0, BATCH_KG), (40 * interval, BATCH_KG)))
    arcs = (first_use, replace(recycling, delay=5 * interval), truck)
    station: Any = network.compartments["sorter"].model
    nodes = tuple(
        replace(node, model=replace(station, attempt_steps=8)) if node.id == "sorter" else node
        for node in network.nodes
    )
    return replace(network, nodes=nodes, arcs=arcs)


def draw(env: MultiAgentVectorEnv, rng: np.random.Generator) -> dict[str, NDArray[np.float32]]:
    """Draw the actions of all copies."""
    return {
        agent: rng.uniform(-1.0, 1.0, (env.num_envs, *space.shape)).astype(np.float32)
        for agent, space in env.action_spaces.items()
    }


AGAIN = """
import pickle, sys
import numpy as np
from cirl_marl import MultiAgentVectorEnv
network, snapshot, actions, states = pickle.load(open(sys.argv[1], "rb"))
env = MultiAgentVectorEnv(network, num_envs=2)
env.restore(snapshot)
for action, state in zip(actions, states, strict=True):
    env.step(action)
    np.testing.assert_array_equal(env.state(), state)
print("the same", len(states))
"""


@pytest.mark.slow
@both
def test_snapshot_in_the_middle_of_an_attempt(scenario: str, tmp_path: Path) -> None:
    """From there all comes again bit for bit, MuJoCo included: here, in a fresh environment, in another process."""
    network = quick(scenario, horizon=70)
    env, rng = MultiAgentVectorEnv(network, num_envs=2), np.random.default_rng(3)
    env.reset(9)
    shown = [env.step(draw(env, rng))[0] for _ in range(16)][-1]
    assert (column(env, "sorter.busy") == 1).all()
    assert (column(env, "sorter.attempt_step") > 2).all()
    snapshot, seen = env.snapshot(), env.state().copy()
    stored = pickle.dumps(snapshot)
    actions = [draw(env, rng) for _ in range(80)]  # over a restart
    first_time = [(*env.step(action)[:2], env.state().copy()) for action in actions]
    assert column(env, "sorter.attempt").max() > 1
    for other, source in ((env, snapshot), (MultiAgentVectorEnv(network, num_envs=2), pickle.loads(stored))):
        same_or_raise(shown, other.restore(source), "observations of the snapshot and after going back")
        np.testing.assert_array_equal(other.state(), seen)
        for action, (observed, rewards, state) in zip(actions, first_time, strict=True):
            again, earned = other.step(action)[:2]
            for agent in env.agents:
                np.testing.assert_array_equal(again[agent], observed[agent])
                np.testing.assert_array_equal(earned[agent], rewards[agent])
            np.testing.assert_array_equal(other.state(), state)
    path = tmp_path / "snapshot.pickle"
    path.write_bytes(pickle.dumps((network, snapshot, actions, [state for *_, state in first_time])))
    done = subprocess.run([sys.executable, "-c", AGAIN, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["the", "same", "80"]


@both
@pytest.mark.sample(1)
def test_views_and_copies_agree(scenario: str) -> None:
    """A batch of three, restarting by itself, is three lone environments, under PettingZoo and under Gymnasium."""
    network = quick(scenario, horizon=30)
    batch = MultiAgentVectorEnv(network, num_envs=3, agents=["sorter"])
    lone = [parallel_env(network, agents=["sorter"]) for _ in range(3)]
    single = [SingleAgentEnv(network, "sorter") for _ in range(3)]
    seen = batch.reset(2)["sorter"]
    for i in range(3):
        np.testing.assert_array_equal(seen[i], lone[i].reset(2 + i)[0]["sorter"])
        np.testing.assert_array_equal(seen[i], single[i].reset(seed=2 + i)[0])
    rng, worked = np.random.default_rng(0), 0
    for step in range(1, 71):
        action = draw(batch, rng)
        observations, rewards, _, truncations, infos = batch.step(action)
        worked += int((rewards["sorter"] != rewards["sorter"][0]).any())
        for i in (2, 0, 1):
            theirs, earned, _, over, info = lone[i].step({"sorter": action["sorter"][i]})
            gym, gained, terminated, truncated, details = single[i].step(action["sorter"][i])
            ended = step % 30 == 0
            mine = infos["sorter"]["final_obs"] if ended else observations["sorter"]
            np.testing.assert_array_equal(mine[i], theirs["sorter"])
            np.testing.assert_array_equal(mine[i], gym)
            assert rewards["sorter"][i] == earned["sorter"] == gained
            assert truncations["sorter"][i] == over["sorter"] == truncated == ended
            assert not terminated
            assert infos["sorter"]["circularity"][i] == info["sorter"]["circularity"] == details["circularity"]
            if ended:
                np.testing.assert_array_equal(observations["sorter"][i], lone[i].reset()[0]["sorter"])
                np.testing.assert_array_equal(observations["sorter"][i], single[i].reset()[0])
            np.testing.assert_array_equal(batch.state()[i], lone[i].state())
    assert scenario == "default" or worked > 20  # Fetch's sparse reward is −1 for all


@both
@pytest.mark.parametrize("reward", REWARDS)
@pytest.mark.sample(4)
def test_reward_mode_does_not_touch_the_physics(scenario: str, reward: str) -> None:
    """Counterfactuals of the difference reward use the same robot; the real one does not notice."""
    network = quick(scenario, horizon=25)
    usual, other = MultiAgentVectorEnv(network, num_envs=2), MultiAgentVectorEnv(network, num_envs=2, reward=reward)
    usual.reset(1)
    other.reset(1)
    rng = np.random.default_rng(1)
    for _ in range(24):
        action = draw(usual, rng)
        usual.step(action)
        other.step(action)
        np.testing.assert_array_equal(usual.state(), other.state())


@pytest.mark.slow
def test_truck_moves_by_its_mass() -> None:
    """Every interval of a trip is m v̇ = F − rolling − drag with m = 3 t and what is aboard, integrated by SciPy."""
    env = MultiAgentVectorEnv("solids_net", num_envs=1, scenario="reacher")
    controller: Controller = ScriptController({"sorter": 0.0})
    observations = env.reset(0)
    controller.start(env, 0)
    loads: list[float] = []
    off: list[float] = []
    for _ in range(env.network.episode.horizon):
        before = [float(column(env, f"truck.{name}")[0]) for name in ("position_m", "speed_m_s")]
        load = float(mass(env, "truck.aboard")[0])
        actions = controller.act(observations)
        force = 12e3 * float(actions["truck"][0, 0])
        observations = env.by_agent(env.advance(env.stack(actions)).observation)
        if load == 0.0 and len(loads) % 7:  # every loaded interval, some of the others
            loads.append(load)
            continue

        def law(_: float, state: Floats, force: float = force, total: float = 3000.0 + load) -> list[float]:
            speed = state[1]
            resistance = 0.01 * total * 9.80665 * np.tanh(speed / 0.05) + 0.5 * 1.2 * 3.0 * speed * abs(speed)
            return [speed, (force - resistance) / total]

        after = solve_ivp(law, (0.0, 0.02), before, rtol=1e-9, atol=1e-12).y[:, -1]
        now = [float(column(env, f"truck.{name}")[0]) for name in ("position_m", "speed_m_s")]
        np.testing.assert_allclose(now, after, atol=2e-5)  # Runge-Kutta where rolling changes sign
        loads.append(load)
        off.append(abs(now[1] - before[1]) * load / 3000.0)
    assert set(loads) == {0.0, BATCH_KG}
    assert max(off) > 1e-3, "without its load the truck would have moved as well"


@pytest.mark.slow
def test_a_loaded_truck_takes_no_more() -> None:
    """While it stands at the sorter with a batch aboard, the next one waits, packed; nothing is lost or mixed."""
    env = MultiAgentVectorEnv("solids_net", num_envs=1, scenario="reacher")
    held: Controller = ScriptController({"sorter": 0.0, "truck": 0.0})
    run = record(env, held, 0)
    assert run.rows["truck.aboard"][-1, 0] == run.rows["truck.packed"][-1, 0] == BATCH_KG
    assert column(env, "truck.destination_m")[0] == 10.0


def test_truck_knows_where_it_is() -> None:
    """It boards only at the sorter without a load and arrives only with one, near enough and slow enough."""
    truck = DeliveryTruck(target_m=10.0, reach_m=0.5, rest_m_s=1.0)
    position = np.array([0.0, -0.5, 0.5, 0.51, 0.0, 0.0, 10.0, 9.5, 9.49, 10.0, 10.0])
    speed = np.array([0.0, 1.0, -1.0, 0.0, 1.01, 0.0, 0.0, -1.0, 0.0, -1.1, 0.0])
    heading = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 10.0, 10.0, 10.0, 10.0, 10.0, 0.0])
    state = np.stack([position, speed, heading])
    np.testing.assert_array_equal(np.flatnonzero(truck.can_board(state)), [0, 1, 2])
    np.testing.assert_array_equal(np.flatnonzero(truck.has_arrived(state)), [6, 7])
    loaded = truck.depart(state, truck.can_board(state))
    np.testing.assert_array_equal(loaded[2], np.where(np.arange(11) < 3, 10.0, heading))
    np.testing.assert_array_equal(truck.turn_back(state, truck.has_arrived(state))[2][6:8], 0.0)
    np.testing.assert_array_equal(state[2], heading)
    expected = -((heading - position) ** 2 + 0.1 * speed**2 + 1e-8 * 3e3**2)
    np.testing.assert_allclose(truck.reward(state, np.full((1, 11), 3e3)), expected, rtol=1e-14)


@both
def test_incinerator_runs_on_its_own_clock(scenario: str) -> None:
    """Its equations are per minute, the network's clock counts seconds: SciPy gives the same after 3 s."""
    env = MultiAgentVectorEnv("solids_net", num_envs=1, scenario=scenario, agents=["incinerator"])
    env.reset(8)
    model: Any = env.network.compartments["incinerator"].model
    rows = env.dynamics.inner.rows["incinerator"]
    begun, steps = env.physical.inner[rows, 0].copy(), round(3.0 / env.network.episode.control_interval)
    for _ in range(steps):
        env.advance(np.full((1, 1), 0.2))
    heat = np.full((1, 1), 1e6 * (0.2 + 1.0) / 2.0)
    minutes = (0.0, 3.0 / 60.0)
    expected = solve_ivp(lambda _, z: model.derivative(z[:, None], heat)[:, 0], minutes, begun, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(env.physical.inner[rows, 0], expected.y[:, -1], rtol=1e-8)
    assert abs(env.physical.inner[rows.start + 5, 0] - begun[5]) > 1.0, "nothing happened"


@both
def test_delivery_cools_and_feeds_the_incinerator(scenario: str) -> None:
    """What the truck brings is added to the waste at 20 °C: the bed keeps its heat, so its temperature falls."""
    env = MultiAgentVectorEnv(quick(scenario, horizon=250), num_envs=1)
    twin = MultiAgentVectorEnv(env.network, num_envs=1)
    controller: Controller = ScriptController({"sorter": 0.0})
    observations = env.reset(0)
    controller.start(env, 0)
    while column(env, "truck.destination_m")[0] == 0.0 or column(env, "truck.position_m")[0] < 9.0:
        observations = env.by_agent(env.advance(env.stack(controller.act(observations))).observation)
    twin.reset(0)
    state = env.snapshot()
    inner = state.state.inner.copy()
    inner[env.dynamics.inner.names.index("truck.position_m")] = 5.0  # in the twin the truck is not there yet
    twin.restore(replace(state, state=replace(state.state, inner=inner)))
    while env.physical.stock[2, 0] == 0.0:
        actions = controller.act(observations)
        observations = env.by_agent(env.advance(env.stack(actions)).observation)
        twin.advance(twin.stack({**actions, "truck": np.full((1, 1), -1.0)}))
    assert twin.physical.stock[2, 0] == 0.0
    assert env.physical.stock[2, 0] == BATCH_KG
    bed = {name: column(env, f"incinerator.{name}")[0] for name in ("waste_kg", "char_kg", "wastebed_degc")}
    without = {name: column(twin, f"incinerator.{name}")[0] for name in bed}
    # twins differ in round-off: receiving nothing rounds the temperature once
    np.testing.assert_allclose(bed["waste_kg"], without["waste_kg"] + BATCH_KG, rtol=1e-12)
    heat = [(b["waste_kg"] + b["char_kg"] + 25.0 * 500.0) * (b["wastebed_degc"] - 20.0) for b in (bed, without)]
    np.testing.assert_allclose(heat[0], heat[1], rtol=1e-12)
    assert without["wastebed_degc"] - bed["wastebed_degc"] > 4.0


@pytest.mark.sample(1)
@pytest.mark.parametrize(("scenario", "copies"), [("default", 8), ("reacher", 20)])
def test_scripted_sorter_succeeds(scenario: str, copies: int) -> None:
    """At least 95 % of the items are sorted: of 48 by Fetch, of 120 by Reacher, from what an agent sees."""
    run = record(
        MultiAgentVectorEnv("solids_net", num_envs=copies, scenario=scenario), ScriptController({"truck": 0.0}), 100
    )
    good, missed = (run.rows[f"sorter.{name}"].sum() for name in ("sorted_now", "missed_now"))
    assert good + missed == 2 * ITEMS * copies
    assert good / (good + missed) >= 0.95


def one_batch(window: int) -> Network:
    """Return the network with one batch and first and second use of 4 s each, over ``window`` intervals."""
    network = load_network("solids_net", scenario="reacher").with_options(episode={"horizon": window})
    first_use, recycling, truck = network.arcs
    first_use = replace(first_use, delay=4.0, batches=((0.0, BATCH_KG),))
    return replace(network, arcs=(first_use, replace(recycling, delay=4.0), truck))


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("controller", "sorted_items"), [(ScriptController({"sorter": 0.0}), 0), (Mixed(0), 1), (ScriptController(), 3)]
)
def test_summary_reports_the_time_window(controller: Controller, sorted_items: int) -> None:
    """It is 2·c·λ̄, and for one batch and a window of its stages the closed form of CIRO7.2."""
    interval, use, after = 0.02, round(4.0 / 0.02), 50
    run = rollout(MultiAgentVectorEnv(one_batch(700), num_envs=1), controller, seed=4)
    held, aboard = run.stock[:, 1], run.load[:, 2]
    entered = int(np.argmax(held > 0.0)) + 1
    empty = int(np.argmax(held[entered:] == 0.0)) + entered + 1
    unsorted_kg = aboard[empty - 1]
    trucked = int(np.argmax(aboard[empty:] == 0.0)) + empty + 1
    success = 100.0 * (1.0 - unsorted_kg / BATCH_KG)
    assert entered == use
    assert round(success * ITEMS / 100.0) == sorted_items

    env = MultiAgentVectorEnv(one_batch(empty + use + after), num_envs=1)
    assert [line.id for line in env.dynamics.batches.lines][2] == "truck"
    run = rollout(env, controller, seed=4)
    found = summary(env, {"neutral": run})["controllers"]["neutral"]["time_window_circularity"]["value"]
    assert found == pytest.approx(2.0 * 0.1 * run.episode_circularity[0], rel=1e-12)
    closed = time_window_circularity(
        [BATCH_KG],
        [0.1],
        success=success,
        use=use * interval,
        sorting_time=(empty - entered) * interval,
        truck=(trucked - empty) * interval,
        incineration=after * interval,
    )
    assert found == pytest.approx(closed, rel=1e-12)


def test_networks_without_criticality_have_no_time_window() -> None:
    """The figure is reported only where the material has a criticality."""
    env = MultiAgentVectorEnv("copper_net", num_envs=1, horizon=2)
    figures = summary(env, {"neutral": rollout(env, Neutral(), seed=0)})
    assert "time_window_circularity" not in figures["controllers"]["neutral"]
    solids = load_network("solids_net")
    assert solids.objective.criticality == 0.1
    assert [arc.law for arc in solids.arcs] == [Law.BATCH] * 3


@pytest.mark.slow
def test_robots_failures_decide_the_coupling() -> None:
    """A robot that stands still loads the truck with everything, leaves nothing in second use, and lowers λ̄."""
    env = MultiAgentVectorEnv("solids_net", num_envs=1)
    controllers = (ScriptController(), ScriptController({"sorter": 0.0}), Constant())
    good, bad, stopped = (rollout(env, controller, seed=0) for controller in controllers)
    truck = [line.id for line in env.dynamics.batches.lines].index("truck")
    assert bad.load[:, truck].max() == BATCH_KG
    np.testing.assert_allclose(bad.episode_service, 0.5)  # no second use, and all that is unsorted is carried away
    assert (good.episode_service > 0.8).all()
    assert (bad.episode_circularity < good.episode_circularity - 50.0).all()
    assert (stopped.episode_circularity > bad.episode_circularity).all()  # a truck that never arrives is best for λ


@pytest.mark.parametrize("scenario", ["default", "reacher"])
@pytest.mark.slow
def test_staying_away_does_not_pay(scenario: str) -> None:
    """A truck that never loads is good for λ, but it owes that nothing piles up, and earns less than one at work."""
    env = MultiAgentVectorEnv("solids_net", num_envs=1, scenario=scenario)
    drives = rollout(env, ScriptController({"sorter": 0.0}), seed=0)
    stays = rollout(env, ScriptController({"sorter": 0.0, "truck": -0.05}), seed=0)
    truck = env.agents.index("truck")
    assert stays.load[-1, 2] > drives.load[-1, 2] == 0.0
    assert stays.episode_circularity[0] > drives.episode_circularity[0]
    assert stays.episode_service[0] < drives.episode_service[0]
    assert stays.returns[truck, 0] < drives.returns[truck, 0]
