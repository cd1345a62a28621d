"""Locomotion: a robot of a user's model file follows commanded velocities."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray

from mjx_walk.envs.locomotion_rewards import (
    REWARD_TERMS,
    LocomotionStep,
    Weights,
    beyond_limits,
    has_fallen,
    in_body_frame,
    reward_terms,
)
from mjx_walk.envs.physics import Derived, PhysicsState
from mjx_walk.envs.resets import InitialState
from mjx_walk.envs.reward_shaping import Terms
from mjx_walk.envs.robots.metadata import servo_metadata
from mjx_walk.envs.robots.robot import load_robot, with_ground
from mjx_walk.envs.robots.servos import Motors
from mjx_walk.envs.robots.surfaces import Surface, heights, places
from mjx_walk.envs.state import Carry, State
from mjx_walk.envs.task import Task
from mjx_walk.envs.task_options import MAX_FRAME_SKIP, TaskOptions
from mjx_walk.envs.view import View
from mjx_walk.utils.setting_fields import setting

__all__ = ["Locomotion", "LocomotionOptions"]

_CONTROL_SECONDS = 0.02
"""Duration of an environment step by default, s."""
_CONTACT = 0.01
"""A foot touches the floor up to this height, relative to the height of the standing root."""
_DISTANCE = 8.0
"""Distance of the camera from the torso, relative to the height of the standing root."""


@dataclasses.dataclass
class LocomotionOptions(TaskOptions):
    """Env options of `Locomotion`."""

    name: str = setting("locomotion", choices=("locomotion",))
    frame_skip: int = setting(0, at_least=0, at_most=MAX_FRAME_SKIP)
    """Physics steps of one environment step. 0: as many as last 0.02 s."""
    feet: tuple[str, ...] = ()
    """Names of the geoms or bodies that are feet. Default: the limbs that touch the floor in the standing pose."""
    action_scale: float = setting(0.5, above=0)
    """Largest offset of a servo's target from the standing pose, rad."""
    forward_range: tuple[float, float] = (-1.0, 1.0)
    """Range of the commanded forward velocity, m/s."""
    sideways_range: tuple[float, float] = (-0.5, 0.5)
    """Range of the commanded velocity to the left, m/s."""
    turning_range: tuple[float, float] = (-1.0, 1.0)
    """Range of the commanded turning velocity, counterclockwise, rad/s."""
    command_seconds: tuple[float, float] = setting((3.0, 8.0), above=0)
    """Range of the time after which a new command is drawn, s."""
    zero_command_probability: float = setting(0.1, at_least=0, at_most=1)
    """Probability with which a new command asks the robot to stand."""
    velocity_scale: float = setting(0.25, above=0)
    """Squared error at which the velocity terms fall to 1/e, m²/s² and rad²/s²."""
    fall_angle: float = setting(70.0, above=0, at_most=180)
    """Tilt of the torso that ends the episode, degrees."""
    reset_noise_scale: float = setting(0.5, at_least=0)
    """Bound of the uniform noise on the torso's velocities of a reset, m/s and rad/s."""
    motors: Motors = dataclasses.field(default_factory=Motors)
    """Servos of joints for which the model file has none."""
    weights: Weights = dataclasses.field(default_factory=Weights)
    """Weights of the reward terms."""


