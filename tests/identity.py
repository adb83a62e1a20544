"""What the library computes, as hashes: run it before and after a change that should change nothing.

    python tests/identity.py before.json
    python tests/identity.py after.json --against before.json

Simulated CSV files, batched episodes, bounds, plans, trained weights and compared figures of the catalogue, bit for
bit. The hashes are those of one machine: another processor or another BLAS rounds differently.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

import cirl_marl
from cirl_marl import learners, optimum
from cirl_marl.cli import app

CONTROLS = ("neutral", "random", "scripted")
TRAININGS = {
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


def digest(*parts: Any) -> str:
    """Return the hash of arrays, texts, numbers and nested containers of them."""
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, dict):
            found.update(digest(*[each for pair in sorted(part.items()) for each in pair]).encode())
        elif isinstance(part, list | tuple):
            found.update(digest(*part).encode())
        elif isinstance(part, torch.Tensor):
            found.update(part.detach().cpu().contiguous().numpy().tobytes())
        elif isinstance(part, str | bytes):
            found.update(part.encode() if isinstance(part, str) else part)
        else:
            found.update(np.ascontiguousarray(part).tobytes())
    return found.hexdigest()[:16]


def simulated(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the CSV files of ``cirl simulate`` for every scenario of the catalogue."""
    for name in cirl_marl.networks():
        for scenario in ("default", *cirl_marl.load_network(name).scenarios):
            for control in CONTROLS:
                out = folder / scenario / control
                asked = ["simulate", name, "--control", control, "--steps", "12", "--out", str(out), "--seed", "3"]
                app([*asked, "--scenario", scenario], standalone_mode=False)
                (csv,) = out.glob(f"{name}*.csv")
                yield f"simulate {name} {scenario} {control}", digest(csv.read_bytes())
    for name, control, *more in (
        ("copper_net", "lqr", "--scenario", "paper"),
        ("copper_net", "optimum"),
        ("carbo_net", "mpc"),
    ):
        asked = ["simulate", name, "--control", control, "--steps", "4", "--out", str(folder / "by"), *more]
        app(asked, standalone_mode=False)
        (csv,) = (folder / "by").glob(f"{name}*{control}*.csv")
        yield f"simulate {name} {control}", digest(csv.read_bytes())


def stepped() -> Iterator[tuple[str, str]]:
    """Yield what seven copies of every scenario show in two short episodes of random actions, for every reward."""
    for name in cirl_marl.networks():
        for scenario in ("default", *cirl_marl.load_network(name).scenarios):
            for reward in ("local", "circularity", "mixed", "difference", "mixed_difference", "local_sum", "team"):
                env = cirl_marl.vector_env(name, num_envs=7, scenario=scenario, reward=reward, horizon=5)
                random = np.random.default_rng(1)
                seen: list[Any] = [env.reset(seed=11)]
                for _ in range(7):
                    actions = {a: random.uniform(-1, 1, (7, *s.shape)) for a, s in env.action_spaces.items()}
                    seen += env.step(actions)
                yield f"step {name} {scenario} {reward}", digest(seen, env.state(), env.local_rewards())


def bounded() -> Iterator[tuple[str, str]]:
    """Yield bounds with their multipliers and plans, and the plans of searches."""
    for name in ("copper_net", "carbo_net"):
        asked: tuple[dict[str, Any], ...] = ({}, {"min_service": 0.97}, {"service_weight": 3.0})
        for options in asked:
            found = optimum.bound(name, horizon=6, **options)
            better = optimum.improved(found, rounds=2)
            proof = [found.certificate.equal, found.certificate.under, found.verify().bound]
            yield f"bound {name} {options}", digest(found.objective, proof, found.actions, better.actions)
    for name in ("solids_net", "net_zero"):
        plan = optimum.search(name, horizon=8, knots=2, population=8, iterations=3)
        yield f"search {name}", digest(plan.circularity, plan.service, plan.actions)


def trained(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the weights of every learner of short trainings, and the figures of a comparison."""
    for recipe, (network, steps) in TRAININGS.items():
        run = folder / recipe
        learners.train(network, recipe, directory=run, steps=steps, seed=5)
        weights = {}
        for saved in sorted(run.glob("checkpoints/*/*.zip")):
            with zipfile.ZipFile(saved) as archive:
                weights[saved.stem] = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
        yield f"train {recipe} {network}", digest(weights)
    asked = ["compare", str(folder / "joint_ppo"), "--episodes", "2", "--out", str(folder / "compared")]
    app([*asked, "--controllers", "neutral,random"], standalone_mode=False)
    text = (folder / "compared" / "summary.csv").read_bytes()
    yield "compare joint_ppo", digest(text)


def main() -> None:
    """Hash everything, write it, and hold it against what another run wrote."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path, help="JSON file to write")
    parser.add_argument("--against", type=Path, help="JSON file of another run; exit code 1 if anything differs")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        parts = (simulated(Path(folder)), stepped(), bounded(), trained(Path(folder)))
        found = {what: hash_ for part in parts for what, hash_ in part}
    asked.out.write_text(json.dumps(found, indent=1) + "\n")
    sys.stderr.write(f"{len(found)} hashes in {asked.out}\n")
    if asked.against is not None:
        before = json.loads(asked.against.read_text())
        other = sorted(what for what in before.keys() | found.keys() if before.get(what) != found.get(what))
        sys.stderr.write("".join(f"differs: {what}\n" for what in other) + f"{len(other)} differ\n")
        sys.exit(bool(other))


if __name__ == "__main__":
    main()
