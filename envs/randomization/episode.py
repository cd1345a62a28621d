"""Draws of an episode: its model, the latency of its actions, noise and pushes."""

import math

import flax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Float, Int, PRNGKeyArray

from mjx_walk.envs.models import is_coordinate
from mjx_walk.envs.option_presets import changes
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.envs.randomization.model_pool import changed_models
from mjx_walk.envs.randomization.options import Randomization, changes_models
from mjx_walk.utils.errors import UserError

__all__ = ["Draws", "Randomizer"]

_MODEL, _EPISODE, _OBSERVATION = 2, 3, 4
"""Numbers that are folded into a key for independent draws. A reset uses 1."""


class Draws(flax.struct.PyTreeNode):
    """The randomness of one episode. A part is None if it is switched off, so that it has no leaf."""

    key: PRNGKeyArray
    """For the following steps."""
    latency: Array | None
    """`[] i32`: physics steps until an action reaches the motors."""
    past_actions: Array | None
    """`[history, action_size] f32`: actions of former steps, the newest first."""
    push_steps: Array | None
    """`[] i32`: environment steps until the next push."""


class Randomizer:
    """Draws randomized physics for the episodes of a task. Without options, it draws and changes nothing."""

    def __init__(
        self,
        options: Randomization,
        model: mujoco.MjModel,
        num_substeps: int,
        action_range: Float[np.ndarray, "2 action_size"],
    ):
        """
        Args:
            options: the ranges.
            model: the original model.
            num_substeps: physics steps of one environment step.
            action_range: lowest and highest actions.

        Raises:
            UserError: a range that ends before it starts, or pushes of a robot that cannot move horizontally.
        """
        for name, value in changes(options).items():
            if isinstance(value, tuple) and value[0] > value[1]:
                raise UserError(f"env.randomize.{name}={list(value)}: give the lower value first")
        self.models = changed_models(model, options) if changes_models(options) else {}
        self._has_draws = bool(options.latency[1] or options.action_noise or options.observation_noise or options.push)
        self.is_on = bool(self.models) or self._has_draws
        self._options = options
        self._num_substeps = num_substeps
        self._center, self._half_range = np.mean(action_range, axis=0), np.ptp(action_range, axis=0) / 2
        self._latency = [round(seconds / model.opt.timestep) for seconds in options.latency]
        self._history = math.ceil(self._latency[1] / num_substeps)
        self._push_steps = [max(1, round(s / (model.opt.timestep * num_substeps))) for s in options.push_seconds]
        self._pushed_axes = [axis for axis in (0, 1) if is_coordinate(model, axis, axis)]
        if options.push and not self._pushed_axes:
            raise UserError(f"env.randomize.push={options.push}: the robot cannot move horizontally; set it to 0")

    def draw_model(self, key: PRNGKeyArray) -> Int[Array, ""] | None:
        """Index of an episode's model; None if no option changes models."""
        if not self.models:
            return None
        return jax.random.randint(jax.random.fold_in(key, _MODEL), (), 0, self._options.num_models)

    def draw_episode(self, key: PRNGKeyArray) -> Draws | None:
        """Draw an episode's latency and the time of its first push; None if nothing but a model is drawn.

        Before the first action reaches them, motors get the center of the action's range.
        """
        if not self._has_draws:
            return None
        key, latency_key, push_key = jax.random.split(jax.random.fold_in(key, _EPISODE), 3)
        shortest, longest = self._latency
        return Draws(
            key=key,
            latency=jax.random.randint(latency_key, (), shortest, longest + 1) if longest else None,
            past_actions=jnp.tile(jnp.float32(self._center), (self._history, 1)) if longest else None,
            push_steps=self._draw_push_steps(push_key) if self._options.push else None,
        )

    def disturb(
        self, draws: Draws | None, physics: PhysicsState, action: Float[Array, " action_size"]
    ) -> tuple[Draws | None, PhysicsState, Float[Array, "*substeps action_size"]]:
        """Push the robot, and make actions noisy and late.

        Args:
            draws: of the step before.
            physics: before the step.
            action: of the policy.

        Returns:
            The next draws; the physics from which the engine steps; and the control, `[num_substeps, action_size]` with
            latency and `[action_size]` without.
        """
        if draws is None:
            return None, physics, action
        key, noise_key, push_key, time_key = jax.random.split(draws.key, 4)
        draws = draws.replace(key=key)
        if self._options.action_noise:
            noise = self._options.action_noise * jax.random.normal(noise_key, action.shape)
            action = action + jnp.float32(self._half_range) * noise
        if draws.push_steps is not None:
            is_due = draws.push_steps <= 0
            physics = self._pushed(physics, push_key, is_due)
            next_time = jnp.where(is_due, self._draw_push_steps(time_key), draws.push_steps - 1)
            draws = draws.replace(push_steps=next_time)
        if draws.latency is None or draws.past_actions is None:
            return draws, physics, action
        actions = jnp.concatenate([action[None], draws.past_actions])
        steps_late = jnp.maximum(draws.latency - jnp.arange(self._num_substeps), 0)
        control = actions[-(-steps_late // self._num_substeps)]
        return draws.replace(past_actions=actions[:-1]), physics, control

    def observe(self, draws: Draws | None, obs: Float[Array, " observation_size"]) -> Float[Array, " observation_size"]:
        """The observation with noise."""
        if draws is None or not self._options.observation_noise:
            return obs
        noise = jax.random.normal(jax.random.fold_in(draws.key, _OBSERVATION), obs.shape)
        return obs + self._options.observation_noise * noise

    def _draw_push_steps(self, key: PRNGKeyArray) -> Int[Array, ""]:
        return jax.random.randint(key, (), self._push_steps[0], self._push_steps[1] + 1)

    def _pushed(self, physics: PhysicsState, key: PRNGKeyArray, is_due: Array) -> PhysicsState:
        """Add a velocity in a random direction. A robot that moves along one axis gets its sign."""
        speed_key, angle_key = jax.random.split(key)
        speed = jnp.where(is_due, jax.random.uniform(speed_key, maxval=self._options.push), 0.0)
        angle = jax.random.uniform(angle_key, maxval=2 * jnp.pi)
        axes = jnp.array(self._pushed_axes)
        direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)])[axes]
        direction = direction if len(axes) == 2 else jnp.sign(direction)
        return physics._replace(qvel=physics.qvel.at[axes].add(speed * direction))
