"""The `jax` engine: MJX's own JAX implementation, on any device that JAX knows."""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx
from mujoco.mjx._src import forward as mjx_forward
from mujoco.mjx._src import scan as mjx_scan
from mujoco.mjx._src import smooth as mjx_smooth

from mjx_walk.envs.physics import capsule_frames_jax
from mjx_walk.envs.physics.base import Derived, PhysicsState
from mjx_walk.envs.physics.mjx_model import read_derived, with_newton_solver

_RK4_STEP = (0.0, 0.5, 0.5, 1.0)
_RK4_WEIGHT = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


class JaxEngine:
    """MJX in float32. The networks' matmul precision does not reach it: its products are always full float32."""

    name = "jax"
    calls_host = False

    def __init__(self, model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]):
        if model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4:
            raise ValueError("the jax engine integrates with RK4 only; set integrator='RK4' in the model")
        capsule_frames_jax.install()
        model = with_newton_solver(model)
        self._model = mjx.put_model(model, impl="jax")
        self._blank = mjx.make_data(model, impl="jax")
        self._num_substeps = num_substeps
        self._derived = derived

    def _data(self, state: PhysicsState) -> mjx.Data:
        return self._blank.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart)

    def forward(self, state: PhysicsState) -> Derived:
        """Derived arrays of a state just set, at zero control; `cfrc_ext` is zero, as `mj_forward` leaves it."""
        with jax.default_matmul_precision("highest"):
            return read_derived(mjx.forward(self._model, self._data(state)), self._derived)

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, Derived, jax.Array]:
        """Advance by `num_substeps`; see `Engine.step`. Nothing overflows: every possible contact has its place."""
        with jax.default_matmul_precision("highest"):
            data = self._data(state).replace(ctrl=ctrl)
            data, _ = jax.lax.scan(lambda d, _: (_runge_kutta_4(self._model, d), None), data, length=self._num_substeps)
            if "cfrc_ext" in self._derived:
                data = mjx_smooth.rne_postconstraint(self._model, data)
        state = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
        return state, read_derived(data, self._derived), jnp.zeros((), bool)


def _runge_kutta_4(model: mjx.Model, start: mjx.Data) -> mjx.Data:
    """One substep, all four stages through a single traced `forward`.

    Source: MuJoCo's `mj_RungeKutta`. `mjx.step` traces `forward` four times; one trace halves the compile time.
    """
    dt = model.opt.timestep

    def move(velocity):
        return mjx_scan.flat(
            model,
            lambda *args: mjx_forward._integrate_pos(*args, dt=dt),
            "jqv",
            "q",
            model.jnt_type,
            start.qpos,
            velocity,
        )

    def stage(carry, coefficients):
        data, velocity, velocity_sum, acceleration_sum = carry
        step, weight = coefficients
        qpos = jnp.where(step == 0, start.qpos, move(step * velocity))
        velocity = start.qvel + step * data.qacc * dt
        data = mjx.forward(model, data.replace(qpos=qpos, qvel=velocity))
        return (data, velocity, velocity_sum + weight * velocity, acceleration_sum + weight * data.qacc), None

    zeros = jnp.zeros_like(start.qvel)
    table = (jnp.array(_RK4_STEP, dt.dtype), jnp.array(_RK4_WEIGHT, dt.dtype))
    (data, _, velocity, acceleration), _ = jax.lax.scan(stage, (start, zeros, zeros, zeros), table)
    return data.replace(
        qpos=move(velocity), qvel=start.qvel + dt * acceleration, qacc_warmstart=data.qacc, time=start.time + dt
    )