class Locomotion(Task):
    """A robot with a free joint that follows commanded velocities, from its model file alone.

    An action holds the targets of the position servos, rad. Policies act in [-1, 1]: the offset from the standing pose
    in units of `action_scale`. The motors clip targets to their range. The torso is the body with the free joint. Its x
    axis points forward and its z axis up.

    Source: MuJoCo Playground's `Go1JoystickFlatTerrain` (`_src/locomotion/go1/joystick.py`) for the reward, its weights
    and the observation; mjlab's velocity task (`tasks/velocity/velocity_env_cfg.py`) for the times between commands,
    the probability of a zero command and the fall angle.

    Deviation: the reward is not multiplied by the duration of a step, so that its size is that of Gymnasium's tasks, on
    which the recipes are tuned. It leaves out energy, slip, clearance and height of the feet, and `stand_still`. The
    pose term averages over joints. The observation has no linear velocity, no noise and no history. Commands are drawn
    independently of the previous one. Feet touch the floor by their height, not by a contact sensor, so that all
    engines agree. The episode also ends when the torso touches the floor.
    """

    XML_FILES = {"v5": None}
    REWARD_TERMS = {"v5": REWARD_TERMS}
    MISSING_VERSIONS = {"v4": "locomotion has no equivalent in Gymnasium, so it has no v4"}
    HEIGHT_INDEX = 2
    VIEW = View(elevation=-15.0)

    options: LocomotionOptions

    def __init__(self, options: LocomotionOptions, physics: str = "auto", keep_info: bool = False):
        super().__init__(options, physics, keep_info)
        self.init_qpos = jnp.asarray(self.robot.standing, jnp.float32)
        height = float(self.robot.standing[2] - self.robot.floor)
        self.view = self.view._replace(body=self.robot.root, distance=_DISTANCE * height)

    def load_model(self) -> mujoco.MjModel:
        self.robot = load_robot(self.model_file, self.options.motors, self.options.feet)
        if self.ground.is_on:
            self.robot = with_ground(self.robot, self.ground.added_to(self.robot.spec, self.robot.model))
        self._targets = jnp.asarray(self.robot.targets, jnp.float32)
        self._touch_height = _CONTACT * (self.robot.standing[2] - self.robot.floor)
        return self.robot.model

    def num_substeps(self) -> int:
        return self.options.frame_skip or max(1, round(_CONTROL_SECONDS / self.model.opt.timestep))

    def action_range(self) -> Float[np.ndarray, "2 action_size"]:
        return self.robot.targets + self.options.action_scale * np.array([[-1.0], [1.0]])

    def export_metadata(self) -> dict[str, object]:
        """The servos, the standing pose and the ranges of commands; see `servo_metadata`."""
        forward, sideways, turning = self.options.forward_range, self.options.sideways_range, self.options.turning_range
        ranges = {"forward": forward, "sideways": sideways, "turning": turning}
        return servo_metadata(self.robot) | {"action_scale": self.options.action_scale, "command_ranges": ranges}

    @property
    def terminates_on_fall(self) -> bool:
        return True

    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        """Draw the heading and the torso's velocities of a standing robot."""
        heading_key, velocity_key = jax.random.split(key)
        half = jax.random.uniform(heading_key, minval=-jnp.pi, maxval=jnp.pi) / 2
        w, x, y, z = self.init_qpos[3:7]
        cos, sin = jnp.cos(half), jnp.sin(half)
        turned = jnp.stack([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w])
        scale = self.options.reset_noise_scale
        velocity = jax.random.uniform(velocity_key, (6,), minval=-scale, maxval=scale)
        return self.init_qpos.at[3:7].set(turned), self.init_qvel.at[:6].set(velocity)

    def derived_names(self) -> tuple[str, ...]:
        return ("geom_xpos", "geom_xmat", "actuator_force")

    def observation_blocks(self) -> dict[str, int]:
        servos = self.model.nu
        return {
            "angular_velocity": 3,
            "gravity": 3,
            "joint_positions": servos,
            "joint_velocities": servos,
            "last_action": servos,
            "command": 3,
        }

    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " sensed"]:
        """The robot's own senses.

        It holds the angular velocity in the torso's frame (3, rad/s), the direction of gravity in that frame (3), joint
        positions relative to the standing pose (servos, rad), and joint velocities (servos, rad/s).
        """
        positions = physics.qpos[self.robot.positions] - self._targets
        velocities = physics.qvel[self.robot.velocities]
        return jnp.concatenate([physics.qvel[3:6], self._gravity(physics), positions, velocities])

    def observe_all(self, physics: PhysicsState, derived: Derived, carry: Carry) -> Float[Array, " observation_size"]:
        """The robot's own senses, the last action in [-1, 1] (servos), and the command (3, m/s, m/s and rad/s)."""
        return jnp.concatenate([self.observe(physics, derived), carry["last_action"], carry["command"]])

    def _gravity(self, physics: PhysicsState) -> Float[Array, "3"]:
        return in_body_frame(jnp.array([0.0, 0.0, -1.0]), physics.qpos[3:7])

    def initial_carry(self, key: PRNGKeyArray, physics: PhysicsState, derived: Derived) -> Carry:
        """Key, command `[3]` and steps until the next one; last action `[servos]`; seconds in the air `[feet]`."""
        zeros = {"last_action": jnp.zeros(self.action_size), "air_time": jnp.zeros(len(self.robot.feet))}
        return self._new_command(key) | zeros

    def next_carry(
        self, before: State, physics: PhysicsState, derived: Derived, action: Float[Array, " action_size"]
    ) -> Carry:
        kept = before.memory | {"command_steps": before.memory["command_steps"] - 1}
        drawn = self._new_command(kept["key"])
        is_due = kept["command_steps"] <= 0
        command = {name: jnp.where(is_due, value, kept[name]) for name, value in drawn.items()}
        air_time = jnp.where(self._touches_floor(derived), 0.0, kept["air_time"] + self.dt)
        return command | {"last_action": (action - self._targets) / self.options.action_scale, "air_time": air_time}

    def measures(self, before: State, after: State) -> dict[str, Float[Array, ""]]:
        """Errors of the torso's velocity relative to the command under which the robot acted."""
        command, physics = before.memory["command"], after.physics
        velocity = in_body_frame(physics.qvel[:3], physics.qpos[3:7])
        return {
            "velocity error (m/s)": jnp.linalg.norm(velocity[:2] - command[:2]),
            "turning error (rad/s)": jnp.abs(physics.qvel[5] - command[2]),
        }

    def _new_command(self, key: PRNGKeyArray) -> Carry:
        """Draw a command and the number of steps for which it holds. The next key stays with them."""
        options = self.options
        key, velocity_key, zero_key, time_key = jax.random.split(key, 4)
        low, high = jnp.float32([options.forward_range, options.sideways_range, options.turning_range]).T
        velocity = low + (high - low) * jax.random.uniform(velocity_key, (3,))
        is_zero = jax.random.uniform(zero_key) < options.zero_command_probability
        shortest, longest = options.command_seconds
        seconds = jax.random.uniform(time_key, minval=shortest, maxval=longest)
        return {
            "key": key,
            "command": jnp.where(is_zero, 0.0, velocity),
            "command_steps": jnp.maximum(jnp.round(seconds / self.dt), 1.0).astype(jnp.int32),
        }

    def _height(self, part: Surface, derived: Derived) -> Float[Array, ""]:
        """Height of the lowest point of a part above the ground, m. Infinite for a part without a surface."""
        found = heights(part, derived["geom_xpos"], derived["geom_xmat"])
        if self.ground.is_on:
            found -= self.ground.height(*places(part, derived["geom_xpos"], derived["geom_xmat"]))
        return found.min(initial=jnp.inf) - self.robot.floor

    def _touches_floor(self, derived: Derived) -> Bool[Array, " feet"]:
        return jnp.stack([self._height(foot, derived) for foot in self.robot.feet]) <= self._touch_height

    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        """The reward of the command under which the robot acted. It is the sum of the terms, and at least zero."""
        gravity, angles = self._gravity(physics), physics.qpos[self.robot.positions]
        least_upright = math.cos(math.radians(self.options.fall_angle))
        fallen = has_fallen(gravity, self._height(self.robot.torso, derived), least_upright)
        time_in_air = before.memory["air_time"]
        step = LocomotionStep(
            command=before.memory["command"],
            linear_velocity=in_body_frame(physics.qvel[:3], physics.qpos[3:7]),
            angular_velocity=physics.qvel[3:6],
            vertical_velocity=physics.qvel[2],
            gravity=gravity,
            offsets=angles - self._targets,
            beyond_limits=beyond_limits(angles, *jnp.float32(self.model.actuator_ctrlrange.T)),
            torques=derived["actuator_force"],
            action_change=carry["last_action"] - before.memory["last_action"],
            landed_air_time=time_in_air + self.dt,
            has_landed=(time_in_air > 0.0) & (carry["air_time"] == 0.0),
            has_fallen=fallen,
        )
        terms = reward_terms(self.options.weights, self.options.velocity_scale, step)
        return terms, jnp.maximum(sum(terms.values(), jnp.float32(0.0)), 0.0), fallen
