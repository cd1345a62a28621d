"""Deep deterministic policy gradient (Lillicrap et al. 2016): TD3 without its three additions."""

import dataclasses

from mjx_walk.algos.off_policy import make_off_policy
from mjx_walk.algos.td3 import DeterministicConfig, make_deterministic_learner
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig
from mjx_walk.utils.settings import setting
from mjx_walk.utils.types import Algorithm


@dataclasses.dataclass
class DDPGConfig(DeterministicConfig):
    """Settings of DDPG; the recipe of each task changes some of them."""

    name: str = setting("ddpg", choices=("ddpg",))


def make_ddpg(task: Task, num_envs: int, evaluation: EvaluationConfig, config: DDPGConfig) -> Algorithm:
    """Build DDPG for a task: one critic, no smoothing, and the policy moves with every critic update."""
    learner = make_deterministic_learner(task, num_envs, config, 1, target_noise=0.0, target_noise_clip=0.0)
    return make_off_policy(task, num_envs, evaluation, config, learner)
