"""The interface between tasks and engines: physics state and control in, physics state and derived arrays out."""

from collections.abc import Callable
from typing import NamedTuple, ParamSpec, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_batching import custom_vmap
from jaxtyping import Bool, Float

from mjx_walk.envs.physics.preparation import Preparation
from mjx_walk.machine.compat import standard_dtypes

__all__ = ["Derived", "Engine", "PhysicsState", "Simulator", "batch_once"]

Derived = dict[str, Array]
"""MuJoCo arrays by their `mjData` names, for example `cinert`, `[nbody, 10] f32`."""


class PhysicsState(NamedTuple):
    """The complete state of a MuJoCo simulation.

    It is position, velocity, initial guess of the constraint solver, activations of actuators, and the model.
    """

    qpos: Array
    """`[nq] f32`, m and rad. Quaternions need not be normalized."""
    qvel: Array
    """`[nv] f32`, m/s and rad/s."""
    qacc_warmstart: Array
    """`[nv] f32`, m/s² and rad/s²."""
    act: Array | None = None
    """`[na] f32`, activations of actuators. None in a model without them, so that such states keep their leaves."""
    model_index: Array | None = None
    """`[] i32`, which of the engine's changed models this is. None if the engine has one model."""


class Simulator(Protocol):
    """What the trainer asks of whatever simulates a task."""

    name: str
    calls_host: bool
    """Whether it steps in a host callback. JAX does not cache compiled programs that contain one."""
    preparation: Preparation
    """Work that must end before its programs run."""


class Engine(Simulator, Protocol):
    """A physics engine for one model, one number of substeps and one list of derived arrays.

    Both methods are pure functions of one unbatched environment and support `jit`, `vmap` and `scan`.
    """

    def forward(self, state: PhysicsState) -> Derived:
        """Derived arrays of a new state at zero control. Source: Gymnasium's `set_state` (`mj_forward`).

        `LATE_ARRAYS` are zeros, unless a sensor needs them.
        """
        ...

    def step(
        self, state: PhysicsState, ctrl: Float[Array, "*substeps nu"]
    ) -> tuple[PhysicsState, Derived, Bool[Array, ""]]:
        """Advance by the engine's number of substeps.

        Args:
            state: physics state of one environment.
            ctrl: in the actuators' units, not clipped: `[nu]`, or `[num_substeps, nu]` for a control that changes.

        Returns:
            The next state; the derived arrays of the last forward pass, which precede the last integration: with Euler
            those at the start of the last substep, with RK4 those of its fourth stage; and whether a contact or
            constraint buffer overflowed. `LATE_ARRAYS` are those of `mj_rnePostConstraint` after the integration.
        """
        ...


_Arguments = ParamSpec("_Arguments")
_Outputs = TypeVar("_Outputs")


def batch_once(batch_fn: Callable[_Arguments, _Outputs]) -> Callable[_Arguments, _Outputs]:
    """Turn a batched function into an unbatched one that is called once per batch under `vmap`.

    Args:
        batch_fn: takes and returns pytrees whose leaves are `[N, …]`. Without `vmap`, N is 1.

    Returns:
        A function of one environment. Nested `vmap`s call `batch_fn` once, with all environments on one axis, so that
        an engine can size its buffers by N.
    """

    @custom_vmap
    @standard_dtypes()  # `vmap` may trace this after `Task.step` has returned
    def on_batch(*args):
        return batch_fn(*args)  # type: ignore[call-arg]  # there are no keyword arguments

    @on_batch.def_vmap
    def _(axis_size, in_batched, *args):
        args = jax.tree.map(
            lambda x, is_batched: x if is_batched else jnp.broadcast_to(x, (axis_size, *jnp.shape(x))),
            args,
            tuple(in_batched),
        )
        out = on_batch(*jax.tree.map(lambda x: jax.lax.collapse(x, 0, 2), args))
        out = jax.tree.map(lambda x: x.reshape((axis_size, len(x) // axis_size, *x.shape[1:])), out)
        return out, jax.tree.map(lambda _: True, out)

    def on_one(*args):
        out = on_batch(*jax.tree.map(lambda x: jnp.expand_dims(x, 0), args))
        return jax.tree.map(lambda x: jnp.squeeze(x, 0), out)

    return on_one  # type: ignore[return-value]  # there are no keyword arguments
