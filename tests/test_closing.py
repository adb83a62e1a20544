"""A plan and a bound within a gap of each other: which programs are solved for it, and when it stops."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cirl_marl import CirlError, load_network, plan
from cirl_marl.optimum import Bound, bound, close_gap, closing, improve, improve_plan, simulate_plan
from cirl_marl.optimum.slopes import jacobians


@pytest.fixture
def degrees(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the degrees of the bounds that will have been solved for."""
    tried = list[int]()

    def seen(*network: Any, degree: int, **options: Any) -> Bound:
        tried.append(degree)
        solution: Bound = bound(*network, degree=degree, **options)
        near = options.get("near")
        # what the network can reach is found once
        assert solution.problem.system is (near or solution).problem.system
        assert (near is None) == (len(tried) == 1)
        return solution

    monkeypatch.setattr(closing, "bound", seen)
    return tried


SHORT = load_network("copper_net").with_options(episode={"horizon": 12})
"""Its best plan is 0.9 % from the bound of degree 1, 0.5 % from that of degree 2."""
EMPTYING = 1.0
"""Action of everybody that leaves 75 % of the service."""


@pytest.mark.parametrize(("within", "tried"), [(0.01, [1]), (0.006, [1, 2])])
def test_as_many_programs_as_the_gap_asks_for(degrees: list[int], within: float, tried: list[int]) -> None:
    """The plan is an episode that keeps the service, and the bound is the one of the last degree, with a proof."""
    found = close_gap(SHORT, within=within, min_service=0.95)
    assert degrees == tried
    assert found.bound.objective == bound(SHORT, min_service=0.95, degree=tried[-1], tight=True).objective
    assert found.bound.objective == found.bound.verify().bound
    run = simulate_plan(found.bound)
    assert run.episode_levels.min() >= 0.95 - improve.TOLERATED_SHORTFALL
    assert 0.0 <= found.gap <= within
    assert found.gap == float(found.bound.gap(run.episode_circularity)[0])


def test_a_plan_is_proved_as_far_as_is_asked(degrees: list[int]) -> None:
    """``plan`` with a gap goes on to a tighter bound, and says how far the episode that it shows is from it."""
    found = plan(SHORT, "optimum", min_service=0.95, smooth=False, gap=0.006)
    assert degrees == [1, 2]
    assert float(found.proof.split("gap ")[1].rstrip("%")) <= 0.6
    assert found.rollout.episode_levels.min() >= 0.95 - improve.TOLERATED_SHORTFALL


def test_no_time_is_time_for_the_first_bound(degrees: list[int]) -> None:
    """Nothing is begun that cannot be had in the time left, neither a step nor a further degree."""
    found = close_gap(SHORT, within=1e-4, seconds=0.0, min_service=0.95)
    assert degrees == [1]
    np.testing.assert_array_equal(found.bound.actions, bound(SHORT, min_service=0.95, degree=1, tight=True).actions)
    assert found.gap > 0.006


