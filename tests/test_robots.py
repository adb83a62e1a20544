"""The robots are the libraries' own, as pure functions; the station keeps its books; the scripts do the task."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cirl_marl.compartments import model_class, models
from cirl_marl.compartments.robots import sorting_station
from cirl_marl.compartments.robots.fetch import BIN, Fetch, WasteSorting
from cirl_marl.compartments.robots.reacher import Reacher
from cirl_marl.compartments.robots.sorting_station import BOOKS, SortingStation
from cirl_marl.controllers.scripted import ModelStates, fetch, reacher
from cirl_marl.errors import CirlError
from cirl_marl.network.rowsum import Floats

Robot = Fetch | Reacher
ROBOTS: tuple[Robot, ...] = (Fetch(), Reacher())
ITEM_KG = 100.0


def reference(robot: Robot) -> Any:
    """Return the library's environment of a robot, made by its own id."""
    if isinstance(robot, Reacher):
        return gymnasium.make("Reacher-v5")
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make("FetchPickAndPlace-v4")


def library_start(env: Any, seed: int) -> Floats:
    """Reset the library's environment; return what it shows, with our target."""
    seen, _ = env.reset(seed=seed)
    if isinstance(seen, dict):
        env.unwrapped.goal = np.array(BIN)
        seen["desired_goal"] = np.array(BIN)
    return flat(seen)


def flat(seen: Any) -> Floats:
    """Return an observation of the library as one column."""
    if isinstance(seen, dict):
        seen = np.concatenate([seen[part] for part in ("observation", "achieved_goal", "desired_goal")])
    column: Floats = np.asarray(seen)
    return column


def follow_the_library(robot: Robot, seed: int, policy: Callable[[int, Floats], Floats]) -> Floats:
    """Run an episode of 50 steps in the library and here, compare every bit, and return the last state."""
    env, state = reference(robot), starts(robot, 1, seed)
    begun = library_start(env, seed)
    np.testing.assert_array_equal(state[: len(begun), 0], begun)
    for step in range(50):
        held = policy(step, state)
        seen, reward, *_ = env.step(held[:, 0])
        state = robot.advance(state, held)
        np.testing.assert_array_equal(state[: len(begun), 0], flat(seen))
        assert robot.reward(state, held)[0] == reward
    env.close()
    return state


def starts(robot: Robot | SortingStation, copies: int, first: int = 0) -> Floats:
    """Return starts of seeds ``first``, ``first`` + 1, …, shape (k, copies)."""
    return np.stack([robot.start(np.random.default_rng(first + i)) for i in range(copies)], axis=1)


