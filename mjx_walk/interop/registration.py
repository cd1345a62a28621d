"""Registration of the tasks with Gymnasium. It imports neither JAX nor MuJoCo, so `import mjx_walk` stays fast."""

import gymnasium

__all__ = ["register"]

_TASKS = {
    "Humanoid": ("humanoid", 1000),
    "HumanoidStandup": ("humanoid_standup", 1000),
    "Walker2d": ("walker2d", 1000),
    "Ant": ("ant", 1000),
    "HalfCheetah": ("half_cheetah", 1000),
    "Hopper": ("hopper", 1000),
    "Swimmer": ("swimmer", 1000),
    "Reacher": ("reacher", 50),
    "Pusher": ("pusher", 100),
    "InvertedPendulum": ("inverted_pendulum", 1000),
    "InvertedDoublePendulum": ("inverted_double_pendulum", 1000),
}
"""Task and time limit in steps, by Gymnasium's name. A test compares them with `mjx_walk.envs.TASKS`."""


def register() -> None:
    """Register every task and version with Gymnasium; names that are registered already stay.

    A version that Gymnasium does not support with today's MuJoCo is registered too: making it says why it is refused.
    """
    for name, (env, max_episode_steps) in _TASKS.items():
        for version in ("v5", "v4"):
            if f"mjx_walk/{name}-{version}" in gymnasium.registry:
                continue
            gymnasium.register(
                f"mjx_walk/{name}-{version}",
                entry_point="mjx_walk.interop.gymnasium_env:MjxWalkEnv",
                vector_entry_point="mjx_walk.interop.gymnasium_vector_env:MjxWalkVectorEnv",
                max_episode_steps=max_episode_steps,
                kwargs={"env": env, "version": version},
            )
