"""One file an algorithm; this one only finds them."""

from typing import Any

from mjx_walk.algos.ppo import PPOConfig, make_ppo
from mjx_walk.envs import Task
from mjx_walk.types import Algorithm

ALGORITHMS: dict[str, tuple[Any, type]] = {"ppo": (make_ppo, PPOConfig)}

__all__ = ["ALGORITHMS", "make_algorithm"]


def make_algorithm(task: Task, num_envs: int, num_eval_envs: int, config: Any) -> Algorithm:
    """Build the algorithm that the settings are of, with at most one evaluation copy for each that learns."""
    return ALGORITHMS[config.name][0](task, num_envs, min(num_eval_envs, num_envs), config)