def actions(robot: Robot | SortingStation, steps: int, copies: int, seed: int = 7) -> Floats:
    """Return random inputs, shape (steps, c, copies)."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, len(robot.input_names), copies))


def roll(robot: Robot, state: Floats, inputs: Floats) -> Floats:
    """Return the state after all the inputs."""
    for held in inputs:
        state = robot.advance(state, held)
    return state


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: str(robot.kind))
class TestRobots:
    """What both robots have in common."""

    @pytest.mark.parametrize("seed", [0, 1, 2])
    def test_is_the_library_bit_for_bit(self, robot: Robot, seed: int) -> None:
        """Equal seeds and actions give equal observations and rewards over an episode of 50 steps."""
        follow_the_library(robot, seed, lambda step, state: actions(robot, 50, 1, seed)[step])

    @pytest.mark.parametrize("seed", [3, 4])
    def test_is_the_library_while_it_works(self, robot: Robot, seed: int) -> None:
        """The same when the script acts: an object that is grasped depends on the solver's warm start as well."""
        script = fetch if isinstance(robot, Fetch) else reacher
        end = follow_the_library(robot, seed, lambda step, state: act(robot, script, state))
        assert robot.success(end, np.zeros((len(robot.input_names), 1))).all()

    def test_start_does_not_remember(self, robot: Robot) -> None:
        """A start is a function of its stream, whatever the engine did before."""
        fresh = starts(robot, 2)
        roll(robot, starts(robot, 1, 50), actions(robot, 10, 1))
        np.testing.assert_array_equal(starts(robot, 2), fresh)
        assert (fresh[:, 0] != fresh[:, 1]).any()

    def test_batch_is_its_columns(self, robot: Robot) -> None:
        """A copy does not notice who else is in the batch, nor in what order."""
        state, inputs = starts(robot, 4), actions(robot, 12, 4)
        together = roll(robot, state, inputs)
        order = np.array([2, 0, 3, 1])
        np.testing.assert_array_equal(roll(robot, state[:, order], inputs[:, :, order]), together[:, order])
        for i in range(4):
            alone = roll(robot, state[:, [i]], inputs[:, :, [i]])
            np.testing.assert_array_equal(alone[:, 0], together[:, i])

    def test_snapshot_and_restore(self, robot: Robot) -> None:
        """A copy of the array in mid-episode is a snapshot: going back repeats the same bits."""
        inputs = actions(robot, 40, 1)
        middle = roll(robot, starts(robot, 1), inputs[:20])
        kept = middle.copy()
        end = roll(robot, middle, inputs[20:])
        other = roll(robot, middle, -inputs[20:])
        assert (other != end).any()
        np.testing.assert_array_equal(roll(robot, kept, inputs[20:]), end)

    def test_advance_leaves_its_arguments_alone(self, robot: Robot) -> None:
        """Pure: nothing is written into, nothing is shared."""
        state, inputs = starts(robot, 2), actions(robot, 1, 2)[0]
        kept = state.copy(), inputs.copy()
        after = robot.advance(state, inputs)
        np.testing.assert_array_equal(state, kept[0])
        np.testing.assert_array_equal(inputs, kept[1])
        assert not np.shares_memory(after, state)

    def test_empty_batch(self, robot: Robot) -> None:
        """No copies are no error."""
        none, held = np.empty((len(robot.state_names), 0)), np.empty((len(robot.input_names), 0))
        assert robot.advance(none, held).shape == none.shape
        assert robot.reward(none, held).shape == robot.success(none, held).shape == (0,)

    def test_names_and_interval(self, robot: Robot) -> None:
        """As many names as rows; what is observed is a part of them; the step is the library's."""
        state = starts(robot, 1)
        assert len(robot.state_names) == len(set(robot.state_names)) == len(state)
        assert set(robot.observed_states) <= set(robot.state_names)
        env = reference(robot)
        assert robot.interval == env.unwrapped.dt
        env.close()


