"""Deep deterministic policy gradient (Lillicrap et al. 2016): TD3 without its three additions."""

import dataclasses
from typing import ClassVar

from mjx_walk.algos.deterministic import DeterministicAlgorithm, DeterministicConfig
from mjx_walk.utils.setting_fields import setting

__all__ = ["DDPG", "DDPGConfig"]


@dataclasses.dataclass
class DDPGConfig(DeterministicConfig):
    """Settings of DDPG."""

    name: str = setting("ddpg", choices=("ddpg",))


@dataclasses.dataclass(frozen=True, eq=False)
class DDPG(DeterministicAlgorithm[DDPGConfig]):
    """One critic, targets without smoothing, and a policy that moves with every critic update."""

    num_critics: ClassVar[int] = 1
