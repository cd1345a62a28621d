"""Changed physics in the real Gymnasium: friction, mass, weaker motors, late actions and pushes.

They change the model of one environment and wrap its simulation steps. Observations, rewards and terminations stay
Gymnasium's own code.
"""

import collections
import math
from typing import NamedTuple

import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from jaxtyping import Float

from mjx_walk.envs.randomization.edits import first_moving_body, scale_friction, scale_mass, scale_strength

__all__ = ["Perturbation", "perturb"]

_SECONDS_BETWEEN_PUSHES = 2.0


class Perturbation(NamedTuple):
    """Changes of the physics of one environment. The defaults change nothing."""

    friction: float = 1.0
    """Factor of the sliding friction of every geom."""
    mass: float = 1.0
    """Factor of the mass and inertia of every body."""
    torque: float = 1.0
    """Factor of the force of every motor, and of its limits."""
    latency: float = 0.0
    """Time until an action reaches the motors, s, rounded to physics steps. Before the first one, the control is 0."""
    push: float = 0.0
    """Change of the velocity of the center of mass of a free body, m/s, every two seconds in a random horizontal
    direction. A body that is fixed to the world gets the same impulse."""


def perturb(env: MujocoEnv, perturbation: Perturbation, seed: int) -> None:
    """Change the physics of an environment for one episode, before its reset.

    Args:
        env: an environment of Gymnasium, without wrappers.
        perturbation: the changes.
        seed: of the directions of the pushes.
    """
    model = env.model
    scale_friction(model, perturbation.friction)
    if perturbation.mass != 1.0:
        scale_mass(model, perturbation.mass)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    scale_strength(model, perturbation.torque)
    if perturbation.latency or perturbation.push:
        env.do_simulation = _Simulation(env, perturbation, seed).advance  # type: ignore[method-assign]


class _Simulation:
    """The simulation steps of one environment, with late actions and pushes."""

    def __init__(self, env: MujocoEnv, perturbation: Perturbation, seed: int):
        self._env = env
        self._push = perturbation.push
        self._random = np.random.default_rng(seed)
        num_late = round(perturbation.latency / env.model.opt.timestep)
        self._controls = collections.deque([np.zeros(env.model.nu)] * num_late)
        self._num_pushes = 0

    def advance(self, ctrl: Float[np.ndarray, " nu"], n_frames: int) -> None:
        """Source: `MujocoEnv.do_simulation`."""
        model, data = self._env.model, self._env.data
        if self._push and data.time >= (self._num_pushes + 1) * _SECONDS_BETWEEN_PUSHES:
            self._num_pushes += 1
            _push(model, data, self._push, self._random.uniform(0.0, 2 * math.pi))
        for _ in range(n_frames):
            self._controls.append(ctrl)
            data.ctrl[:] = self._controls.popleft()
            mujoco.mj_step(model, data)
        mujoco.mj_rnePostConstraint(model, data)


def _push(model: mujoco.MjModel, data: mujoco.MjData, velocity: float, angle: float) -> None:
    """Add the velocities that a horizontal impulse on the robot's first body causes.

    Args:
        model: the model.
        data: its state, which is changed.
        velocity: the impulse divided by the mass of the body and all its descendants, m/s.
        angle: direction of the impulse, rad. A body that moves along one horizontal axis gets its sign.
    """
    body = first_moving_body(model)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, data.xipos[body], body)
    direction = np.array([math.cos(angle), math.sin(angle), 0.0])
    moves = np.abs(jacobian[:2]).max(axis=1) > mujoco.mjMINVAL
    if moves.sum() == 1:
        direction = np.append(np.where(moves, math.copysign(1.0, direction[0]), 0.0), 0.0)
    impulse = velocity * model.body_subtreemass[body] * direction
    change = np.zeros((1, model.nv))
    mujoco.mj_solveM(model, data, change, (impulse @ jacobian)[None])
    data.qvel[:] += change[0]
