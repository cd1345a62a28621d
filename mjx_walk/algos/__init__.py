"""Learning algorithms: one file each, on the two bases in `on_policy` and `off_policy`.

Networks, returns, replay and optimizers that they share are in `mjx_walk.common`; the loop is in `mjx_walk.training`.
"""

from typing import Protocol

from mjx_walk.machine import quiet_mjx  # noqa: F401  # isort: skip
from mjx_walk.algos.a2c import A2C, A2CConfig
from mjx_walk.algos.base import (
    Algorithm,
    AlgorithmConfig,
    TrainState,
    is_finite,
    learned_leaves,
    with_replay_of,
    without_replay,
)
from mjx_walk.algos.csac import CSAC, CSACConfig
from mjx_walk.algos.ddpg import DDPG, DDPGConfig
from mjx_walk.algos.off_policy_config import OffPolicyConfig
from mjx_walk.algos.on_policy_config import OnPolicyConfig
from mjx_walk.algos.ppo import PPO, PPOConfig
from mjx_walk.algos.reinforce import REINFORCE, REINFORCEConfig
from mjx_walk.algos.sac import SAC, SACConfig
from mjx_walk.algos.td3 import TD3, TD3Config
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.envs import BaseTask
from mjx_walk.utils.class_checks import check_class, check_decorated
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import with_name

ALGORITHMS: dict[str, tuple[type[Algorithm], type]] = {
    "ppo": (PPO, PPOConfig),
    "sac": (SAC, SACConfig),
    "csac": (CSAC, CSACConfig),
    "td3": (TD3, TD3Config),
    "ddpg": (DDPG, DDPGConfig),
    "a2c": (A2C, A2CConfig),
    "reinforce": (REINFORCE, REINFORCEConfig),
}

BUILT_IN_ALGORITHMS: tuple[str, ...] = tuple(ALGORITHMS)
"""Names that a user's algorithm cannot take."""

__all__ = [
    "ALGORITHMS",
    "BUILT_IN_ALGORITHMS",
    "Algorithm",
    "NamedConfig",
    "OffPolicyConfig",
    "TrainState",
    "is_finite",
    "learned_leaves",
    "make_algorithm",
    "register_algorithm",
    "with_replay_of",
    "without_replay",
]


class NamedConfig(AlgorithmConfig, Protocol):
    """Settings of one algorithm."""

    name: str
    """The algorithm's name in `ALGORITHMS`."""


def make_algorithm(
    task: BaseTask, num_envs: int, evaluation: EvaluationConfig, config: NamedConfig, axis_name: str | None = None
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


def register_algorithm(name: str, algorithm: type[Algorithm], config: type) -> None:
    """Register an algorithm, so that `algo=NAME` finds it in this process.

    A class with the same module and name replaces a former one, as when a notebook's cell runs again.

    Args:
        name: lower-case letters, digits and underscores.
        algorithm: a subclass of `Algorithm`, usually of one of its bases, that defines all abstract methods.
        config: a dataclass derived from the settings of the base, such as `OnPolicyConfig` or `PPOConfig`.

    Raises:
        UserError: a name that is taken or invalid, or a class of another kind.
    """
    if name in BUILT_IN_ALGORITHMS:
        raise UserError(f"'{name}' is an algorithm of this package; choose another name")
    known = {other: kind for other, (kind, _) in ALGORITHMS.items()}
    check_class("an algorithm", name, algorithm, Algorithm, "a subclass of mjx_walk.algos.Algorithm", known)
    if not (isinstance(config, type) and issubclass(config, OnPolicyConfig | OffPolicyConfig)):
        raise UserError(f"the settings of '{name}' are {config!r}; derive them from OnPolicyConfig or OffPolicyConfig")
    check_decorated(config, f"settings of '{name}'")
    ALGORITHMS[name] = (algorithm, with_name(config, name))
