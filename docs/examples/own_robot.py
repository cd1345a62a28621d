"""Train dm_control's planar walker to walk, with dm_control's own observation and reward.

Needs only the model files: pip install --no-deps dm_control
"""

import dataclasses
from pathlib import Path

import dm_control
import jax.numpy as jnp

import mjx_walk
from mjx_walk.envs import Task, TaskOptions, View
from mjx_walk.envs.resets import with_uniform_noise

MODEL = Path(dm_control.__path__[0]) / "suite" / "walker.xml"


@dataclasses.dataclass
class WalkerOptions(TaskOptions):
    """Settings of the command line, `env.speed=8` for instance."""

    frame_skip: int = 10
    speed: float = 1.0


class Walker(Task):
    """A walker that is paid, in [0, 1] a step, for standing upright and for its speed."""

    XML_FILES = {"v5": str(MODEL)}
    REWARD_TERMS = {"v5": ("reward_walk",)}
    VIEW = View(distance=5.0)
    options: WalkerOptions

    def initial_state(self, key):
        return with_uniform_noise(key, self.init_qpos, self.init_qvel, 0.1)

    def derived_names(self):
        return ("xpos", "xmat", "sensordata")

    def observation_blocks(self):
        return {"orientations": 2 * (self.model.nbody - 1), "height": 1, "qvel": self.model.nv}

    def observe(self, physics, derived):
        return jnp.concatenate([derived["xmat"][1:, [0, 2]].ravel(), derived["xpos"][1, 2:], physics.qvel])

    def reward_and_termination(self, before, physics, derived, carry, action):
        height, upright, speed = derived["xpos"][1, 2], derived["xmat"][1, 8], derived["sensordata"][0]
        is_high = jnp.exp(jnp.log(0.1) * jnp.square(jnp.clip((1.2 - height) / 0.6, 0)))
        stand = (3 * is_high + (1 + upright) / 2) / 4
        move = jnp.clip(1 - (self.options.speed - speed) / self.options.speed, 0, 1)
        reward = stand * (5 * move + 1) / 6
        return {"reward_walk": reward}, reward, jnp.zeros((), bool)


if __name__ == "__main__":
    run = mjx_walk.run(["total_steps=2_000_000"], task=Walker)
    print(run.evaluate(episodes=20))
