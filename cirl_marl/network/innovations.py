"""What is new about disturbances in each interval: functions of their states less their exact conditional means.

With φ a function of the state of a process, φ(s_{t+1}) − E[φ(s_{t+1}) | F_t] has mean zero given all that was known
before, whatever anybody did with it. Times anything known in t it still has.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from cirl_marl.network.declarations import positional_record
from cirl_marl.network.disturbances import BlockBootstrap, Disturbance, Gaussian, Markov
from cirl_marl.network.processes import DisturbanceProcesses
from cirl_marl.network.rowsum import Floats


@positional_record
class Innovations:
    """Functions φ of the states of processes, and what is new in them."""

    features: Annotated[Floats, "φ(s_t), shape (steps, functions, B)"]
    new: Annotated[Floats, "φ(s_{t+1}) − E[φ(s_{t+1}) | F_t], shape (steps − 1, functions, B)"]


def innovations(processes: DisturbanceProcesses, states: Floats) -> Innovations:
    """Return the functions of these states, shape (steps, names, B).

    They are the latent z of a Gaussian process and z² − 1, of a chain whether it is in each regime but the first, of a
    record the value at its place and the next one.
    """
    steps, _, copies = states.shape
    features, new = [np.empty((steps, 0, copies))], [np.empty((max(steps - 1, 0), 0, copies))]
    for n, disturbance in enumerate(processes.disturbances):
        now, means = _functions(disturbance, states[:, n])
        features.append(now)
        new.append(now[1:] - means[:-1])
    return Innovations(np.concatenate(features, axis=1), np.concatenate(new, axis=1))


def _functions(disturbance: Disturbance, state: Floats) -> tuple[Floats, Floats]:
    """Return φ of a state in each interval, shape (steps, B), and the mean that φ then has in the next one."""
    if isinstance(disturbance, Gaussian):
        memory, deviation = disturbance.memory
        ahead = memory * state
        return np.stack([state, state**2 - 1], axis=1), np.stack([ahead, ahead**2 + deviation**2 - 1], axis=1)
    if isinstance(disturbance, Markov):
        table = np.eye(len(disturbance.values))[:, 1:]
        means = disturbance.transitions @ table
    else:
        assert isinstance(disturbance, BlockBootstrap)
        values = np.array(disturbance.values)
        table, leave = np.stack([values, np.roll(values, -1)], axis=1), 1.0 / disturbance.block
        means = (1 - leave) * np.roll(table, -1, axis=0) + leave * table.mean(axis=0)
    places = state.astype(np.intp)
    return np.moveaxis(table[places], 2, 1), np.moveaxis(means[places], 2, 1)
