"""Bases of the tasks in which a body moves through the world: resets, observation, and what a healthy body gets."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray

from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.resets import InitialState, with_uniform_noise
from mjx_walk.envs.task import Task
from mjx_walk.envs.task_options import TaskOptions

__all__ = ["Body", "BodyOptions", "HealthOptions", "HealthyBody", "is_within"]


class BodyOptions(TaskOptions):
    """Keyword arguments that `Body` reads. The dataclass of each task defines them, in Gymnasium's order."""

    reset_noise_scale: float
    exclude_current_positions_from_observation: bool


class Body(Task):
    """A body that is observed in its own coordinates, without its place in the world."""

    NUM_PLACE_COORDINATES: int = 2
    """Leading coordinates that say where the body is. The observation leaves them out by default."""

    options: BodyOptions

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        """Draw uniform noise on positions and velocities."""
        return with_uniform_noise(key, self.init_qpos, self.init_qvel, self.options.reset_noise_scale)

    def derived_names(self) -> tuple[str, ...]:
        return ()

    @property
    def _num_hidden(self) -> int:
        return self.NUM_PLACE_COORDINATES * self.options.exclude_current_positions_from_observation

    def observation_blocks(self) -> dict[str, int]:
        return {"qpos": self.model.nq - self._num_hidden, "qvel": self.model.nv}

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        """Observation: positions without the place, then all velocities."""
        return jnp.concatenate([physics.qpos[self._num_hidden :], physics.qvel])


class HealthOptions(TaskOptions):
    """Keyword arguments that `HealthyBody` reads. The dataclass of each task defines them, in Gymnasium's order."""

    healthy_reward: float
    terminate_when_unhealthy: bool


class HealthyBody(Task):
    """A body that must not fall: each step in which it is healthy is rewarded, and others end the episode."""

    options: HealthOptions

    @property
    def terminates_on_fall(self) -> bool:
        return self.options.terminate_when_unhealthy

    def survival(self, is_healthy: Bool[Array, ""]) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """The healthy reward of a step, and whether it terminates the episode. v4 also pays in the step that does."""
        ends = self.options.terminate_when_unhealthy
        is_paid = is_healthy | (ends and self.options.version == "v4")
        return self.options.healthy_reward * is_paid, ~is_healthy & ends


def is_within(value: Float[Array, "*shape"], bounds: tuple[float, float]) -> Bool[Array, "*shape"]:
    """Whether values lie between two bounds, and equal neither."""
    return (bounds[0] < value) & (value < bounds[1])
