"""The comparison with other libraries, as far as it needs none of them: what they get, and how they are judged."""

from __future__ import annotations

import ast
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from benchmarks.peers import run, work
from benchmarks.peers.contenders import CONTENDERS
from benchmarks.peers.gaps import Reference, Standing, reached
from benchmarks.peers.installing import python_of
from benchmarks.peers.problem import Acting, Lone, Scaling, by_agent, environment, padded
from benchmarks.peers.settings import ENVIRONMENT, NETWORK, SERVICE, SETTINGS
from benchmarks.peers.tables import gap_table, speed_table, verdict
from benchmarks.peers.watch import Judged, Lap, Record, TimeIsUp, Watch
from cirl_marl import load_network
from cirl_marl.controllers import Constant
from cirl_marl.controllers.rollout import rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.evaluation.baselines import Baseline
from cirl_marl.learners.interface import prepare
from cirl_marl.learners.recipe import load_recipe

CODE = Path(run.__file__).parent


@pytest.fixture(scope="module")
def scaling() -> Scaling:
    """Scales from few episodes."""
    return Scaling.measured(environment(4))


def test_peers_get_the_settings_that_our_learners_have() -> None:
    """Whoever changes the recipe, or Stable-Baselines3 its defaults, changes them for everyone or is told."""
    recipe = load_recipe("independent_ppo")
    assert dict(recipe.environment) == ENVIRONMENT
    assert (recipe.run.envs, recipe.run.steps, recipe.learner.bootstrap) == (SETTINGS.envs, SETTINGS.schedule, False)
    assert recipe.run.min_service == SERVICE
    model = next(iter(prepare(NETWORK, recipe, envs=8).learners.values())).model
    assert isinstance(model, PPO)
    assert model.n_steps == SETTINGS.steps == load_network(NETWORK).episode.horizon
    assert (model.batch_size, model.n_epochs) == (SETTINGS.minibatch, SETTINGS.epochs)
    assert (model.gamma, model.gae_lambda) == (SETTINGS.discount, SETTINGS.trace)
    assert (model.vf_coef, model.ent_coef, model.max_grad_norm) == (SETTINGS.value_weight, 0, SETTINGS.gradient)
    assert callable(model.clip_range) and model.clip_range(1.0) == SETTINGS.clip and model.clip_range_vf is None
    assert model.policy.optimizer.defaults["eps"] == SETTINGS.epsilon
    assert float(model.policy.log_std.detach()[0]) == SETTINGS.log_std
    for done in (0.0, 0.3, 1.0):
        assert model.lr_schedule(1.0 - done) == pytest.approx(SETTINGS.rate_after(round(done * SETTINGS.schedule)))
    for network in (model.policy.mlp_extractor.policy_net, model.policy.mlp_extractor.value_net):
        layers = [each for each in network if isinstance(each, torch.nn.Linear)]
        assert tuple(layer.out_features for layer in layers) == SETTINGS.layers
        assert sum(isinstance(each, torch.nn.Tanh) for each in network) == len(layers)


def test_one_copy_is_the_first_of_the_batch(scaling: Scaling) -> None:
    """Libraries that step PettingZoo environments have the same problem, scaled; its end is a termination."""
    lone, batch = Lone(scaling), environment(1)
    seen, observations = lone.reset(seed=7)[0], batch.reset(seed=7)
    random = np.random.default_rng(0)
    for step in range(1, SETTINGS.steps + 1):
        stacked = np.stack([seen[agent] for agent in lone.possible_agents])
        assert stacked == pytest.approx(scaling.seen(padded(batch, observations))[0], abs=1e-5)
        actions = random.normal(size=(1, len(lone.possible_agents), 1))
        observations, rewards, *_ = batch.step(by_agent(batch, actions))
        seen, paid, terminated, truncated, _ = lone.step(dict(zip(lone.possible_agents, actions[0], strict=True)))
        expected = scaling.reward(np.array([rewards[agent][0] for agent in lone.possible_agents]))
        assert list(paid.values()) == pytest.approx(expected.tolist(), rel=1e-5)
        assert all(terminated.values()) == (step == SETTINGS.steps) and not any(truncated.values())
    assert lone.agents == []


