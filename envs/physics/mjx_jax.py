"""The `jax` engine: MJX's JAX implementation, on any JAX device."""

import functools
import operator
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from mujoco import mjx
from mujoco.mjx._src import forward as mjx_forward
from mujoco.mjx._src import scan as mjx_scan
from mujoco.mjx._src import sensor as mjx_sensor
from mujoco.mjx._src import smooth as mjx_smooth

from mjx_walk.envs.physics import capsule_frames_jax, implicit_jax, static_pairs
from mjx_walk.envs.physics.base import Derived, PhysicsState
from mjx_walk.envs.physics.derived_arrays import LATE_ARRAYS, derived_shapes
from mjx_walk.envs.physics.jax_model import adapt_model
from mjx_walk.envs.physics.mjx_model import (
    chosen_values,
    mjx_values,
    read_derived,
    state_of,
    with_newton_solver,
    with_state,
)
from mjx_walk.envs.physics.preparation import Preparation

__all__ = ["JaxEngine"]

_RK4_STEP = (0.0, 0.5, 0.5, 1.0)
_RK4_WEIGHT = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


class JaxEngine:
    """MJX in float32. It multiplies matrices at full precision, independent of the networks' matmul precision."""

    name = "jax"
    calls_host = False

    def __init__(
        self, model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...], models: Mapping[str, np.ndarray]
    ):
        capsule_frames_jax.install()
        static_pairs.install()
        model = with_newton_solver(model)
        adapt_model(model)
        self._model = self._own_model = mjx.put_model(model, impl="jax")
        self._blank = mjx.make_data(model, impl="jax")
        self._substep = _SUBSTEPS[mujoco.mjtIntegrator(model.opt.integrator)]
        self._num_substeps = num_substeps
        self.preparation = Preparation()
        self._derived = derived_shapes(model, derived)
        self._values = mjx_values(self._own_model, models)

    def change_model(self, changes: dict[str, Array]) -> None:
        """Step a changed model from now on, for domain randomization. A program compiled before keeps its model.

        Args:
            changes: new values of `mjx.Model` by their paths, such as `body_mass` or `opt.gravity`, in the shapes of
                the old ones. They may be traced. An empty dict restores the model.
        """
        own = self._own_model
        changes = {path: jnp.asarray(value, operator.attrgetter(path)(own).dtype) for path, value in changes.items()}
        self._model = own.tree_replace(changes) if changes else own

    def _model_of(self, state: PhysicsState) -> mjx.Model:
        values = chosen_values(self._values, state.model_index)
        return self._model.tree_replace(values) if values else self._model

    def forward(self, state: PhysicsState) -> Derived:
        """See `Engine.forward`."""
        with jax.default_matmul_precision("highest"):
            data = _forward(self._model_of(state), with_state(self._blank, state))
        return read_derived(data.replace(qpos=state.qpos), self._derived)  # MJX normalizes its quaternions

    def step(
        self, state: PhysicsState, ctrl: Float[Array, "*substeps nu"]
    ) -> tuple[PhysicsState, Derived, Bool[Array, ""]]:
        """See `Engine.step`. No buffer overflows: MJX allocates every possible contact."""
        with jax.default_matmul_precision("highest"):
            model = self._model_of(state)
            controls = ctrl if ctrl.ndim == 2 else None
            data = with_state(self._blank, state).replace(ctrl=ctrl if controls is None else ctrl[0])

            def substep(data, control):
                return self._substep(model, data if control is None else data.replace(ctrl=control)), None

            data, _ = jax.lax.scan(substep, data, controls, length=self._num_substeps)
            if self._derived.keys() & LATE_ARRAYS:
                data = mjx_smooth.rne_postconstraint(model, data)
        return state_of(data, state.model_index), read_derived(data, self._derived), jnp.zeros((), bool)


