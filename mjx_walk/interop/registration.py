"""Registration of the tasks with Gymnasium. It imports neither JAX nor MuJoCo, so `import mjx_walk` stays fast."""

import gymnasium


def register() -> None:
    """Register every task and version with Gymnasium; names that are registered already stay."""
    for name, env in (("Humanoid", "humanoid"), ("HumanoidStandup", "humanoid_standup"), ("Walker2d", "walker2d")):
        for version in ("v5", "v4"):
            if f"mjx_walk/{name}-{version}" in gymnasium.registry:
                continue
            gymnasium.register(
                f"mjx_walk/{name}-{version}",
                entry_point="mjx_walk.interop.gymnasium_env:MjxWalkEnv",
                vector_entry_point="mjx_walk.interop.gymnasium_env:MjxWalkVectorEnv",
                max_episode_steps=1000,
                kwargs={"env": env, "version": version},
            )