class TestTasks:
    """Rewards and successes."""

    def test_goal_reward_is_the_library_s(self) -> None:
        """For goals of any leading shape, as hindsight needs."""
        rng = np.random.default_rng(0)
        achieved = np.array(BIN) + rng.uniform(-0.06, 0.06, (5, 4, 3))
        desired = np.broadcast_to(np.array(BIN), achieved.shape)
        found = Fetch().goal_reward(achieved, desired)
        np.testing.assert_array_equal(found, WasteSorting().compute_reward(achieved, desired, {}))
        assert found.shape == (5, 4)
        assert set(np.unique(found)) == {-1.0, 0.0}

    def test_no_item_starts_in_the_bin(self) -> None:
        """The target is out of the range in which objects appear, so nothing is sorted by doing nothing."""
        state = starts(Fetch(), 40)
        assert not Fetch().success(state, np.zeros((4, 40))).any()
        robot = Fetch.engine().env
        centre, reach = robot.initial_gripper_xpos[:2, None], robot.obj_range
        offset = np.abs(state[3:5] - centre)
        assert 0.8 * reach < offset.max() <= reach
        gap = np.maximum(np.abs(np.array(BIN)[:2, None] - centre) - reach, 0.0)
        assert np.linalg.norm(gap) > robot.distance_threshold, "an object could appear within a success of the target"
        assert 1.05 + 0.05 < BIN[0] < 1.55 - 0.05
        assert 0.4 + 0.05 < BIN[1] < 1.1 - 0.05

    def test_reacher_must_be_near_and_at_rest(self) -> None:
        """Both conditions, both joints, with the limits themselves outside; speeds do not count."""
        below = np.nextafter(0.04, 0.0), np.nextafter(0.005, 0.0)
        state = np.full((len(Reacher().state_names), 6), 9.0)
        state[Reacher().state_names.index("distance_m")] = below[0], 0.04, 0.0401, 0.0, 0.0, 0.0
        inputs = np.zeros((2, 6))
        inputs[:, 0], inputs[0, 3], inputs[1, 4], inputs[:, 5] = (below[1], -below[1]), 0.005, -0.005, 0.0
        np.testing.assert_array_equal(Reacher().success(state, inputs), [True, False, False, False, False, True])

    @pytest.mark.medium
    def test_random_torques_succeed_only_where_signed(self) -> None:
        """Torques as of an untrained policy: had they to be below 0.005 with their signs, a quarter would do."""
        robot, rng = Reacher(), np.random.default_rng(0)
        state, done, signed = starts(robot, 250, 0), np.zeros(250, dtype=bool), np.zeros(250, dtype=bool)
        for _ in range(50):
            inputs = np.clip(rng.standard_normal((2, 250)), -1.0, 1.0)
            state = robot.advance(state, inputs)
            done |= robot.success(state, inputs)
            signed |= (state[robot.state_names.index("distance_m")] < 0.04) & (inputs < 0.005).all(axis=0)
        assert done.mean() < 0.01
        assert 0.18 < signed.mean() < 0.32

    def test_reacher_success_by_kinematics(self) -> None:
        """The tip is where the joint angles put it: arms of 0.1 and 0.11 m; its distance decides, not the library's."""
        robot = Reacher()
        rows = {name: i for i, name in enumerate(robot.state_names)}
        state, found = starts(robot, 30, 100), []
        rng = np.random.default_rng(0)
        for _ in range(40):
            inputs = act(robot, reacher, state) + rng.choice([0.0, 0.004, -0.006], (2, 30))
            state = robot.advance(state, inputs)
            first = np.arctan2(state[rows["sin_0"]], state[rows["cos_0"]])
            both = first + np.arctan2(state[rows["sin_1"]], state[rows["cos_1"]])
            tip = 0.1 * np.array([np.cos(first), np.sin(first)]) + 0.11 * np.array([np.cos(both), np.sin(both)])
            distance = np.hypot(*(tip - state[[rows["target_x_m"], rows["target_y_m"]]]))
            # MuJoCo's bodies are where the last Runge-Kutta stage had the joints: up to 0.3 mm off where a joint ends
            np.testing.assert_allclose(state[rows["distance_m"]], distance, atol=1e-3)
            expected = (distance < 0.04) & (np.abs(inputs).max(axis=0) < 0.005)
            clear = np.abs(distance - 0.04) > 1e-3
            np.testing.assert_array_equal(robot.success(state, inputs)[clear], expected[clear])
            found.append(expected)
        assert 0.01 < np.mean(found) < 0.99

    @pytest.mark.slow
    @pytest.mark.parametrize(("robot", "script", "copies"), [(Fetch(), fetch, 100), (Reacher(), reacher, 100)])
    def test_scripts_do_the_task(self, robot: Robot, script: Callable[[ModelStates], Floats], copies: int) -> None:
        """Within 50 steps, in at least 95 of 100 attempts."""
        state, done = starts(robot, copies, 1000), np.zeros(copies, dtype=bool)
        for _ in range(50):
            inputs = act(robot, script, state)
            state = robot.advance(state, inputs)
            done |= robot.success(state, inputs)
        assert done.mean() >= 0.95

    @pytest.mark.slow
    def test_the_fetch_script_is_fast(self) -> None:
        """It earns about as much as the best learner of the paper, −11.45, which may have met another target."""
        state, earned = starts(Fetch(), 60, 3000), np.zeros(60)
        for _ in range(50):
            inputs = act(Fetch(), fetch, state)
            state = Fetch().advance(state, inputs)
            earned += Fetch().reward(state, inputs)
        assert -12.5 < earned.mean() < -10.0


