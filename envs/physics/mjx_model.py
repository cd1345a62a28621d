"""Functions of both MJX engines: preparing the model and reading derived arrays."""

import copy
import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Int
from mujoco import mjx

from mjx_walk.envs.physics.base import Derived, PhysicsState
from mjx_walk.envs.physics.elements import pairs_that_move

__all__ = [
    "MIN_SOLVER_ITERATIONS",
    "chosen_values",
    "mjx_values",
    "read_derived",
    "solver_iterations",
    "state_of",
    "with_newton_solver",
    "with_state",
]

MIN_SOLVER_ITERATIONS = 8
"""Newton iterations and line-search steps. In float32, 8 give the same result as 50; 4 do only with few contacts."""
_MORE_ITERATIONS = 16
"""For elliptic cones, and for many pairs of geoms.

Largest errors of robots' velocities after 10 substeps from a standing pose, with 8 and with 16 iterations: G1 on `jax`
4.2 and 2.2e-2 rad/s, Spot with its arm on `warp` 0.96 and 1.5e-4. With elliptic cones on `warp`: HyQReal 3.9e-2 and
2.8e-4, Go2 6.4e-3 and 3.8e-5. 50 iterations give the same as 16."""
_FEW_PAIRS = 126
"""Most pairs of geoms that may touch, for `MIN_SOLVER_ITERATIONS`: as many as Humanoid has, for which they suffice."""

_CONTACT_LIMITS = ("max_contact_points", "max_geom_pairs")
"""Custom numbers by which MJX leaves out contacts. MuJoCo does not know them."""


def with_newton_solver(model: mujoco.MjModel) -> mujoco.MjModel:
    """Copy of a model that uses the Newton solver, with enough iterations to converge, and all contacts.

    Deviation: Gymnasium's humanoids use PGS, which MJX does not implement. The constraint problem is convex and has one
    solution. After convergence, the two solvers agree to 1e-6.
    """
    model = copy.deepcopy(model)
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.iterations = model.opt.ls_iterations = solver_iterations(model)
    for name in _CONTACT_LIMITS:
        limit = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
        if limit >= 0:
            model.numeric_data[limit] = -1
    return model


def solver_iterations(model: mujoco.MjModel) -> int:
    """Newton iterations and line-search steps with which the constraint solver converges in float32."""
    is_elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    needs_more = is_elliptic or len(pairs_that_move(model)[0]) > _FEW_PAIRS
    return max(MIN_SOLVER_ITERATIONS, _MORE_ITERATIONS) if needs_more else MIN_SOLVER_ITERATIONS


def with_state(data: mjx.Data, state: PhysicsState) -> mjx.Data:
    """MJX's data with another physics state. Both have the same names."""
    arrays = state._replace(model_index=None)._asdict()
    return data.replace(**{name: array for name, array in arrays.items() if array is not None})


def state_of(data: mjx.Data, model_index: Array | None = None) -> PhysicsState:
    """The physics state that MJX's data hold, with or without a batch axis.

    Args:
        data: MJX's data.
        model_index: of the model with which they were computed, if there are several.
    """
    act = data.act if data.act.shape[-1] else None
    return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart, act, model_index)


def mjx_values(model: mjx.Model, models: Mapping[str, np.ndarray]) -> dict[str, Array]:
    """The values of changed models that MJX has. It has no bounding boxes of bodies, for example."""
    fields = {field.name for field in dataclasses.fields(model)}
    arrays = {name: getattr(model, name) for name in models if name in fields}
    return {
        name: jnp.asarray(models[name], array.dtype)
        for name, array in arrays.items()
        if jnp.issubdtype(array.dtype, jnp.floating)
    }


def chosen_values(values: dict[str, Array], model_index: Int[Array, "*batch"] | None) -> dict[str, Array]:
    """The values of the models of that index; none without an index."""
    return {} if model_index is None else {name: array[model_index] for name, array in values.items()}


def read_derived(data: mjx.Data, shapes: dict[str, tuple[int, ...]], batch: tuple[int, ...] = ()) -> Derived:
    """Derived arrays by name, in MuJoCo's shapes and float32. MJX stores some of them in `_impl`.

    Args:
        data: MJX's data.
        shapes: of `derived_shapes`.
        batch: shape of the batch.
    """
    found = {name: getattr(data, name) if hasattr(data, name) else getattr(data._impl, name) for name in shapes}
    return {name: array.reshape(batch + shapes[name]).astype(jnp.float32) for name, array in found.items()}
