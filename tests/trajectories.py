"""States that a model visits under random controls, for comparisons of engines."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_walk.envs.physics import PhysicsState, make_engine
from mjx_walk.envs.state import physics_state


def visited_states(model: mujoco.MjModel, num_envs: int, num_steps: int) -> tuple[PhysicsState, jax.Array]:
    """States on trajectories of the `c` engine, and the random control of each.

    Returns:
        The states, with `num_envs * num_steps` as their first axis, and the controls, `[num_envs * num_steps, nu]`.
    """
    rng = np.random.default_rng(0)
    qpos = model.qpos0 + 0.02 * rng.normal(size=(num_envs, model.nq))
    qvel = 0.5 * rng.normal(size=(num_envs, model.nv))
    state = jax.vmap(lambda *x: physics_state(model, *x))(qpos, qvel)
    step = jax.jit(jax.vmap(make_engine("c", model, 3, ()).step))
    states, controls = [], []
    for _ in range(num_steps):
        states.append(state)
        controls.append(jnp.float32(rng.uniform(-2, 2, (num_envs, model.nu))))
        state = step(state, controls[-1])[0]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *states), jnp.concatenate(controls)
