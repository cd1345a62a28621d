"""rsl_rl's PPO, unchanged, on our environments: `python rsl_rl_ppo.py walker2d 4096 500`."""

import sys

from rsl_rl.runners import OnPolicyRunner

import mjx_walk

task, num_envs, num_iterations = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
network = {"class_name": "MLPModel", "hidden_dims": [256, 256], "activation": "elu", "obs_normalization": True}
settings = {
    "num_steps_per_env": 24,
    "save_interval": 100,
    "logger": "tensorboard",
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": network
    | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}},
    "critic": network,
    "algorithm": {
        "class_name": "PPO",
        "learning_rate": 1e-3,
        "schedule": "adaptive",
        "desired_kl": 0.01,
        "num_learning_epochs": 5,
        "num_mini_batches": 4,
        "gamma": 0.99,
        "lam": 0.95,
        "clip_param": 0.2,
        "entropy_coef": 0.0,
        "value_loss_coef": 1.0,
        "use_clipped_value_loss": True,
        "max_grad_norm": 1.0,
    },
}
env = mjx_walk.make_rsl_rl_env(task, num_envs, seed=0)
runner = OnPolicyRunner(env, settings, log_dir=f"rsl_rl_{task}", device=env.device)
runner.learn(num_iterations, init_at_random_ep_len=True)
