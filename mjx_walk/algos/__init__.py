"""One file an algorithm; this one only finds them."""

from typing import Any

from mjx_walk.algos.a2c import A2CConfig, make_a2c
from mjx_walk.algos.csac import CSACConfig, make_csac
from mjx_walk.algos.ddpg import DDPGConfig, make_ddpg
from mjx_walk.algos.ppo import PPOConfig, make_ppo
from mjx_walk.algos.reinforce import REINFORCEConfig, make_reinforce
from mjx_walk.algos.sac import SACConfig, make_sac
from mjx_walk.algos.td3 import TD3Config, make_td3
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.utils import quiet_mjx  # noqa: F401
from mjx_walk.utils.types import Algorithm

ALGORITHMS: dict[str, tuple[Any, type]] = {
    "ppo": (make_ppo, PPOConfig),
    "sac": (make_sac, SACConfig),
    "csac": (make_csac, CSACConfig),
    "td3": (make_td3, TD3Config),
    "ddpg": (make_ddpg, DDPGConfig),
    "a2c": (make_a2c, A2CConfig),
    "reinforce": (make_reinforce, REINFORCEConfig),
}

__all__ = ["ALGORITHMS", "make_algorithm"]


def make_algorithm(task: Task, num_envs: int, evaluation: EvaluationConfig, config: Any) -> Algorithm:
    """Build the algorithm that the settings are of."""
    return ALGORITHMS[config.name][0](task, num_envs, evaluation, config)
