"""What the library computes, as hashes: run it before and after a change that should change nothing.

    python tests/identity.py before.json
    python tests/identity.py after.json --against before.json

Simulated CSV files, batched episodes, bounds, plans, trained weights and compared figures of the catalogue, bit for
bit. The hashes are those of one machine: another processor or another BLAS rounds differently.

Numbers are hashed apart from the keys under which they stand: a key of ``infos`` may be renamed (``RENAMED``) or come
newly (``ADDED``), a tensor of a checkpoint or a column of a table may get another name, and the numbers must still be
the same bits.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file

import cirl_marl

CONTROLS = ("neutral", "random", "scripted")
TRAININGS = {
    "independent_ars": ("copper_net", 64_000),
    "independent_ppo": ("copper_net", 4096),
    "independent_a2c": ("net_zero", 640),
    "independent_sac": ("carbo_net", 400),
    "joint_ppo": ("copper_net", 4096),
    "joint_sac": ("carbo_net", 400),
    "shared_ppo": ("copper_net", 2048),
    "shared_ars": ("carbo_net", 3000),
    "mappo": ("carbo_net", 2048),
    "mixed_by_kind": ("solids_net", 400),
}
"""Recipe → network and environment steps."""

RENAMED: dict[str, str] = {
    "final_observation": "final_obs",
    "_final_observation": "_final_obs",
    "final_state": "final_info.state",
}
"""Keys of ``infos`` that had another name before: old → new."""
ADDED = ("service_levels", "cost", "cost_", "final_info", "_final_info")
"""Keys of ``infos`` that came newly; one that ends in ``_`` stands for all that begin so, one for what is in it too."""


def named(*places: str) -> Any:
    """Return the first of ``module:name`` that there is, the present place first and former ones after it."""
    for place in places:
        module, _, name = place.partition(":")
        try:
            return getattr(import_module(module), name)
        except (ImportError, AttributeError):
            continue
    raise ImportError(f"none of {', '.join(places)}")


app = named("cirl_marl.cli:app")
bound = named("cirl_marl:bound", "cirl_marl.optimum:bound")
improve_plan = named("cirl_marl.optimum:improve_plan", "cirl_marl.optimum:improved")
search = named("cirl_marl.optimum:search")
train = named("cirl_marl:train", "cirl_marl.learners:train")


def digest(*parts: Any) -> str:
    """Return the hash of arrays, texts, numbers and nested containers of them; a mapping counts by its values.

    Raises:
        ValueError: if there is nothing to hash.
    """
    if not parts:
        raise ValueError("nothing to hash: a hash of nothing never differs")
    state = hashlib.sha256()
    for part in parts:
        if isinstance(part, Mapping):
            state.update(digest(*part.values()).encode() if part else b"{}")
        elif isinstance(part, list | tuple):
            state.update(digest(*part).encode() if part else b"[]")
        elif isinstance(part, str | bytes):
            state.update(part.encode() if isinstance(part, str) else part)
        else:
            array = np.ascontiguousarray(part)
            if array.dtype == object:
                raise TypeError(f"no numbers: {type(part).__name__}")
            state.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    return state.hexdigest()[:16]


def digest_of_table(path: Path) -> str:
    """Return the hash of the columns of a CSV file, whatever they are called."""
    header, *rows = csv.reader(path.read_text(encoding="utf-8").splitlines())
    if not rows:
        raise ValueError(f"{path}: {len(header)} columns and no row")
    return digest(*zip(*rows, strict=True))


def digest_of_tensors(paths: Iterable[Path]) -> str:
    """Return the hash of all tensors in these safetensors files, whatever they are called and in whichever order."""
    return digest(*sorted(digest(tensor) for path in paths for tensor in load_file(path).values()))


def flat(info: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the entries of nested mappings, keys joined by dots."""
    for key, value in info.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def is_new(what: str) -> bool:
    """Return whether a hash is of a key of ``infos`` that came newly."""
    key = what.partition(" infos ")[2]
    return any(key == new or key.startswith(new if new.endswith("_") else f"{new}.") for new in ADDED)


def by_key(infos: Iterable[Mapping[str, Mapping[str, Any]]]) -> Iterator[tuple[str, str]]:
    """Yield for each key of ``infos`` of several steps, agent → key → value, the hash of all that stood under it."""
    values: dict[str, list[Any]] = {}
    for step in infos:
        for of_agent in step.values():
            for key, value in flat(of_agent):
                values.setdefault(key, []).append(value)
    for key, parts in values.items():
        yield key, digest(*parts)


