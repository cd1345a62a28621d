"""A task as a `brax.envs.Env`, for Brax's wrappers and trainers and for algorithms written against them."""

import dataclasses
import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.base import System
from brax.envs import base
from brax.io import mjcf
from mujoco import mjx

from mjx_walk.envs import NO_TIME_LIMIT, make_env
from mjx_walk.envs.physics.mjx_model import with_newton_solver
from mjx_walk.envs.state import check_action_shape
from mjx_walk.machine.compat import standard_dtypes
from mjx_walk.utils.errors import UserError

__all__ = ["BraxEnv"]

_MODEL_ARRAYS = {field.name for field in dataclasses.fields(mjx.Model)}
_INSTEAD = {
    "gravity": "opt.gravity",
    "viscosity": "opt.viscosity",
    "density": "opt.density",
    "link.inertia.mass": "body_mass",
    "link.inertia.i": "body_inertia",
    "link.inertia.transform.pos": "body_ipos",
    "link.inertia.transform.rot": "body_iquat",
    "link.transform.pos": "body_pos",
    "link.transform.rot": "body_quat",
    "dof.armature": "dof_armature",
    "dof.damping": "dof_damping",
    "dof.stiffness": "jnt_stiffness",
    "dof.limit": "jnt_range",
    "actuator.gear": "actuator_gear",
    "actuator.gain": "actuator_gainprm",
    "actuator.bias_q": "actuator_biasprm",
    "actuator.bias_qd": "actuator_biasprm",
    "actuator.force_range": "actuator_forcerange",
}
"""Fields that MJX reads instead of the values of Brax's own engines."""
_READ_IF_ANY = (
    ("opt.density", "opt.viscosity", "opt.wind"),
    ("dof_frictionloss",),
    ("tendon_frictionloss",),
    ("body_gravcomp",),
)
"""Arrays that MJX reads only if at least one of the group is not zero in the model as it is loaded."""


class BraxEnv(base.Env):
    """One unbatched environment. It is Gymnasium's task, except that actions are Brax's: in [-1, 1] for every motor.

    It has no time limit of its own; Brax's `EpisodeWrapper` adds one, as for Brax's environments.
    """

    def __init__(self, env: str, physics: str = "auto", **keywords: object):
        """
        Args:
            env: name of the task.
            physics: engine.
            keywords: Gymnasium's, and those of `TaskOptions` except the time limit.

        Raises:
            UserError: an unknown name, engine or keyword, or a time limit.
        """
        if "max_episode_steps" in keywords:
            raise UserError("BraxEnv has no time limit; give episode_length=N to Brax's EpisodeWrapper or wrap instead")
        self._task = make_env(env, physics, **keywords | {"max_episode_steps": NO_TIME_LIMIT})
        self._changed_sys: System | None = None

    @property
    def dt(self) -> float:
        """Duration of a step, s."""
        return self._task.dt

    @property
    def sys(self) -> System:
        """Brax's description of the model, with MJX's solver. The control range is that of the actions, [-1, 1].

        With `physics="jax"`, a changed one can be set, as Brax's `DomainRandomizationVmapWrapper` does. The physics
        uses its values, and rewards that read the model's masses or time step keep the original ones. Only arrays of
        `mjx.Model` can change, such as `body_mass`, `actuator_gear` or `opt.gravity`.

        Raises:
            UserError: on setting a changed one with another engine, or with a change that the physics does not read.
        """
        return self._own_sys if self._changed_sys is None else self._changed_sys

    @sys.setter
    def sys(self, sys: System) -> None:
        if self._changed_sys is not None:
            self._change_model({})
            self._changed_sys = None
        own = dict(jax.tree_util.tree_leaves_with_path(self._own_sys))
        leaves = jax.tree_util.tree_leaves_with_path(sys)
        changes = {_dotted(path): leaf for path, leaf in leaves if leaf is not own.get(path)}
        if not changes:
            return
        _check_changes(changes, {_dotted(path): leaf for path, leaf in own.items()})
        _check_switches(changes, self._task.model)
        self._change_model(changes)
        self._changed_sys = sys

    @functools.cached_property
    def _own_sys(self) -> System:
        with jax.ensure_compile_time_eval(), standard_dtypes():
            sys = mjcf.load_model(with_newton_solver(self._task.model))
            limits = jnp.tile(jnp.float32([-1.0, 1.0]), (self._task.action_size, 1))
            return sys.replace(actuator=sys.actuator.replace(ctrl_range=limits))

    def _change_model(self, changes: dict[str, jax.Array]) -> None:
        engine: Any = self._task.engine
        if self.backend != "jax":
            raise UserError(f"physics={self.backend} cannot change its model; use BraxEnv(…, physics='jax')")
        engine.change_model(changes)

    def reset(self, rng: jax.Array) -> base.State:
        """Start an episode at random. `pipeline_state` holds this package's `State`."""
        state = self._task.reset(rng)
        return base.State(state, state.obs, state.reward, jnp.zeros((), jnp.float32), state.metrics)

    def step(self, state: base.State, action: jax.Array) -> base.State:
        """Step once. `done` means that the task ended the episode; the time limit never sets it.

        Raises:
            ValueError: the action has another shape than `[action_size]`.
        """
        check_action_shape(action, (self.action_size,))
        after = self._task.step(state.pipeline_state, self._task.scale_action(action))
        return state.replace(
            pipeline_state=after,
            obs=after.obs,
            reward=after.reward,
            done=jnp.float32(after.terminated),
            metrics=state.metrics | after.metrics,
        )

    @property
    def observation_size(self) -> int:
        return self._task.observation_size

    @property
    def action_size(self) -> int:
        return self._task.action_size

    @property
    def backend(self) -> str:
        return self._task.engine.name


def _check_changes(changes: dict[str, jax.Array], own: dict[str, jax.Array]) -> None:
    """Check that the physics reads what has changed.

    Raises:
        UserError: it does not, or an array has another shape.
    """
    for name, value in changes.items():
        if name.partition(".")[0] not in _MODEL_ARRAYS:
            found = next((new for old, new in _INSTEAD.items() if f"{name}.".startswith(f"{old}.")), None)
            advice = f"{found} instead" if found else "an array of mjx.Model, such as body_mass or opt.gravity"
            raise UserError(f"the physics does not read '{name}' of a Brax system; change {advice}")
        if name not in own or jnp.shape(value) != jnp.shape(own[name]):
            expected = f"has shape {jnp.shape(own[name])}" if name in own else "does not exist"
            raise UserError(f"'{name}' of this model {expected}, not {jnp.shape(value)}; keep the shape of each array")


def _check_switches(changes: dict[str, jax.Array], model: mujoco.MjModel) -> None:
    """Check that MJX computes what has changed. It leaves out what a model does not have when it is loaded.

    Raises:
        UserError: it does not.
    """
    for group in _READ_IF_ANY:
        is_read = any(np.any(operator.attrgetter(array)(model)) for array in group)
        for name in [] if is_read else changes.keys() & set(group):
            raise UserError(f"the model has no {' or '.join(group)}, so MJX does not read '{name}'; give it a value")


def _dotted(path: jax.tree_util.KeyPath) -> str:
    """Path of a leaf as `tree_replace` takes it, such as `opt.gravity`."""
    return jax.tree_util.keystr(path, simple=True, separator=".")
