"""Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018) for many environments, on Brax's networks."""

import dataclasses
from typing import ClassVar

from mjx_walk.algos.deterministic import DeterministicAlgorithm, DeterministicConfig
from mjx_walk.utils.setting_fields import AnyBut, setting

__all__ = ["TD3", "TD3Config"]


@dataclasses.dataclass
class TD3Config(DeterministicConfig):
    """Settings of TD3."""

    name: str = setting("td3", choices=("td3",))
    policy_delay: int = setting(2, at_least=1)
    target_noise: float = setting(0.2, at_least=0)
    """Std of the noise that smooths the target policy, in `[-1, 1]`."""
    target_noise_clip: float = setting(0.5, at_least=0, only_if={"target_noise": AnyBut(0)})
    """Bound of the target policy's noise."""


@dataclasses.dataclass(frozen=True, eq=False)
class TD3(DeterministicAlgorithm[TD3Config]):
    """Two critics, smoothed targets, and a policy that moves every `policy_delay` critic updates."""

    num_critics: ClassVar[int] = 2

    @property
    def target_noise(self) -> tuple[float, float]:
        return self.config.target_noise, self.config.target_noise_clip
