"""Controllers by the names that the command line and comparisons know them by."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Constant, Controller, Neutral, Random
from cirl_marl.controllers.lqr import LQR
from cirl_marl.controllers.scripted import ScriptController
from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.network.elements import CIRCULARITY, is_of_circularity
from cirl_marl.optimum.options import check_margin

if TYPE_CHECKING:
    from cirl_marl.optimum.aims import Aim
    from cirl_marl.optimum.draws import Prices

SETTABLE = ("constant", "scripted")
"""Controllers that take values for single agents."""
BLIND = ("best_constant", "best_schedule")
"""Controllers that do not look."""
UNCERTAIN = ("scenario_mpc", *BLIND, "price_policy")
"""Controllers for networks in which something is drawn."""
CONTROLLERS = ("neutral", "constant", "random", "scripted", "lqr", "mpc", "optimum", *UNCERTAIN)
PLANNERS = ("mpc", "optimum", *UNCERTAIN)
"""Controllers that plan for a demanded service."""
WITH_AIMS = ("mpc", "scenario_mpc", "optimum")
"""Controllers that plan for other aims than λ̄, and keep budgets."""
TUNABLE = ("scripted", "mpc", *UNCERTAIN)
"""Controllers with a margin on what they aim at."""
FUTURES = 4
"""That ``scenario_mpc`` plans for, unless another number is asked for."""


def named_controller(
    name: str,
    *,
    constants: Mapping[str, float] | None = None,
    min_service: ArrayLike | None = None,
    smooth: bool | None = False,
    gap: float | None = None,
    margin: ArrayLike = 1.0,
    budget_margin: float = 1.0,
    futures: int | None = None,
    prices: Prices | None = None,
    aim: Aim = CIRCULARITY,
    at_most: Mapping[str, float] | None = None,
) -> Controller:
    """Return a controller, not yet started.

    Args:
        name: one of CONTROLLERS.
        constants: agent → constant value in [−1, 1], of a constant or scripted controller.
        min_service: mean level of every service, or of each, shape (services,), that PLANNERS plan for; None: as much
            as can be had.
        smooth: whether the plans of ``optimum`` are to change little; see ``Optimum``.
        gap: that its plans may have to the bound; see ``Optimum``.
        margin: by what those of TUNABLE multiply what they aim at, or divide what may lack; of every service, or of
            each, shape (services,).
        budget_margin: by what ``mpc`` and ``scenario_mpc`` multiply what budgets of a disturbed episode cost.
        futures: that ``scenario_mpc`` plans for; None: FUTURES.
        prices: of a bound for who does not foresee, which ``price_policy`` needs.
        aim: of WITH_AIMS: what is aimed at beside a demanded service; see ``bound``.
        at_most: their budgets, likewise.

    Raises:
        CirlError: for an unknown name, or options that the controller does not take.
    """
    if name not in CONTROLLERS:
        raise CirlError(unknown_name("control", name, CONTROLLERS))
    if constants and name not in SETTABLE:
        raise CirlError(f"values of single agents go with {' or '.join(SETTABLE)} control, not with {name}")
    if min_service is not None and name not in PLANNERS:
        raise CirlError(f"a demanded service level goes with {', '.join(PLANNERS)} control, not with {name}")
    check_margin(margin)
    if np.any(np.asarray(margin) != 1.0) and name not in TUNABLE:
        raise CirlError(f"a margin goes with {', '.join(TUNABLE)} control, not with {name}")
    if futures is not None and name != "scenario_mpc":
        raise CirlError(f"futures go with scenario_mpc control, not with {name}")
    if budget_margin != 1.0 and (not at_most or name not in TUNABLE):
        raise CirlError(f"budget_margin {budget_margin:g} goes with at_most and mpc or scenario_mpc control")
    has_aim = not is_of_circularity(aim)
    if (has_aim or at_most) and name not in WITH_AIMS:
        raise CirlError(f"an aim and budgets of accounts go with {', '.join(WITH_AIMS)} control, not with {name}")
    if has_aim and min_service is None:
        raise CirlError(f"aim {aim!r}: say which service is demanded beside it, as min_service, or it is least at none")
    if gap is not None and name != "optimum":
        raise CirlError(f"a gap to the bound goes with optimum control, not with {name}")
    if name == "optimum":
        from cirl_marl.optimum.mpc import SERVICE_FIRST
        from cirl_marl.optimum.open_loop import Optimum

        weight = SERVICE_FIRST if min_service is None else None
        options: dict[str, Any] = {"min_service": min_service, "service_weight": weight, "smooth": smooth}
        return Optimum(aim=aim, at_most=at_most, gap=gap, **options)
    if name in PLANNERS:
        return _planner(
            name, min_service, margin, futures, prices, {"aim": aim, "at_most": at_most, "budget_margin": budget_margin}
        )
    makers: Mapping[str, Callable[[], Controller]] = {
        "neutral": Neutral,
        "constant": lambda: Constant(constants),
        "random": Random,
        "scripted": lambda: ScriptController(constants, margin=margin),
        "lqr": LQR,
    }
    return makers[name]()


def controllers_by_margin(name: str, **options: Any) -> Callable[..., Controller]:
    """Return what makes a controller with a ``margin``; see ``named_controller``, which takes the other ``options``.

    Blind ones, which take long to be found, begin with what others of them found.
    """
    first = named_controller(name, **options)
    if name in BLIND:
        from cirl_marl.optimum.blind import BestConstant

        assert isinstance(first, BestConstant)
        return lambda margin=1.0: first.with_margin(margin)
    return partial(named_controller, name, **options)


def _planner(
    name: str,
    min_service: ArrayLike | None,
    margin: ArrayLike,
    futures: int | None,
    prices: Prices | None,
    aims: Mapping[str, Any],
) -> Controller:
    """Return one of PLANNERS, whose solvers are loaded by those who ask for them."""
    from cirl_marl.optimum.blind import BestConstant, BestSchedule
    from cirl_marl.optimum.mpc import MPC, SERVICE_FIRST

    demand: dict[str, Any] = {
        "min_service": min_service,
        "service_weight": SERVICE_FIRST if min_service is None else None,
    }
    demand["margin"] = margin
    if name == "price_policy":
        if prices is None:
            raise CirlError("price_policy control needs the prices of bound(…, uncertain=True), which compare takes")
        return MPC(prices=prices, **demand)
    if name == "scenario_mpc":
        return MPC(futures=FUTURES if futures is None else futures, **aims, **demand)
    blind = dict(zip(BLIND, (BestConstant, BestSchedule), strict=True))
    return blind[name](**demand) if name in blind else MPC(**aims, **demand)