def test_scales_make_what_an_untrained_policy_sees_standard() -> None:
    """Mean 0 and deviation 1 where an entry varies; rewards by the deviation of what has been paid."""
    env = environment(8)
    scaling = Scaling.measured(env)
    assert (scaling.deviation > 0).all()
    lengths = [env.observation_spaces[agent].shape[0] for agent in env.agents]
    for place, length in enumerate(lengths):
        assert (scaling.mean[place, length:] == 0).all() and (scaling.deviation[place, length:] == 1).all()
    assert 10 < scaling.paid < 200
    assert scaling.seen(scaling.mean[None]) == pytest.approx(0)
    assert scaling.seen(scaling.mean[None] + 1e6).max() == 10


def test_a_policy_of_a_peer_is_judged_by_what_it_does(scaling: Scaling) -> None:
    """Zeros, and actions beyond the bounds, are those constants to our simulator."""
    env = MultiAgentVectorEnv(NETWORK, num_envs=3)
    for value, given in ((0.0, 0.0), (1.0, 7.0)):
        acting = Acting(lambda seen, given=given: np.full((*seen.shape[:2], 1), given), scaling)  # type: ignore[misc]
        mine = rollout(env, acting, seed=1)
        its = rollout(env, Constant(dict.fromkeys(env.agents, value)), seed=1)
        assert mine.episode_circularity.tolist() == its.episode_circularity.tolist()