def simulated(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the CSV files of ``cirl simulate`` for every scenario of the catalogue."""
    for name in cirl_marl.networks():
        for scenario in ("default", *cirl_marl.load_network(name).scenarios):
            for control in CONTROLS:
                out = folder / scenario / control
                words = ["simulate", name, "--control", control, "--steps", "12", "--out", str(out), "--seed", "3"]
                app([*words, "--scenario", scenario], standalone_mode=False)
                tables = sorted(out.glob(f"{name}*.csv"))  # the episode, and the ages of what has a lifetime
                yield f"simulate {name} {scenario} {control}", digest(*map(digest_of_table, tables))
    for name, control, *more in (
        ("copper_net", "lqr", "--scenario", "paper"),
        ("copper_net", "optimum"),
        ("carbo_net", "mpc"),
    ):
        words = ["simulate", name, "--control", control, "--steps", "4", "--out", str(folder / "by"), *more]
        app(words, standalone_mode=False)
        (table,) = (folder / "by").glob(f"{name}*{control}*.csv")
        yield f"simulate {name} {control}", digest_of_table(table)


def stepped() -> Iterator[tuple[str, str]]:
    """Yield what seven copies of every scenario show in two short episodes of random actions, for every reward."""
    for name in cirl_marl.networks():
        for scenario in ("default", *cirl_marl.load_network(name).scenarios):
            for reward in ("local", "circularity", "mixed", "difference", "mixed_difference", "local_sum", "team"):
                env = cirl_marl.vector_env(name, num_envs=7, scenario=scenario, reward=reward, horizon=5)
                random = np.random.default_rng(1)
                shown: list[Any] = [env.reset(seed=11)]
                infos = []
                for _ in range(7):
                    actions = {a: random.uniform(-1, 1, (7, *s.shape)) for a, s in env.action_spaces.items()}
                    *outcome, info = env.step(actions)
                    shown += outcome
                    infos.append(info)
                what = f"step {name} {scenario} {reward}"
                yield what, digest(*shown, env.state(), env.local_rewards())
                for key, hash_ in by_key(infos):
                    yield f"{what} infos {key}", hash_


def bounded() -> Iterator[tuple[str, str]]:
    """Yield bounds with their multipliers and plans, and the plans of searches."""
    for name in ("copper_net", "carbo_net"):
        settings: tuple[dict[str, Any], ...] = ({}, {"min_service": 0.97}, {"service_weight": 3.0})
        for options in settings:
            proven = bound(name, horizon=6, **options)
            better = improve_plan(proven, rounds=2)
            proof = [proven.certificate.equal, proven.certificate.under, proven.verify().bound]
            yield f"bound {name} {options}", digest(proven.objective, proof, proven.actions, better.actions)
    for name in ("solids_net", "net_zero"):
        plan = search(name, horizon=8, knots=2, population=8, iterations=3)
        yield f"search {name}", digest(plan.circularity, plan.service, plan.actions)


def trained(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the weights of every learner of short trainings, and the figures of a comparison."""
    for recipe, (network, steps) in TRAININGS.items():
        run = folder / recipe
        train(network, recipe, directory=run, steps=steps, seed=5)
        policies = [path for path in run.glob("checkpoints/*/*.safetensors") if path.name.count(".") == 1]
        yield f"train {recipe} {network}", digest_of_tensors(policies)
        yield f"train {recipe} {network} evaluations", digest_of_table(run / "evaluations.csv")
    words = ["compare", str(folder / "joint_ppo"), "--episodes", "2", "--out", str(folder / "compared")]
    app([*words, "--controllers", "neutral,random"], standalone_mode=False)
    yield "compare joint_ppo", digest_of_table(folder / "compared" / "summary.csv")


def renamed(hashes: Mapping[str, str]) -> dict[str, str]:
    """Return hashes of an earlier run with the present names of the keys of ``infos``."""
    result = {}
    for what, hash_ in hashes.items():
        step, infos, key = what.partition(" infos ")
        result[step + infos + RENAMED.get(key, key)] = hash_
    return result


def differences(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Return what differs, is missing or came newly, but for the listed exceptions."""
    expected = renamed(before)
    other = [what for what in expected.keys() | after.keys() if expected.get(what) != after.get(what)]
    return sorted(what for what in other if what in expected or not is_new(what))


def main() -> None:
    """Hash everything, write it, and hold it against what another run wrote."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path, help="JSON file to write")
    parser.add_argument("--against", type=Path, help="JSON file of another run; exit code 1 if anything differs")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        parts = (simulated(Path(folder)), stepped(), bounded(), trained(Path(folder)))
        hashes = {what: hash_ for part in parts for what, hash_ in part}
    arguments.out.write_text(json.dumps(hashes, indent=1) + "\n")
    sys.stderr.write(f"{len(hashes)} hashes in {arguments.out}\n")
    if arguments.against is not None:
        other = differences(json.loads(arguments.against.read_text()), hashes)
        sys.stderr.write("".join(f"differs: {what}\n" for what in other) + f"{len(other)} differ\n")
        sys.exit(bool(other))


if __name__ == "__main__":
    main()
