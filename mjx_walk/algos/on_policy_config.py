"""Settings that PPO, A2C and REINFORCE share."""

import dataclasses

from mjx_walk.common import networks
from mjx_walk.utils.setting_fields import AnyBut, setting

__all__ = ["OnPolicyConfig"]


@dataclasses.dataclass
class OnPolicyConfig:
    """Settings that all on-policy algorithms have."""

    unroll_length: int = setting(10, at_least=1, search=(0.5, 1, 2))
    """Steps of one unroll, over which advantages are estimated."""
    num_unrolls: int = setting(4, at_least=1, at_most=2**31 - 1)
    """Unrolls of every environment in one batch."""
    normalizer_warmup_steps_per_env: int = setting(16, at_least=0)
    """First steps of each environment. Their batches only set the scale of observations and rewards. Ten are too few on
    Humanoid, which falls after 24 random actions. Under their scale, positions in the next ten steps are two standard
    deviations from the mean, and learning starts with a KL of 3 to 13."""
    learning_rate: float = setting(3e-4, above=0, search="tag(log,interval(3e-5,3e-3))")
    """Step size of Adam, for policy and value network."""
    learning_rate_schedule: str = setting("constant", choices=("constant", "linear", "adaptive_kl"))
    """`linear`: falls to zero over `schedule_steps`. `adaptive_kl`: as `linear`, and the policy's rate is adapted
    after each batch, so that a batch moves the policy by a KL of about `target_kl`."""
    target_kl: float = setting(
        0.01, above=0, only_if={"learning_rate_schedule": "adaptive_kl"}, search="tag(log,interval(0.005,0.2))"
    )
    """KL divergence of one batch that `adaptive_kl` aims at."""
    schedule_steps: int = setting(
        100_000_000,
        at_least=1,
        only_if={"learning_rate_schedule": AnyBut("constant"), "entropy_schedule": AnyBut("constant")},
    )
    """Environment steps over which schedules run. Recipes set it to `total_steps`; a resume keeps it."""
    max_policy_grad_norm: float = setting(1.0, above=0)
    """Global norm to which the policy's gradient is clipped."""
    max_value_grad_norm: float | None = setting(None, above=0)
    """Global norm to which the value network's gradient is clipped. If unset, `max_policy_grad_norm` clips the joint
    gradient of policy and value, as in Brax."""
    discount: float = setting(0.97, at_least=0, at_most=1, search="0.95,0.97,0.98,0.99,0.995,0.999")
    """Discount factor γ of one step."""
    gae_lambda: float = setting(0.95, at_least=0, at_most=1, search="0.9,0.95,0.98")
    """λ of generalized advantage estimation."""
    entropy_coef: float = setting(1e-3, at_least=0, search="0.0,1e-3,3e-3,8e-3,0.02")
    """Coefficient of the entropy bonus."""
    entropy_schedule: str = setting("constant", choices=("constant", "linear"), only_if={"entropy_coef": AnyBut(0)})
    """`linear`: falls to zero over `schedule_steps`."""
    value_loss_coef: float = setting(0.5, above=0)
    """Coefficient of the squared error. Brax's PPO loss halves it once more."""
    reward_scale: float = setting(0.1, above=0)
    """Factor of rewards in learning."""
    normalize_rewards: bool = False
    """Divide rewards by the running std of the discounted return, before `reward_scale`."""
    normalize_advantages: bool = True
    """Shift and scale advantages to mean 0 and standard deviation 1."""
    observation_clip: float | None = setting(10.0, above=0)
    """Bound of normalized observations."""
    policy_hidden_layer_sizes: tuple[int, ...] = setting((256, 256, 128), at_least=1)
    """Widths of the policy's hidden layers."""
    value_hidden_layer_sizes: tuple[int, ...] = setting((256, 256, 256, 256), at_least=1)
    """Widths of the value network's hidden layers."""
    activation: str = setting("swish", choices=networks.ACTIVATIONS)
    """Activation of hidden layers."""
    network_dtype: str = setting("float32", choices=("float32", "bfloat16"))
    """Dtype in which networks compute. Parameters, losses and optimizers are float32."""
    distribution: str = setting("tanh_normal", choices=("tanh_normal", "normal"))
    """`tanh_normal`: squashed, with a state-dependent std. `normal`: unbounded, with the next four settings."""
    init_noise_std: float = setting(1.0, above=0, only_if={"state_dependent_std": False})
    """Initial std, if it does not depend on the state."""
    state_dependent_std: bool = setting(False, only_if={"distribution": "normal"})
    """Let the policy network compute the std. Otherwise the std is a parameter of its own."""
    min_log_std: float = setting(-20.0, at_least=-80, at_most=80, only_if={"distribution": "normal"})
    """Lower bound of the std's logarithm."""
    max_log_std: float = setting(2.0, at_least=-80, at_most=80, only_if={"distribution": "normal"})
    """Upper bound. A value equal to `min_log_std` fixes the std."""
    init_at_random_episode_step: bool = True
    """Start the first episodes at random step counts, so that time limits do not end all episodes at once."""