def act(robot: Robot, script: Callable[[ModelStates], Floats], state: Floats) -> Floats:
    """Return the script's inputs, from what the robot's agent sees."""
    rows = [robot.state_names.index(name) for name in robot.observed_states]
    inputs: Floats = np.clip(script(dict(zip(robot.observed_states, state[rows], strict=True))), -1.0, 1.0)
    return inputs


@dataclass
class Books:
    """The rules of the station once more, for one copy, in plain Python."""

    robot: Reacher
    key: int
    column: Floats
    busy: bool = False
    step: int = 0
    done: int = 0
    attempt: int = 0
    now: tuple[bool, bool, bool] = field(default=(False, False, False))
    reward: float = 0.0

    def advance(self, inputs: Floats, stock_kg: float, items: int, steps: int) -> None:
        """Move one interval."""
        self.now, self.reward = (False, False, False), 0.0
        if not self.busy:
            self.step = 0
            if stock_kg >= ITEM_KG * (1 - 1e-9):
                self.column = self.robot.start(np.random.default_rng([self.key, self.attempt]))
                self.attempt, self.busy = self.attempt + 1, True
            return
        self.column = self.robot.advance(self.column[:, None], inputs[:, None])[:, 0]
        self.step += 1
        self.reward = float(self.robot.reward(self.column[:, None], inputs[:, None])[0])
        good = bool(self.robot.success(self.column[:, None], inputs[:, None])[0])
        missed = not good and self.step == steps
        if good or missed:
            self.busy, self.done = False, self.done + 1
        self.now = good, missed, self.done == items
        self.done %= items


