"""A station at which a robot sorts one item after another."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from cirl_marl.compartments.robots.fetch import Fetch
from cirl_marl.compartments.robots.reacher import Reacher
from cirl_marl.errors import CirlError
from cirl_marl.network.compartment_model import DiscreteTimeModel, ReleasingModel, RewardState
from cirl_marl.network.declarations import Positive, Quantity, Word, frozen_record
from cirl_marl.network.rowsum import Floats

ROBOTS: dict[str, Fetch | Reacher] = {"fetch": Fetch(), "reacher": Reacher()}
BOOKS = ("busy", "attempt_step", "done_in_batch", "sorted_now", "missed_now", "complete_now", "key", "attempt")
BUSY, STEP, DONE, SORTED_ITEMS, MISSED_ITEMS, COMPLETE, KEY, ATTEMPT = range(len(BOOKS))


@frozen_record
class SortingStation(DiscreteTimeModel, ReleasingModel):
    """A robot makes one attempt at each item; what it does not finish in time is missed.

    While the node holds an item and the robot is free, one control interval presents the item: the robot takes the
    start of a new attempt and the action of that interval has no effect. An attempt ends when the robot's task is done
    (the item is sorted) or after ``attempt_steps`` (missed); a batch is complete after ``items_per_batch`` attempts.
    Nothing moves while there is no item. The start of attempt n is drawn from a stream of its own, (key, n) with a
    key drawn at the start of the episode, so the next state is a function of the state alone.

    Reward: the robot's while it works, else 0.
    """

    kind: ClassVar[str] = "sorting_station"
    input_unit: ClassVar[str] = "1"
    time_unit: ClassVar[str] = "s"
    reward_state: ClassVar[RewardState] = "after"
    context_names: ClassVar[tuple[str, ...]] = ("stock_kg",)
    ports: ClassVar[tuple[str, ...]] = ("sorted", "unsorted")

    form: Annotated[Literal["fetch", "reacher"], Word("the robot", of=("fetch", "reacher"))] = "fetch"
    items_per_batch: Annotated[float, Quantity("items of a batch")] = 4
    item_kg: Annotated[float, Positive("mass of an item")] = 100.0
    attempt_steps: Annotated[float, Quantity("control intervals of an attempt")] = 50

    @property
    def unit_kg(self) -> float:
        """Mass of what is released at a time."""
        return self.item_kg

    @property
    def batch_kg(self) -> float:
        """Mass of a batch."""
        return self.items_per_batch * self.item_kg

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        DiscreteTimeModel.__post_init__(self)
        for name in ("items_per_batch", "attempt_steps"):
            value = getattr(self, name)
            if not (float(value).is_integer() and value >= 1):
                raise CirlError(f"{self.kind}: {name} = {value!r}, but it must be a whole number of at least 1.")

    @property
    def robot(self) -> Fetch | Reacher:
        """The robot's own model."""
        return ROBOTS[self.form]

    @property
    def state_names(self) -> tuple[str, ...]:
        """Bookkeeping, then the robot's states."""
        return (*BOOKS, *self.robot.state_names)

    @property
    def input_names(self) -> tuple[str, ...]:
        """The robot's inputs."""
        return self.robot.input_names

    @property
    def observed_states(self) -> tuple[str, ...]:
        """Whether the robot works, and what it sees."""
        return ("busy", *self.robot.observed_states)

    @property
    def interval(self) -> float:
        """The robot's control interval, s."""
        return self.robot.interval

    def start(self, stream: np.random.Generator) -> Floats:
        """Return an idle station with a random key, the robot at the start of an attempt, shape (k,)."""
        robot = self.robot.start(stream)
        books = np.zeros(len(BOOKS))
        books[KEY] = stream.integers(2**32)
        return np.concatenate([books, robot])

    def advance(self, state: Floats, inputs: Floats, *, stock_kg: Floats) -> Floats:
        """Return the state one interval later, shape (k, B); ``stock_kg`` is what the node holds, shape (B,)."""
        after = state.copy()
        books = after[: len(BOOKS)]
        busy = books[BUSY] > 0
        new_item = ~busy & (stock_kg >= self.item_kg * (1.0 - 1e-9))
        books[[SORTED_ITEMS, MISSED_ITEMS, COMPLETE]] = 0.0
        for i in np.flatnonzero(new_item):
            stream = np.random.default_rng([int(books[KEY, i]), int(books[ATTEMPT, i])])
            after[len(BOOKS) :, i] = self.robot.start(stream)
        columns = np.flatnonzero(busy)
        robot_state = self.robot.advance(state[len(BOOKS) :, columns], inputs[:, columns])
        after[len(BOOKS) :, columns] = robot_state
        is_success = np.zeros_like(busy)
        is_success[columns] = self.robot.success(robot_state, inputs[:, columns])
        books[STEP] = np.where(busy, books[STEP] + 1.0, 0.0)
        is_missed = busy & ~is_success & (books[STEP] >= self.attempt_steps)
        is_over = is_success | is_missed
        done = books[DONE] + is_over
        complete = is_over & (done >= self.items_per_batch)
        books[SORTED_ITEMS], books[MISSED_ITEMS], books[COMPLETE] = is_success, is_missed, complete
        books[DONE] = np.where(complete, 0.0, done)
        books[ATTEMPT] += new_item
        books[BUSY] = (busy & ~is_over) | new_item
        return after

    def released_units(self, state: Floats) -> Floats:
        """Return the items sorted and missed in the last interval, shape (2, B)."""
        return state[[SORTED_ITEMS, MISSED_ITEMS]]

    def complete(self, state: Floats) -> NDArray[np.bool_]:
        """Return where the last interval completed a batch, shape (B,)."""
        complete: NDArray[np.bool_] = state[COMPLETE] > 0
        return complete

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return the robot's reward where it worked in the last interval, else 0, shape (B,)."""
        was_busy = state[STEP] > 0
        return np.where(was_busy, self.robot.reward(state[len(BOOKS) :], inputs), 0.0)
