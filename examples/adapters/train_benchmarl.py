"""Multi-agent PPO with a common critic on copper_net, learnt by BenchMARL in the batched environment."""

import tempfile

from benchmarl.algorithms import MappoConfig
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from rich import print

from cirl_marl.adapters.benchmarl import NetworkTask

config = ExperimentConfig.get_from_yaml()
config.max_n_iters, config.on_policy_n_envs_per_worker = 3, 8
config.on_policy_collected_frames_per_batch, config.on_policy_minibatch_size = 8 * 40, 160
config.evaluation, config.render, config.loggers, config.create_json = False, False, [], False
config.save_folder = tempfile.mkdtemp()
experiment = Experiment(
    task=NetworkTask("copper_net", reward="team", horizon=40),
    algorithm_config=MappoConfig.get_from_yaml(),
    model_config=MlpConfig.get_from_yaml(),
    critic_model_config=MlpConfig.get_from_yaml(),
    seed=0,
    config=config,
)
experiment.run()
print(f"{experiment.total_frames} steps, paid {float(experiment.mean_return):.3f} per episode")
