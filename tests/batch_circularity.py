"""Circularity of batches in closed form: the stages of the solids network, and their mean over a time window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.network import Floats


def staged_circularity(
    time: ArrayLike, *, mass: float, success: float, departure: float, truck_arrival: float, use_end: float
) -> Floats:
    """Return λ(t) of one batch of the solids network N_s, whatever else may be under way.

    λ = 0 before the batch left the reservoir, −m until its unsorted part m_u = m(1 − s/100) reaches the incinerator by
    truck, −(m + m_u) until the rest has been used a second time, then −2m (with the two arrivals in either order).

    Args:
        time: t, any shape, time.
        mass: m, mass.
        success: s, share of the batch that was sorted, in percent.
        departure: when the batch left the reservoir.
        truck_arrival: when m_u arrived at the incinerator, t_in + T_s + T_truck.
        use_end: when the sorted part did, t_in + T_s + T_second-use.

    References: Zocco, Corti, Malvezzi, CiRL (arXiv 2505.21536), network N_s.

    >>> staged_circularity([0.0, 1.0, 5.0, 9.0], mass=10, success=80, departure=0.5, truck_arrival=4, use_end=8)
    array([ -0., -10., -12., -20.])
    """
    at = np.asarray(time, dtype=float)
    rejects = mass * (1.0 - success / 100.0)
    loss: Floats = mass * (at > departure) + rejects * (at >= truck_arrival) + (mass - rejects) * (at >= use_end)
    return -loss


def time_window_circularity(
    masses: Sequence[float],
    criticality: Sequence[float],
    *,
    success: float,
    use: float,
    sorting_time: float,
    truck: float,
    incineration: float,
) -> float:
    """Return the time-window, criticality-weighted circularity of CIRO7.2.

    With m̄ = Σ_i c_i·m_i and the window t_f = T_r + T_d + T_r + T_i::

        λ̄ = −(2/t_f)·[ m̄(T_r + T_d + T_t) + m̄(2 − s/100)(T_r − T_t) + 2m̄·T_i ]

    the three terms being the stages of ``staged_circularity``. It is twice the mean of λ of the weighted mass.

    Args:
        masses: m_i of each material, mass.
        criticality: c_i of each material, dimensionless.
        success: s of the sorter, in percent.
        use: T_r of first and of second use, time.
        sorting_time: T_d, time.
        truck: T_t, time.
        incineration: T_i that the window goes on after the last arrival, time.

    References: released code of CIRO7.2 (``compute_lambda.py``), by Zocco et al.

    >>> day, month = 86_400.0, 2_592_000.0
    >>> times = {"use": month, "sorting_time": day, "truck": 3_600.0, "incineration": day}
    >>> round(time_window_circularity([5, 2], [0.1, 0.95], success=0, **times), 3)
    -7.197
    """
    critical_mass = float(np.dot(masses, criticality))
    window = use + sorting_time + use + incineration
    stages = (use + sorting_time + truck) + (2.0 - success / 100.0) * (use - truck) + 2.0 * incineration
    return -2.0 * critical_mass * stages / window
