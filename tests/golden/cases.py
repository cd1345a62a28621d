"""The small trainings that the golden gate runs: two settings for each algorithm, and more engines and devices.

Settings carry the names that the reference commit knows; the present tree reads them through its table of renamed
settings. Episodes last three steps, so that truncations, reused resets and finished evaluations occur.
"""

import dataclasses

ON_POLICY = ("ppo", "a2c", "reinforce")
OFF_POLICY = ("sac", "csac", "td3", "ddpg")
NUM_ITERATIONS = 8


@dataclasses.dataclass(frozen=True)
class Case:
    """One training of `NUM_ITERATIONS` iterations, saved and resumed after half of them."""

    name: str
    overrides: tuple[str, ...]
    steps_per_iteration: int
    num_devices: int = 1

    def arguments(self, num_iterations: int) -> list[str]:
        """The command line that trains for a number of iterations, but for the run folder."""
        return [*self.overrides, f"total_steps={num_iterations * self.steps_per_iteration}"]


_COMMON = (
    "env=walker2d",
    "num_envs=8",
    "env.max_episode_steps=3",
    "env.healthy_angle_range=[-0.02,0.02]",
    "evaluation.num_envs=2",
    "evaluation.gymnasium_episodes=3",
    "checkpoint.every_chunks=2",
    "updates_per_chunk=1",
    "algo.schedule_steps=1500",
)
_ON_POLICY = ("algo.unroll_length=8", "algo.measured_steps=16")
_VALUE = ("algo.value_hidden_layer_sizes=[16,16]",)
_OFF_POLICY = (
    "algo.unroll_length=8",
    "algo.updates_per_step=2",
    "algo.batch_size=16",
    "algo.replay_capacity=256",
    "algo.prefill_steps=100",
    "algo.critic_hidden_layer_sizes=[24,24]",
)
_POLICY = ("algo.policy_hidden_layer_sizes=[16,16]",)

_BASE = {
    "ppo": (
        *_ON_POLICY,
        *_VALUE,
        *_POLICY,
        "algo.num_unrolls=2",
        "algo.num_minibatches=4",
        "algo.num_epochs=2",
        "algo.learning_rate=0.003",
        "seed=1",
    ),
    "a2c": (*_ON_POLICY, *_VALUE, *_POLICY, "algo.num_unrolls=2"),
    "reinforce": (*_ON_POLICY, *_POLICY, "algo.num_unrolls=2", "algo.discount=0.6", "algo.num_minibatches=2"),
    "sac": (*_OFF_POLICY, *_POLICY),
    "csac": (*_OFF_POLICY, *_POLICY, "algo.policy_learning_rate=0.01", "seed=2"),
    "td3": (*_OFF_POLICY, *_POLICY, "algo.policy_learning_rate=0.01", "seed=4"),
    "ddpg": (*_OFF_POLICY, *_POLICY, "algo.policy_learning_rate=0.01", "seed=4"),
}
"""Seeds and learning rates are those under which a later policy scores higher than the first."""

_ALL_ON_POLICY = (
    "algo.learning_rate_schedule=adaptive_kl",
    "algo.entropy_schedule=linear",
    "algo.entropy_cost=0.01",
    "algo.network_dtype=bfloat16",
    "algo.observation_clip=3",
)
_ALL_VALUE = ("algo.normalize_rewards=true", "algo.max_value_grad_norm=0.5")
_ALL_OFF_POLICY = (
    "algo.n_step=3",
    "algo.noise_repeat=3",
    "algo.policy_delay=2",
    "algo.final_discount=0.9",
    "algo.learning_rate_schedule=linear",
    "algo.max_grad_norm=0.5",
    "algo.normalize_rewards=true",
    "algo.return_bound=3",
    "algo.reward_scale=0.5",
    "algo.policy_layer_norm=true",
    "algo.critic_layer_norm=true",
    "algo.network_dtype=bfloat16",
    "algo.replay_dtype=bfloat16",
    "algo.observation_clip=3",
)
_EXPLORATION = ("algo.min_exploration_noise=0.05", "algo.max_exploration_noise=0.4")
_ALL = {
    "ppo": (
        *_ALL_ON_POLICY,
        *_ALL_VALUE,
        "algo.distribution=normal",
        "algo.state_dependent_std=true",
        "algo.max_log_std=0.5",
    ),
    "a2c": (
        *_ALL_ON_POLICY,
        *_ALL_VALUE,
        "algo.ou_noise_std=0.3",
        "algo.num_minibatches=2",
        "algo.normalize_advantages=false",
    ),
    "reinforce": (*_ALL_ON_POLICY, "algo.baseline=mean", "algo.mean_bound_cost=0.1"),
    "sac": (*_ALL_OFF_POLICY, "algo.final_target_entropy=-1.0", "algo.init_alpha=0.1"),
    "csac": (*_ALL_OFF_POLICY, "algo.final_target_entropy=-1.0", "algo.num_atoms=31"),
    "td3": (*_ALL_OFF_POLICY, *_EXPLORATION, "algo.target_noise=0.3", "algo.target_noise_clip=0.4"),
    "ddpg": (*_ALL_OFF_POLICY, *_EXPLORATION, "algo.normalize_observations=false", "seed=1"),
}


def _case(name: str, algo: str, *further: str, num_devices: int = 1) -> Case:
    overrides = {item.partition("=")[0]: item for item in (*_COMMON, f"algo={algo}", *_BASE[algo], *further)}
    steps = 8 * 8 * num_devices * (2 if algo in ON_POLICY else 1)
    return Case(name, tuple(overrides.values()), steps, num_devices)


def fast_cases() -> list[Case]:
    """Walker2d on the C library: every algorithm with few settings changed, and with every optional branch on."""
    names = (*ON_POLICY, *OFF_POLICY)
    return [_case(f"{name}-base", name) for name in names] + [_case(f"{name}-all", name, *_ALL[name]) for name in names]


def further_cases() -> list[Case]:
    """The MJX engines on the CPU, two seeds in one program, two processes, several iterations a call, Humanoid."""
    cases = [
        _case(f"{algo}-{engine}", algo, f"physics={engine}", "updates_per_chunk=2")
        for algo in ("ppo", "csac")
        for engine in ("jax", "warp")
    ]
    for algo in (*ON_POLICY, "csac", "td3"):
        cases.append(_case(f"{algo}-seeds", algo, *_ALL[algo], "seed=", "seeds=[2,1]" if algo == "csac" else "seeds=2"))
    for algo in ("ppo", "a2c", "csac"):
        cases.append(_case(f"{algo}-devices", algo, *_ALL[algo], "devices=2", num_devices=2))
    cases.append(
        _case("sac-humanoid", "sac", "env=humanoid", "env.healthy_angle_range=", "evaluation.gymnasium_episodes=0")
    )
    return [dataclasses.replace(case, overrides=_without_empty(case.overrides)) for case in cases]


def _without_empty(overrides: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(item for item in overrides if not item.endswith("="))
