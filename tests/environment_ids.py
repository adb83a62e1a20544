"""The table of environment ids with figures of a short episode of each: ``python tests/environment_ids.py`` writes it.

The figures are sums over arrays rather than hashes, as other processors round differently. ``arcsinh`` weighs large
entries by their relative change, small ones by their absolute one, and the weights differ by place.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike

import cirl_marl
from cirl_marl.definitions.ids import NAMESPACE, TABLE, environment_name, figures, ids, name_and_version
from cirl_marl.environments.registration import PAPER_ENVIRONMENTS

TOLERANCE = 2e-5
"""Difference of a figure from which on numbers have changed; single precision of an observation stays below it."""
YEARS, STEPS = 40, 5
"""Episodes of at most so many intervals are played to their end, of others the first few."""


def names() -> Iterator[str]:
    """Yield the name of every environment: networks, their scenarios, and those of the paper."""
    for network in cirl_marl.networks():
        default = cirl_marl.load_network(network)
        yield from (environment_name(default.scenario(name)) for name in (None, *default.scenarios))
    yield from PAPER_ENVIRONMENTS


def figures_of(name: str) -> list[float]:
    """Return observations, states, rewards and λ of a short episode of fixed seed and actions, one figure for each."""
    if name in PAPER_ENVIRONMENTS:
        network, agent, scenario = PAPER_ENVIRONMENTS[name]
        env = cirl_marl.vector_env(network, 2, agents=[agent], scenario=scenario)
    else:
        network, _, variant = name.partition(".")
        env = cirl_marl.vector_env(network, 2, scenario=variant or None)
    observations, horizon = [*env.reset(seed=1).values()], env.network.episode.horizon
    states: list[ArrayLike] = [env.state()]
    rewards: list[ArrayLike] = []
    circularity: list[ArrayLike] = []
    generator = np.random.default_rng(2)
    for _ in range(horizon if horizon <= YEARS else STEPS):
        actions = {a: generator.uniform(-1, 1, (2, *s.shape)) for a, s in env.action_spaces.items()}
        outcome = env.advance(env.stack(actions))
        observations.append(outcome.observation)
        states.append(env.state())
        rewards += [outcome.reward, outcome.local]
        circularity += [outcome.circularity, outcome.levels]
    return [figure(observations), figure(states), figure(rewards), figure(circularity)]


def figure(arrays: Iterable[ArrayLike]) -> float:
    """Return one number that changes with every entry of some arrays."""
    values = np.concatenate([np.ravel(np.asarray(array, dtype=np.float64)) for array in arrays])
    weights = 1.0 + np.arange(len(values)) * 0.6180339887 % 1.0
    return float(f"{weights @ np.arcsinh(values):.12g}")


def has_changed(old: list[float], new: list[float]) -> bool:
    """Return whether figures differ by more than processors do."""
    return not np.allclose(old, new, rtol=0.0, atol=TOLERANCE)


def main() -> None:
    """Write the table: new names begin with version 0, a version whose figures have changed rises."""
    table, known = {}, figures()
    for name in names():
        id_, now = ids().get(name, f"{NAMESPACE}{name}-v0"), figures_of(name)
        if has_changed(known.get(id_, now), now):
            id_ = f"{NAMESPACE}{name}-v{name_and_version(id_)[1] + 1}"
        table[id_] = now if has_changed(known.get(id_, [0.0] * len(now)), now) else known[id_]
    lines = (f" {json.dumps(id_)}: {json.dumps(numbers)}" for id_, numbers in table.items())
    TABLE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
