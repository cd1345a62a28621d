"""Settings that SAC, TD3 and DDPG share."""

import dataclasses

from mjx_walk.common import networks
from mjx_walk.utils.setting_fields import AnyBut, setting

__all__ = ["OffPolicyConfig"]


@dataclasses.dataclass
class OffPolicyConfig:
    """Settings that all off-policy algorithms have."""

    unroll_length: int = setting(4, at_least=1)
    """Steps of each environment between two learning phases. All environments step together."""
    grad_updates_per_step: int = setting(8, at_least=1, search=(0.5, 1, 2))
    """Critic updates for each step of all environments. The update-to-data ratio is this divided by `num_envs`."""
    policy_delay: int = setting(1, at_least=1)
    """Critic updates for each policy update."""
    batch_size: int = setting(4096, at_least=1, search=(0.5, 1, 2))
    """Transitions of one gradient update."""
    replay_capacity: int = setting(1_000_000, at_least=1)
    """Transitions, rounded up to complete unrolls."""
    replay_dtype: str = setting("float32", choices=("float32", "bfloat16"))
    """Dtype of the stored observations."""
    learning_starts: int = setting(10_000, at_least=0)
    """Environment steps before learning starts."""
    random_steps: int | None = setting(None, at_least=0)
    """Environment steps with uniformly random actions. If unset, `learning_starts`, or none with `init_from`."""
    noise_repeat: int | None = setting(1, at_least=1)
    """Steps for which a sample of exploration noise is kept. If unset, those of about 64 ms."""
    n_step: int | None = setting(1, at_least=1, search="1,3,5")
    """Steps whose rewards a critic's target sums up. If unset, those of about 40 ms."""
    discount: float = setting(0.99, at_least=0, at_most=1, search="0.95,0.97,0.98,0.99,0.995,0.999")
    """Discount factor γ of one step."""
    final_discount: float | None = setting(None, at_least=0, below=1)
    """Discount after `schedule_steps`. The horizon 1 / (1 - γ) changes by the same factor at every step."""
    tau: float = setting(0.005, above=0, at_most=1, search="tag(log,interval(0.002,0.05))")
    """Fraction by which target networks move at each update."""
    policy_learning_rate: float = setting(3e-4, above=0, search="tag(log,interval(3e-5,3e-3))")
    """Step size of Adam for the policy."""
    critic_learning_rate: float = setting(3e-4, above=0, search="tag(log,interval(3e-5,3e-3))")
    """Step size of Adam for the critics."""
    learning_rate_schedule: str = setting("constant", choices=("constant", "linear"))
    """`linear`: the rates of policy and critics fall to zero over `schedule_steps`."""
    schedule_steps: int = setting(
        100_000_000,
        at_least=1,
        only_if={"learning_rate_schedule": AnyBut("constant"), "final_discount": AnyBut(None)},
    )
    """Environment steps over which schedules run. Recipes set it to `total_steps`; a resume keeps it."""
    max_grad_norm: float | None = setting(None, above=0)
    """Global norm to which gradients are clipped. If unset, they are not."""
    reward_scale: float = setting(1.0, above=0)
    """Factor of rewards in learning."""
    normalize_rewards: bool = False
    """Divide rewards by the running std of the discounted return, before `reward_scale`."""
    normalized_return_max: float | None = setting(None, above=0, only_if={"normalize_rewards": True})
    """Bound of normalized returns. If a return seen so far would exceed it, rewards are divided by a larger number."""
    normalize_observations: bool = True
    """Shift and scale observations by their running mean and std."""
    observation_clip: float | None = setting(10.0, above=0)
    """Bound of normalized observations."""
    policy_hidden_layer_sizes: tuple[int, ...] = setting((256, 256), at_least=1)
    """Widths of the policy's hidden layers."""
    critic_hidden_layer_sizes: tuple[int, ...] = setting((256, 256), at_least=1)
    """Widths of each critic's hidden layers."""
    policy_layer_norm: bool = False
    """Apply layer normalization in the policy network."""
    critic_layer_norm: bool = False
    """Apply layer normalization in the critics."""
    activation: str = setting("relu", choices=networks.ACTIVATIONS)
    """Activation of hidden layers."""
    network_dtype: str = setting("float32", choices=("float32", "bfloat16"))
    """Dtype in which networks compute. Parameters, losses and optimizers are float32."""
    init_at_random_episode_step: bool = True
    """Start the first episodes, and every second one after a fall, at random step counts, so that time limits do not
    end many episodes at once."""
