"""The tasks under names that `gymnasium.make` knows. Light: neither JAX nor MuJoCo is imported for it."""

import gymnasium


def register() -> None:
    """Tell Gymnasium of all tasks, once."""
    for name, env in (("Humanoid", "humanoid"), ("HumanoidStandup", "humanoid_standup"), ("Walker2d", "walker2d")):
        for version in ("v5", "v4"):
            if f"mjx_walk/{name}-{version}" in gymnasium.registry:
                continue
            gymnasium.register(
                f"mjx_walk/{name}-{version}",
                entry_point="mjx_walk.interop.gymnasium_env:SingleEnv",
                vector_entry_point="mjx_walk.interop.gymnasium_env:ManyEnvs",
                max_episode_steps=1000,
                kwargs={"env": env, "version": version},
            )