def _forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.forward`, and the sensors of accelerations, which it leaves out for a model without constraints.

    MJX cannot compute them where `<flag constraint>` is off. A task that reads them there is refused.
    """
    data = mjx_forward.forward(model, data)
    is_left_out = data._impl.efc_J.size == 0 and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return mjx_sensor.sensor_acc(model, data) if is_left_out else data


def _euler(model: mjx.Model, start: mjx.Data) -> mjx.Data:
    """Advance by one substep with semi-implicit Euler and implicit joint damping. Source: MuJoCo's `mj_Euler`.

    Euler factorizes the mass matrix a second time, with the damping. Each factorization of a large batch waits for
    XLA's threads while it occupies one of them. On a CPU with two threads, two at the same time would wait for each
    other forever. The added zero makes the second one wait for the accelerations, which need the first.
    """
    return mjx_forward.euler(model, _factorized_later(model, _forward(model, start)))


def _implicitfast(model: mjx.Model, start: mjx.Data) -> mjx.Data:
    """Advance by one substep with MuJoCo's `implicitfast`. It factorizes twice, as `_euler` does."""
    data = _factorized_later(model, _forward(model, start))
    return mjx_forward._advance(model, data, data.act_dot, implicit_jax.acceleration(model, data))


def _factorized_later(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Data whose mass matrix is known only after the accelerations are."""
    return data.tree_replace({"_impl.M": data._impl.M + 0.0 * data.qacc[0]}) if model.nv else data


def _runge_kutta_4(model: mjx.Model, start: mjx.Data) -> mjx.Data:
    """Advance by one substep, with a single traced `forward` for all four stages.

    Source: MuJoCo's `mj_RungeKutta`. `mjx.step` compiles `forward` four times; once halves the compile time.
    """
    dt = model.opt.timestep

    def stage(carry, coefficients):
        data, velocity, velocity_sum, acceleration_sum, act_dot_sum = carry
        step, weight = coefficients
        qpos = jnp.where(step == 0, start.qpos, _integrate_position(model, start.qpos, step * velocity))
        velocity = start.qvel + step * data.qacc * dt
        act = data.act if act_dot_sum is None else start.act + step * dt * data.act_dot
        data = _forward(model, data.replace(qpos=qpos, qvel=velocity, act=act))
        velocity_sum, acceleration_sum = velocity_sum + weight * velocity, acceleration_sum + weight * data.qacc
        act_dot_sum = None if act_dot_sum is None else act_dot_sum + weight * data.act_dot
        return (data, velocity, velocity_sum, acceleration_sum, act_dot_sum), None

    zeros = jnp.zeros_like(start.qvel)
    table = (jnp.array(_RK4_STEP, dt.dtype), jnp.array(_RK4_WEIGHT, dt.dtype))
    sums = (zeros, zeros, jnp.zeros_like(start.act) if model.na else None)
    (data, _, velocity, acceleration, act_dot), _ = jax.lax.scan(stage, (start, zeros, *sums), table)
    if model.na:
        data = data.replace(act=mjx_forward._next_activation(model, data.replace(act=start.act), act_dot))
    return data.replace(
        qpos=_integrate_position(model, start.qpos, velocity),
        qvel=start.qvel + dt * acceleration,
        qacc_warmstart=data.qacc,
        time=start.time + dt,
    )


def _integrate_position(
    model: mjx.Model, qpos: Float[Array, " nq"], velocity: Float[Array, " nv"]
) -> Float[Array, " nq"]:
    """Position after one substep at a constant velocity. Source: MuJoCo's `mj_integratePos`."""
    integrate = functools.partial(mjx_forward._integrate_pos, dt=model.opt.timestep)
    return mjx_scan.flat(model, integrate, "jqv", "q", model.jnt_type, qpos, velocity)


_SUBSTEPS = {
    mujoco.mjtIntegrator.mjINT_EULER: _euler,
    mujoco.mjtIntegrator.mjINT_RK4: _runge_kutta_4,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST: _implicitfast,
}
"""Function of a substep by the model's integrator."""
