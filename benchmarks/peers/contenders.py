"""Who is compared, by what code, with which packages and with how many copies and threads."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.peers.settings import SETTINGS


@dataclass(frozen=True, slots=True, kw_only=True)
class Contender:
    """Somebody who trains.

    Attributes:
        title: in the table.
        code: module of this folder and the function in it that trains.
        venv: folder of the environment that has its packages; empty for ourselves.
        packages: requirements beside this project.
        threads: of torch; for RLlib processes that sample, 1 being the learner's own.
        envs: copies of the environment.
        peer: whether it is somebody else's.
    """

    title: str
    code: tuple[str, str]
    venv: str = ""
    packages: tuple[str, ...] = ()
    threads: int = 1
    envs: int = SETTINGS.envs
    peer: bool = True


RAY = (
    "ray==2.60.0",
    "pandas",
    "tensorboardX",
    "pyarrow",
    "fsspec",
    "dm_tree",
    "lz4",
    "ormsgpack",
    "requests",
    "pyyaml",
)
"""What the extra ``ray[rllib]`` asks for but for Gymnasium, which it pins to a version older than ours."""

CONTENDERS = {
    "rllib": Contender(title="RLlib", code=("with_rllib", "run"), venv="rllib", packages=RAY),
    "benchmarl": Contender(
        title="BenchMARL, our batch",
        code=("with_benchmarl", "run"),
        venv="benchmarl",
        packages=("benchmarl==1.5.2",),
    ),
    "torchrl_lone": Contender(
        title="TorchRL, PettingZoo", code=("with_torchrl", "lone"), venv="torchrl", packages=("torchrl==0.14.1",)
    ),
    "torchrl": Contender(
        title="TorchRL, our batch",
        code=("with_torchrl", "batched"),
        venv="torchrl",
        packages=("torchrl==0.14.1",),
    ),
    "lockstep": Contender(title="ours, lockstep", code=("with_ours", "lockstep"), peer=False),
    "stacked": Contender(title="ours, stacked", code=("with_ours", "stacked"), peer=False),
    "independent_ppo": Contender(title="`independent_ppo`", code=("with_ours", "independent_ppo"), peer=False),
    "independent_ars": Contender(title="`independent_ars`", code=("with_ours", "independent_ars"), peer=False),
    "serving_ars": Contender(title="the same, weight 0.8", code=("with_ours", "serving_ars"), peer=False),
}