@pytest.mark.parametrize(
    ("pieces", "seconds", "begun"),
    [
        (2, 56.0, [1]),
        (2, 57.0, [1, 2]),
        (2, 70.0, [1, 2]),
        (2, 71.0, [1, 2, 3]),
        (1, 127.0, [1, 2]),
        (1, 128.0, [1, 2, 3]),
    ],
)
def test_a_bound_is_begun_if_it_can_be_had_in_time(
    pieces: int, seconds: float, begun: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each takes 20 s; the next one 1.8 or 1.5 times as long, by 3/2 or 4/3 of the moments, 4.4 if a piece is added."""
    degrees = list[int]()
    monkeypatch.setattr(time, "process_time", lambda: 20.0 * len(degrees))

    def timed(*network: Any, degree: int, **options: Any) -> Bound:
        solution: Bound = bound(*network, degree=1, **options)
        layout = copy(solution.problem.layout)
        layout.pieces, layout.moments = pieces, range(pieces * (degree + 1))
        degrees.append(degree)
        return replace(solution, problem=replace(solution.problem, layout=layout))

    monkeypatch.setattr(closing, "bound", timed)
    monkeypatch.setattr(closing, "improve_plan", lambda solution, **options: solution)
    monkeypatch.setattr(closing, "_gap", lambda solution, run: 1.0)
    close_gap(SHORT, seconds=seconds, degrees=(1, 2, 3), min_service=0.95)
    assert degrees == begun


def test_a_solver_that_fails_takes_nothing_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the first degree it is an error, at a later one the end."""

    def failing(*network: Any, degree: int, **options: Any) -> Bound:
        if degree in fails:
            raise CirlError(f"degree {degree}")
        solution: Bound = bound(*network, degree=degree, **options)
        return solution

    monkeypatch.setattr(closing, "bound", failing)
    fails = {2}
    assert close_gap(SHORT, min_service=0.95).bound.degree == 1
    fails = {1}
    with pytest.raises(CirlError, match="degree 1"):
        close_gap(SHORT, min_service=0.95)


def test_plans_are_made_again_while_one_is_short(degrees: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan without a gap, as it is short, waits for the next bound, and every plan goes on from where it was."""
    made = list[int]()

    def short(found: Bound, **options: Any) -> Bound:
        made.append(found.degree)
        if found.degree > 1:
            np.testing.assert_array_equal(found.actions, last[-1].actions)
            last.append(improve_plan(found, **options))
            return last[-1]
        last.append(replace(found, actions=0.0 * found.actions + EMPTYING))
        return last[-1]

    last = list[Bound]()
    monkeypatch.setattr(closing, "improve_plan", short)
    found = close_gap(SHORT, within=1e-4, degrees=(1, 2, 3), min_service=0.95)
    assert degrees == made == [1, 2, 3]
    assert found.gap < 0.01
    degrees.clear()
    assert math.isnan(close_gap(SHORT, degrees=(1,), min_service=0.95).gap)


def test_a_plan_that_gets_hardly_nearer_waits_for_a_tighter_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three steps have to make a quarter of what is still too much, unless no further bound will be proved."""
    answers = list[list[bool]]()

    def steps(found: Bound, *, enough: Callable[[Any], bool], **options: Any) -> Bound:
        answers.append([enough(value) for value in (0.9, 0.5, 0.4, 0.39, 0.39, 0.38, 0.1)])
        return found

    monkeypatch.setattr(closing, "improve_plan", steps)
    monkeypatch.setattr(closing, "_gap", lambda solution, run: run if isinstance(run, float) else 0.9)
    close_gap(SHORT, within=0.1, degrees=(1, 2), min_service=0.95)
    assert answers == [[False] * 5 + [True, True], [False] * 6 + [True]]


def test_steps_that_promise_little_are_not_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """But while a service is short any gain is worth a step."""
    solved = list[None]()

    def counted(*arguments: Any, is_wide: bool) -> Any:
        solved.append(None)
        return jacobians(*arguments, is_wide=is_wide)

    monkeypatch.setattr(improve, "jacobians", counted)
    found, counts = bound(SHORT, min_service=0.95, degree=1), list[int]()
    found = replace(found, actions=0.0 * found.actions + EMPTYING)
    for least in (improve.NO_PROMISE, 1.0):
        solved.clear()
        run = simulate_plan(improve_plan(found, rounds=5, least_gain=least))
        assert run.episode_levels.min() >= 0.95 - improve.TOLERATED_SHORTFALL
        counts.append(len(solved))
    assert 1 < counts[1] < counts[0]


@pytest.mark.parametrize(("options", "message"), [({"within": 0.0}, "within 0.0"), ({"degrees": ()}, "degrees")])
def test_what_cannot_be_asked(options: dict[str, Any], message: str) -> None:
    """A gap is positive, and some program has to be solved."""
    with pytest.raises(CirlError, match=message):
        close_gap(SHORT, **options)


@pytest.mark.parametrize(
    ("control", "demanded", "solver", "gap", "message"),
    [
        ("mpc", 0.9, "exact", 0.01, "--gap 0.01 goes with --control optimum and --min-service"),
        ("optimum", None, "exact", 0.01, "--gap 0.01 goes with --control optimum and --min-service"),
        ("optimum", 0.9, "exact", 0.0, "gap 0.0 must be positive"),
        ("optimum", 0.9, "rk4", 0.01, "no bound is proved: solver 'rk4'"),
    ],
)
def test_a_gap_to_what_there_is_no_bound_of(
    control: str, demanded: float | None, solver: str, gap: float, message: str
) -> None:
    """Only plans of ``optimum`` for a demanded service have one, where something can be proved."""
    step = SHORT.episode.control_interval / 100 if solver == "rk4" else None
    network = SHORT.with_options(episode={"solver": solver, "solver_step": step})
    with pytest.raises(CirlError, match=message):
        plan(network, control, min_service=demanded, gap=gap)
