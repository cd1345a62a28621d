"""Learning algorithms: one file each, on the two bases in `on_policy` and `off_policy`.

Networks, returns, replay and optimizers that they share are in `mjx_walk.common`; the loop is in `mjx_walk.training`.
"""

from typing import Any

from mjx_walk.utils import quiet_mjx  # noqa: F401  # isort: skip
from mjx_walk.algos.a2c import A2C, A2CConfig
from mjx_walk.algos.base import Algorithm, TrainState
from mjx_walk.algos.csac import CSAC, CSACConfig
from mjx_walk.algos.ddpg import DDPG, DDPGConfig
from mjx_walk.algos.ppo import PPO, PPOConfig
from mjx_walk.algos.reinforce import REINFORCE, REINFORCEConfig
from mjx_walk.algos.sac import SAC, SACConfig
from mjx_walk.algos.td3 import TD3, TD3Config
from mjx_walk.envs import Task
from mjx_walk.envs.inline_evaluation import EvaluationConfig

ALGORITHMS: dict[str, tuple[type[Algorithm], type]] = {
    "ppo": (PPO, PPOConfig),
    "sac": (SAC, SACConfig),
    "csac": (CSAC, CSACConfig),
    "td3": (TD3, TD3Config),
    "ddpg": (DDPG, DDPGConfig),
    "a2c": (A2C, A2CConfig),
    "reinforce": (REINFORCE, REINFORCEConfig),
}

__all__ = ["ALGORITHMS", "Algorithm", "TrainState", "make_algorithm"]


def make_algorithm(
    task: Task, num_envs: int, evaluation: EvaluationConfig, config: Any, axis_name: str | None = None
) -> Algorithm:
    """Build the algorithm whose settings `config` holds.

    Args:
        task: the unbatched environment.
        num_envs: environments that train.
        evaluation: settings of the inline evaluation.
        config: settings of the algorithm.
        axis_name: mapped axis over devices in `learn`, if several devices train one run.

    Raises:
        UserError: settings that exclude each other.
    """
    return ALGORITHMS[config.name][0](task, num_envs, evaluation, config, axis_name)