class TestSortingStation:
    """One item after another."""

    @settings(max_examples=15)
    @given(
        seed=st.integers(0, 2**31),
        items=st.integers(1, 3),
        steps=st.integers(1, 5),
        stocks=st.lists(st.sampled_from([0.0, 99.999, ITEM_KG * (1 - 1e-12), 250.0]), min_size=1, max_size=30),
    )
    def test_books(self, seed: int, items: int, steps: int, stocks: list[float]) -> None:
        """Whatever the stock does, the station is its rules, bit for bit, in every copy and every row."""
        easy = Reacher(reach_m=0.15, torque_n_m=0.6)  # often done at random, so that both ends of an attempt occur
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(sorting_station.ROBOTS, "reacher", easy)
            station = SortingStation(form="reacher", items_per_batch=items, attempt_steps=steps, item_kg=ITEM_KG)
            state = starts(station, 2, seed)
            books = [Books(easy, int(state[BOOKS.index("key"), i]), state[len(BOOKS) :, i]) for i in range(2)]
            rng = np.random.default_rng(seed)
            for stock in stocks:
                stock_kg, inputs = np.array([stock, 100.0]), rng.uniform(-1.0, 1.0, (2, 2))
                state = station.advance(state, inputs, stock_kg=stock_kg)
                for i, own in enumerate(books):
                    own.advance(inputs[:, i], stock_kg[i], items, steps)
                    ledger = own.busy, own.step, own.done, *own.now, own.key, own.attempt
                    np.testing.assert_array_equal(state[: len(BOOKS), i], ledger)
                    np.testing.assert_array_equal(state[len(BOOKS) :, i], own.column)
                np.testing.assert_array_equal(station.reward(state, inputs), [own.reward for own in books])
                np.testing.assert_array_equal(station.released_units(state).T, [own.now[:2] for own in books])
                np.testing.assert_array_equal(station.complete(state), [own.now[2] for own in books])

    def test_sorts_a_batch(self) -> None:
        """With the script every item of a batch of 3 is sorted; without an action every one is missed."""
        for script, ports in ((fetch, [3, 0]), (lambda seen: np.zeros((4, 1)), [0, 3])):
            station = SortingStation(items_per_batch=3, attempt_steps=30)
            state, released, completed = starts(station, 1, 5), np.zeros((2, 1)), 0
            for _ in range(3 * 31):
                inputs = act(Fetch(), script, state[len(BOOKS) :])
                stock_kg = 300.0 - 100.0 * released.sum(axis=0)
                state = station.advance(state, inputs, stock_kg=stock_kg)
                released += station.released_units(state)
                completed += int(station.complete(state)[0])
            np.testing.assert_array_equal(released[:, 0], ports)
            assert completed == 1
            assert state[BOOKS.index("busy"), 0] == 0.0

    def test_items_depend_on_the_key_only(self) -> None:
        """What is done with one item does not change the next; another key gives others; presenting ignores actions."""
        station = SortingStation(form="reacher", attempt_steps=3)
        state = np.repeat(starts(station, 1), 3, axis=1)
        state[BOOKS.index("key"), 2] += 1
        rng, presented = np.random.default_rng(0), 0
        for _ in range(12):
            was_idle = state[BOOKS.index("busy"), 0] == 0
            state = station.advance(state, rng.uniform(-1, 1, (2, 3)), stock_kg=np.full(3, 1e3))
            if was_idle:
                presented += 1
                np.testing.assert_array_equal(state[:, 0], state[:, 1])
                assert (state[len(BOOKS) :, 0] != state[len(BOOKS) :, 2]).any()
        assert presented == 3

    def test_names_follow_the_form(self) -> None:
        """State, inputs, observation and interval are the robot's, with the books."""
        for robot in ROBOTS:
            station = SortingStation(form=robot.kind)  # type: ignore[arg-type]
            assert station.state_names == (*BOOKS, *robot.state_names)
            assert station.observed_states == ("busy", *robot.observed_states)
            assert (station.input_names, station.interval) == (robot.input_names, robot.interval)
            assert len(station.ports) == len(station.released_units(starts(station, 1)))

    @pytest.mark.parametrize(
        ("given_", "message"),
        [
            ({"form": "fetcher"}, "Did you mean 'fetch'"),
            ({"items_per_batch": 0}, "items_per_batch = 0"),
            ({"attempt_steps": 2.5}, r"attempt_steps = 2\.5"),
            ({"item_kg": 0.0}, r"item_kg 0\.0"),
        ],
    )
    def test_errors(self, given_: dict[str, Any], message: str) -> None:
        """What has no meaning is refused by name."""
        with pytest.raises(CirlError, match=message):
            SortingStation(**given_)


class TestThreads:
    """Environments in threads are those of a single thread: each has a simulator of its own."""

    @pytest.mark.medium
    @pytest.mark.parametrize("id_", ["cirl_marl/Reacher-v0", "cirl_marl/FetchWasteSorting-v0"])
    def test_threads_do_not_meet(self, id_: str) -> None:
        """MuJoCo lets other threads run while it steps; no state is lost to them."""

        def play(seed: int) -> float:
            env = gymnasium.make(id_)
            env.reset(seed=seed)
            env.action_space.seed(seed)
            steps = [env.step(env.action_space.sample()) for _ in range(40)]
            return float(sum(abs(step[-1]["state"]).sum() for step in steps))

        alone = [play(seed) for seed in range(4)]
        with ThreadPoolExecutor(4) as pool:
            assert list(pool.map(play, range(4))) == alone


class TestRegistry:
    """Robots are found, and nobody else pays for them."""

    def test_robots_are_found(self) -> None:
        """By the registry, each by its kind."""
        assert {"fetch", "reacher", "sorting_station"} <= set(models())
        assert model_class("fetch") is Fetch
        with pytest.raises(CirlError, match="Did you mean 'reacher'"):
            model_class("reachers")

    def test_models_are_pickled_without_an_engine(self) -> None:
        """A model is its parameters, also after it has been used."""
        for model in (*ROBOTS, SortingStation()):
            model.start(np.random.default_rng(0))
            packed = pickle.dumps(model)
            assert len(packed) < 500
            assert pickle.loads(packed) == model
