"""What rates in pieces add for all beyond an amount, in a program: variables that are never less than the excess.

A mean flow of an interval, a mean stock or the distance of a control, q, is a sum of variables and of the stocks at the
very start. With q ≤ q̄ its excess e = max(0, q − b) beyond an amount b is convex in q, and so above its two lines and
below its chord from 0:

    q − b ≤ e,    0 ≤ e ≤ max(0, q̄ − b),    e ≤ max(0, 1 − b/q̄)·q.

Where more of it costs the program makes e as small as it is, where more is wanted the chord bounds it.
"""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.network import Floats
from cirl_marl.optimum.aims import account_rows
from cirl_marl.optimum.matrices import ProgramRows
from cirl_marl.optimum.vintages import Lifetimes


def excess_rows(lifetimes: Lifetimes, ledger: Ledger, initial: Floats, high: Floats, rows: ProgramRows) -> None:
    """Add two rows of each excess in each interval, with its bound in ``high``; keys (6, interval, excess, side).

    Args:
        lifetimes: of the network.
        ledger: of it.
        initial: stocks at the start as the simulator has them, mass.
        high: highest value of every variable, shape (steps, variables of an interval); those of excesses are set.
        rows: over these intervals.
    """
    layout, count = rows.layout, len(ledger.excesses)
    if not count:
        return
    within, before, beside = _subjects(lifetimes, ledger, initial, rows)
    most = high @ within.T
    most[1:] += high[:-1] @ before.T
    most[0] += beside
    amounts = ledger.amounts.T
    high[:, layout.excess :] = np.maximum(most - amounts, 0.0)
    chord = np.divide(high[:, layout.excess :], most, out=np.zeros_like(most), where=most > 0)
    t = np.arange(len(high))[:, None]
    constant = np.zeros_like(most)
    constant[0] = beside
    for side, sign, slope in ((0, 1.0, np.ones_like(chord)), (1, -1.0, chord)):
        row = rows.add(6, t, np.arange(count), side)
        rows.put(row, t * layout.size + layout.excess + np.arange(count), -sign)
        for table, shift in ((within, 0), (before, 1)):
            excess, column = np.nonzero(table)
            at = row[shift:, excess], t[: len(t) - shift] * layout.size + column
            rows.put(*at, sign * slope[shift:, excess] * table[excess, column])
        rows.limit(row, (amounts if side == 0 else 0.0) - sign * slope * constant)


def _subjects(
    lifetimes: Lifetimes, ledger: Ledger, initial: Floats, rows: ProgramRows
) -> tuple[Floats, Floats, Floats]:
    """Return what each excess is of: variables of its interval, of the one before, and beside them in the first.

    Shapes are (excesses, variables of an interval), twice, and (excesses,).
    """
    layout, count = rows.layout, len(ledger.excesses)
    by_flow, by_stock, by_control = ledger.excess_subjects
    by_part = np.concatenate([by_control, np.zeros((count, count))], axis=1)
    first = by_flow[:, None], by_stock[:, None], by_part[:, None]
    by_flow, by_stock, by_part = (np.concatenate([0.0 * table, table], axis=1) for table in first)
    beside = account_rows(lifetimes, layout, initial, first)[1]
    pattern = account_rows(lifetimes, layout, initial, (by_flow, by_stock, by_part))[0].toarray()
    return pattern[:, layout.size :], pattern[:, : layout.size], beside
