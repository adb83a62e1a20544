"""A run that is stopped and taken up again ends with the same bits as one that never stopped."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_networks import booked

from cirl_marl import load_network
from cirl_marl.learners import trainer as module
from cirl_marl.learners.interface import resume, train
from cirl_marl.learners.lockstep import TrainingStop
from cirl_marl.learners.recipe import LearnerSettings, Recipe, Run
from cirl_marl.learners.run_directory import RunDirectory

pytestmark = pytest.mark.medium

OFF = {"learning_starts": 6, "buffer_size": 30, "batch_size": 4, "policy_kwargs": {"net_arch": [4]}}
ON = {"policy_kwargs": {"net_arch": [4]}, "n_steps": 7}
PPO = {**ON, "batch_size": 7, "n_epochs": 2}
ARS: dict[str, Any] = {"n_delta": 2, "n_top": 1, "n_eval_episodes": 2}
NOISE = {"action_noise": {"kind": "ornstein_uhlenbeck", "sigma": 0.3}}
CASES: dict[str, tuple[str, dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "PPO": ("PPO", PPO, {}, {}),
    "PPO stacked": ("PPO", PPO, {}, {"engine": "stacked"}),
    "PPO's policies by exact gradients": ("PPO", PPO, {}, {"engine": "gradients"}),
    "TD3's actors by exact gradients": ("TD3", OFF, {}, {"engine": "gradients"}),
    "SAC's actors by exact gradients": ("SAC", OFF, {}, {"engine": "gradients"}),
    "TQC's actors by exact gradients": ("TQC", OFF, {}, {"engine": "gradients"}),
    "PPO with state-dependent noise": ("PPO", {**PPO, "use_sde": True, "sde_sample_freq": 3}, {}, {}),
    "PPO shared": ("PPO", PPO, {"scheme": "shared"}, {}),
    "PPO joint": ("PPO", PPO, {"scheme": "joint"}, {}),
    "PPO with a central critic": ("PPO", PPO, {"policy": "CentralCriticPolicy"}, {}),
    "PPO with a central critic, stacked": ("PPO", PPO, {"policy": "CentralCriticPolicy"}, {"engine": "stacked"}),
    "PPO stacked, with centred rewards": ("PPO", PPO, {"centre_rewards": True}, {"engine": "stacked"}),
    "PPO that shows itself less": ("PPO", PPO, {"share_of_steps": 0.5}, {}),
    "A2C": ("A2C", ON, {}, {}),
    "A2C stacked": ("A2C", ON, {}, {"engine": "stacked"}),
    "TRPO": ("TRPO", {**ON, "batch_size": 7}, {}, {}),
    "RecurrentPPO": (
        "RecurrentPPO",
        {**PPO, "policy_kwargs": {"lstm_hidden_size": 4}},
        {"policy": "MlpLstmPolicy"},
        {},
    ),
    "RecurrentPPO that has learnt enough": (
        "RecurrentPPO",
        {**PPO, "policy_kwargs": {"lstm_hidden_size": 4}},
        {"policy": "MlpLstmPolicy", "share_of_steps": 0.4},
        {},
    ),
    "SAC": ("SAC", OFF, {}, {}),
    "SAC with returns of several steps": ("SAC", {**OFF, "n_steps": 3}, {}, {}),
    "SAC with state-dependent noise": ("SAC", {**OFF, "use_sde": True}, {}, {}),
    "TD3": ("TD3", {**OFF, **NOISE}, {}, {}),
    "TD3 with centred rewards": ("TD3", {**OFF, **NOISE}, {"centre_rewards": True}, {}),
    "DDPG": ("DDPG", {**OFF, **NOISE}, {}, {}),
    "TQC": ("TQC", OFF, {}, {}),
    "CrossQ": ("CrossQ", OFF, {}, {}),
    "ARS": ("ARS", ARS, {}, {}),
    "ARS stacked": ("ARS", ARS, {}, {"engine": "stacked"}),
    "demonstrations": ("PPO", PPO, {"demonstrations": {"controller": "neutral", "steps": 20}}, {}),
    "budgets": ("PPO", PPO, {}, {"at_most": {"emissions": -5.0}}),
    "budgets by exact gradients": ("PPO", PPO, {}, {"engine": "gradients", "at_most": {"emissions": -5.0}}),
    "budgets of years": ("PPO", PPO, {}, {"at_most": {"emissions/year": -5.0, "cost": 1.0}}),
    "budgets of years by exact gradients": (
        "PPO",
        PPO,
        {},
        {"engine": "gradients", "at_most": {"emissions/year": -5.0, "cost": 1.0}},
    ),
    "demonstrations for a buffer": ("SAC", OFF, {"demonstrations": {"controller": "neutral", "steps": 20}}, {}),
}
RUN: dict[str, Any] = {"steps": 160, "envs": 2, "engine": "lockstep", "evaluations": 6, "episodes": 2}
RUN |= {"min_service": 0.99, "price_rate": 0.2}


def recipe(case: str) -> tuple[Recipe, dict[str, Any]]:
    """Return the recipe of a case, with normalisers and evaluations that choose and move the price."""
    algorithm, parameters, more, run = CASES[case]
    settings = {"algorithm": algorithm, "parameters": parameters, **more}
    settings["normalise"] = {"observation": True, "reward": True}
    found = Recipe(
        name="exact",
        title="exact",
        run=Run(**(RUN | run)),
        environment={"reward": "team", "horizon": 6},
        learner=LearnerSettings.model_validate(settings),
    )
    return found, {"agents": ["mine"] if more.get("scheme") == "shared" else ["mine", "use", "collection"]}


def files(run: Path) -> dict[str, Any]:
    """Return all that a run keeps but for times: rows without seconds, and every checkpoint that acts, to the byte."""
    found: dict[str, Any] = {}
    for name in ("metrics.csv", "evaluations.csv"):
        with (run / name).open(newline="") as file:
            rows = list(csv.DictReader(file))
        found[name] = [{key: value for key, value in row.items() if key != "seconds"} for row in rows]
    found["status"] = json.loads((run / "status.json").read_text())
    for kept in {found["status"]["checkpoint"], found["status"]["best"]["checkpoint"]}:
        for path in sorted((run / "checkpoints" / kept).iterdir()):
            found[f"{kept}/{path.name}"] = path.read_bytes()
    return found


def stop_at(monkeypatch: pytest.MonkeyPatch, steps: list[int], *, saved: bool) -> None:
    """Let trainings end at these joint steps, after a checkpoint that was asked for, or without notice."""
    real = module._keep

    def keep(trainings: Any, lockstep: Any, interrupted: Any) -> None:
        (training,) = trainings
        wanted = bool(steps) and training.joint_steps >= steps[0]
        if wanted and not saved:
            steps.pop(0)
            raise TrainingStop  # as after SIGKILL: nothing is written
        real(trainings, lockstep, lambda: wanted or interrupted())

    monkeypatch.setattr(module, "_keep", keep)


@pytest.mark.sample(2)
@pytest.mark.parametrize("saved", [True, False], ids=["saved", "killed"])
@pytest.mark.parametrize("case", CASES)
def test_the_same_bits(case: str, saved: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights, normalisers, optimisers, streams, metrics, evaluations: whenever it is stopped, however often."""
    found, options = recipe(case)
    unit = "year" if "emissions/year" in found.run.at_most else "day"
    network = replace(booked(load_network("copper_net"), 2), time_unit=unit) if found.run.at_most else "copper_net"
    train(network, found, directory=tmp_path / "whole", seed=3, **options)
    stops = sorted(np.random.default_rng(len(case)).choice(np.arange(1, 79), 5, replace=False).tolist())
    left = list(stops)
    stop_at(monkeypatch, left, saved=saved)
    run = tmp_path / "stopped"
    for attempt in range(40):
        try:
            if attempt == 0:
                train(network, found, directory=run, seed=3, **options)
            else:
                resume(run)
            break
        except KeyboardInterrupt:
            done = RunDirectory(run).status["joint_steps"]
            if saved:
                left.pop(0)
            while saved and left and left[0] <= done:  # it went on to the next boundaries
                left.pop(0)
    assert attempt == len(stops) - len(left) or (saved and attempt > 1)
    whole, again = files(tmp_path / "whole"), files(run)
    assert whole.keys() == again.keys()
    for name, value in whole.items():
        assert value == again[name], name
    assert RunDirectory(run).status["state"] == "complete"
