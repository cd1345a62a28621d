"""The small interface between a task and an engine: state and control in, state and derived arrays out."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco
from jax.custom_batching import custom_vmap

Derived = dict[str, jax.Array]
"""MuJoCo arrays by their `mjData` names, as they stand after the call, for example `cinert` `[nbody, 10] f32`."""


class PhysicsState(NamedTuple):
    """All that MuJoCo needs to continue: position, velocity and the solver's starting point."""

    qpos: jax.Array
    """`[nq] f32`, m and rad, quaternions as given (not normalised)."""
    qvel: jax.Array
    """`[nv] f32`, m/s and rad/s."""
    qacc_warmstart: jax.Array
    """`[nv] f32`, m/s² and rad/s²."""


class Engine(Protocol):
    """A stateless physics engine, built for one model, one number of substeps and the derived arrays a task names.

    Both methods are pure, take one unbatched copy and may be nested in `jit`, `vmap` and `scan`.
    """

    name: str
    calls_host: bool
    """It steps by a callback to the host. JAX keeps no program with one in its compile cache."""

    def forward(self, state: PhysicsState) -> Derived:
        """Derived arrays of a state just set, at zero control. Source: Gymnasium's `set_state` (`mj_forward`)."""
        ...

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, Derived, jax.Array]:
        """Advance by the engine's number of substeps under a constant control.

        Args:
            state: physics state of one copy.
            ctrl: `[nu] f32`, in the actuators' units, not clipped.

        Returns:
            The next state; the derived arrays, which for RK4 are those of the last substep's fourth stage; and
            `[] bool`, whether a contact or constraint buffer overflowed on the way.
        """
        ...


EngineFactory = Callable[[mujoco.MjModel, int, tuple[str, ...]], Engine]
"""`(model, num_substeps, derived) → Engine`."""


def batch_once(batch_fn: Callable[..., Any]) -> Callable[..., Any]:
    """Give a function of a whole batch the face of an unbatched one.

    Args:
        batch_fn: takes and returns pytrees whose leaves are `[N, …]`; called with `N = 1` where nothing is vmapped.

    Returns:
        The function of one copy. However many `vmap`s surround it, `batch_fn` is called once, with all copies in
        one axis, so that an engine can size its buffers from `N`.
    """

    @custom_vmap
    def on_batch(*args):
        return batch_fn(*args)

    @on_batch.def_vmap
    def _(axis_size, in_batched, *args):
        args = _broadcast(axis_size, in_batched, args)
        merged = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), args)
        out = on_batch(*merged)
        out = jax.tree.map(lambda x: x.reshape((axis_size, -1, *x.shape[1:])), out)
        return out, jax.tree.map(lambda _: True, out)

    @custom_vmap
    def on_one(*args):
        out = on_batch(*jax.tree.map(lambda x: x[None], args))
        return jax.tree.map(lambda x: x[0], out)

    @on_one.def_vmap
    def _(axis_size, in_batched, *args):
        out = on_batch(*_broadcast(axis_size, in_batched, args))
        return out, jax.tree.map(lambda _: True, out)

    return on_one


def _broadcast(axis_size: int, in_batched, args):
    def widen(x, is_batched):
        return x if is_batched else jnp.broadcast_to(x, (axis_size, *jnp.shape(x)))

    return jax.tree.map(widen, args, tuple(in_batched))
