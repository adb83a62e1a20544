"""Controllers by the names that the command line and comparisons know them by."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Constant, Controller, Neutral, Random
from cirl_marl.controllers.lqr import LQR
from cirl_marl.controllers.scripted import ScriptController
from cirl_marl.errors import CirlError, unknown_name

SETTABLE = ("constant", "scripted")
"""Controllers that take values for single agents."""
CONTROLLERS = ("neutral", "constant", "random", "scripted", "lqr", "mpc", "optimum")


def named_controller(
    name: str,
    *,
    constants: Mapping[str, float] | None = None,
    min_service: ArrayLike | None = None,
    smooth: bool | None = False,
) -> Controller:
    """Return a controller, not yet started.

    Args:
        name: one of CONTROLLERS.
        constants: agent → constant value in [−1, 1], of a constant or scripted controller.
        min_service: mean level of every service, or of each, shape (services,), that ``mpc`` and ``optimum`` plan for;
            None: as much as can be had.
        smooth: whether the plans of ``optimum`` are to change little; see ``Optimum``.

    Raises:
        CirlError: for an unknown name, or options that the controller does not take.
    """
    if name not in CONTROLLERS:
        raise CirlError(unknown_name("control", name, CONTROLLERS))
    if constants and name not in SETTABLE:
        raise CirlError(f"values of single agents go with {' or '.join(SETTABLE)} control, not with {name}")
    if min_service is not None and name not in ("mpc", "optimum"):
        raise CirlError(f"a demanded service level goes with mpc or optimum control, not with {name}")
    if name in ("mpc", "optimum"):
        # solvers are loaded by those who ask for them
        from cirl_marl.optimum.mpc import MPC, SERVICE_FIRST, Optimum

        weight = SERVICE_FIRST if min_service is None else None
        if name == "mpc":
            return MPC(min_service=min_service, service_weight=weight)
        return Optimum(min_service=min_service, service_weight=weight, smooth=smooth)
    makers: Mapping[str, Callable[[], Controller]] = {
        "neutral": Neutral,
        "constant": lambda: Constant(constants),
        "random": Random,
        "scripted": lambda: ScriptController(constants),
        "lqr": LQR,
    }
    return makers[name]()