def test_the_clock_stands_still_while_policies_are_judged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lap costs what training cost; time is up after at least two, and what was seen comes back from its file."""
    now = 0.0
    monkeypatch.setattr("benchmarks.peers.watch.EPISODES", 2)
    watch = Watch("torchrl", 5.0, 2.0, clock=lambda: now)
    constant = Constant()

    def slow() -> Constant:
        nonlocal now
        now += 0.5  # to make the policy counts
        return constant

    class Slow(Constant):
        def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
            nonlocal now
            now += 100.0
            super().start(env, seed)

    watch.begin()
    now = 1.0
    watch.after(10, slow)
    assert watch.record.judged == []
    now += 1.5
    watch.after(20, Slow)
    now += 1.0
    watch.after(30, slow)
    with pytest.raises(TimeIsUp):
        now += 2.0
        watch.after(40, slow)
    laps = [(lap.processor, lap.steps) for lap in watch.record.laps]
    assert laps == [(1.0, 10), (2.5, 20), (3.5, 30), (6.0, 40)]
    assert [judged.lap.processor for judged in watch.record.judged] == [2.5, 6.0]
    assert watch.record.processor_rate == pytest.approx(30 / 5)
    watch.record.write(tmp_path / "record.json")
    assert asdict(Record.read(tmp_path / "record.json")) == asdict(watch.record)


def test_a_gap_counts_at_the_service_that_is_demanded() -> None:
    """A policy that starves the users comes near no bound; the first that serves is the one that counts."""
    starving, far = _standing(10, 0.98, 0.1), _standing(20, 0.99, 0.6)
    near, nearer = _standing(30, 0.995, 0.4), _standing(40, 0.99, 0.15)
    every = [starving, far, near, nearer, _standing(50, 0.999, 0.5)]
    assert reached(every, 0.5) == near and reached(every, 0.2) == nearer and reached(every, 0.1) is None
    assert reached(every, 0.2, service=0.0) == starving
    table = gap_table({"torchrl": every, "independent_ars": [starving]})
    assert "| TorchRL, our batch | 30 s | 40 s | 10 s | 10 s | 50% | 0.999 | 160 |" in table
    assert "| `independent_ars` | > 10 s | > 10 s | 10 s | 10 s | 10% | 0.980 | 160 |" in table


def test_gaps_are_those_of_the_episodes() -> None:
    """Each of the first episodes is held against its own bound, and the service that lacks most is what counts."""

    class Twice(Baseline):
        def at(self, starts: np.ndarray, levels: np.ndarray) -> np.ndarray:
            return -10.0 * levels[:, 0]

    judged = Judged(Lap(3.0, 2.0, 16), [-20.0, -15.0, -25.0], [[1.0, 0.9], [0.5, 1.0], [0.0, 1.0]])
    standing = Reference(np.zeros((2, 1)), Twice(None, np.empty((0, 2)))).standing(judged)
    assert standing == Standing(3.0, 2.0, 16, -20.0, 0.5, 1.5)


def test_ratios_are_taken_within_rounds() -> None:
    """The median of ratios, not the ratio of medians; the verdict names the fastest and says if the goal is met."""
    rounds = {"stacked": _rounds(100, 30, 10), "torchrl": _rounds(50, 10, 10), "rllib": _rounds(1, 1, 0.1)}
    assert "| TorchRL, our batch | 160 | 160 | 2 × |" in speed_table(rounds, 16)
    assert speed_table(rounds, 16).splitlines()[2].startswith("| RLlib |")
    assert verdict(rounds, ["torchrl", "rllib"]) == "2 times the agent-steps of TorchRL, our batch (goal: ≥ 20, missed)"
    assert verdict(rounds, ["rllib"]) == "1e+02 times the agent-steps of RLlib (goal: ≥ 20, met)"


def test_every_contender_has_code_and_pinned_packages() -> None:
    """Peers are not installed here, so that their code is read and not imported."""
    for contender in CONTENDERS.values():
        home, train = contender.code
        tree = ast.parse((CODE / f"{home}.py").read_text(encoding="utf-8"))
        functions = {each.name: each for each in tree.body if isinstance(each, ast.FunctionDef)}
        wanted = ["watch", "seed", "scaling", "envs", "threads"]
        assert [argument.arg for argument in functions[train].args.args] == wanted
        assert contender.peer == bool(contender.venv) == ("==" in "".join(contender.packages))


def test_we_run_by_the_interpreter_of_now_and_nothing_is_installed_twice(tmp_path: Path) -> None:
    """What is installed is written down, and is done again only if it is not what is wanted."""
    assert python_of(CONTENDERS["stacked"], tmp_path).is_file()
    peer = CONTENDERS["torchrl"]
    (tmp_path / peer.venv).mkdir()
    (tmp_path / peer.venv / "installed.txt").write_text("\n".join([*peer.packages, sys.prefix]), encoding="utf-8")
    assert python_of(peer, tmp_path) == tmp_path / peer.venv / "bin" / "python"


def test_unknown_contenders_and_missing_records_are_named(tmp_path: Path) -> None:
    """Nothing is trained or written then."""
    with pytest.raises(CirlError, match=r"'torchrll'.*torchrl"):
        run.main(only=["torchrll"], records=tmp_path)
    with pytest.raises(CirlError, match=r"'torchrll'.*torchrl"):
        work.main("torchrll", tmp_path / "record.json")
    before = run.DOCUMENT.read_bytes()
    with pytest.raises(CirlError, match="no tables without the speed of"):
        run.main(table=True, records=tmp_path)
    assert run.DOCUMENT.read_bytes() == before and list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_our_own_trainings_are_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One command, one record: laps of whole rollouts, judged policies, and who learnt with what."""
    monkeypatch.setattr("benchmarks.peers.watch.EPISODES", 2)
    out = tmp_path / "record.json"
    work.main("stacked", out, seconds=1.0, every=1.0)
    record = Record.read(out)
    assert [lap.steps - SETTINGS.envs for lap in record.laps] == [
        SETTINGS.rollout * (i + 1) for i in range(len(record.laps))
    ]
    assert record.setup["engine"] == "stacked" and len(record.load) == 2


def _standing(seconds: float, service: float, gap: float) -> Standing:
    return Standing(2 * seconds, seconds, 160, -20.0, service, gap)


def _rounds(*rates: float) -> list[Record]:
    return [
        Record("any", {"threads": 1}, [1.0, 1.0], [Lap(1.0, 1.0, 0), Lap(2.0, 2.0, rate)])  # type: ignore[arg-type]
        for rate in rates
    ]
