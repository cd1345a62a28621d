"""Command: contacts of each two kinds of geoms on an MJX engine against the `c` engine.

    python tests/contact_kinds.py --engine warp --depths 0.002 0.01

A body with one geom dips into a fixed one in random orientations. The command prints quantiles of the error of the
velocity after a physics step, relative to one plus its change, and whether the engine warns of the pair or refuses it.
It exits with code 1 if the engine does neither and more than 10% of the errors exceed 1e-3.
"""

import argparse
import itertools
import logging
import os
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_walk.envs.physics import make_engine
from mjx_walk.envs.physics.approximations import warn_of_approximations
from mjx_walk.envs.state import physics_state
from mjx_walk.utils.errors import UserError

GEOMS = {
    "sphere": 'size=".12"',
    "capsule": 'size=".07 .12"',
    "ellipsoid": 'size=".12 .09 .07"',
    "cylinder": 'size=".1 .08"',
    "box": 'size=".12 .1 .07"',
    "mesh": 'mesh="m"',
}
MODEL = """
<mujoco>
  <option timestep="0.004"/>
  <asset><mesh name="m" vertex="-.1 -.08 -.05 .12 -.07 -.06 0 .13 -.04 .02 .01 .11 .09 .06 .05"/></asset>
  <worldbody><geom type="{}" {}/><body><freejoint/><geom type="{}" {}/></body></worldbody>
</mujoco>
"""
HIGHEST = 0.6
"""Height at which no two of them touch, m."""
LARGEST_ERROR = 1e-3


def touching(model: mujoco.MjModel, depth: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random positions in which the deepest contact has some depth, m, or a little less, and random velocities."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    qpos = np.concatenate([rng.uniform(-0.08, 0.08, (count, 3)), rng.normal(size=(count, 4))], axis=1)
    qpos[:, 3:] /= np.linalg.norm(qpos[:, 3:], axis=1, keepdims=True)
    for one in qpos:
        low, high = 0.0, HIGHEST
        for _ in range(22):
            one[2] = (low + high) / 2
            data.qpos[:] = one
            mujoco.mj_forward(model, data)
            if data.contact.dist.min(initial=0.0) < -depth:
                low = one[2]
            else:
                high = one[2]
    return qpos, 0.5 * rng.normal(size=(count, model.nv))


def errors(model: mujoco.MjModel, engine: str, depth: float, count: int) -> np.ndarray:
    """Errors of the states in which the velocity changes by more than 0.2 m/s or rad/s."""
    qpos, qvel = touching(model, depth, count)
    states = jax.vmap(lambda *x: physics_state(model, *x))(qpos, qvel)
    expected, found = (
        np.asarray(jax.jit(jax.vmap(make_engine(one, model, 1, ()).step))(states, jnp.zeros((count, 0)))[0].qvel)
        for one in ("c", engine)
    )
    change = np.abs(expected - qvel).max(axis=1)
    return (np.abs(found - expected).max(axis=1) / (1 + change))[change > 0.2]


class _Kept(logging.Handler):
    """Counts records."""

    count = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.count += 1


def is_warned_of(model: mujoco.MjModel, engine: str) -> bool:
    """Whether an engine warns of a model's contacts."""
    logger, kept = logging.getLogger("mjx_walk.envs.physics.approximations"), _Kept()
    logger.addHandler(kept)
    warn_of_approximations(model, engine, 0)
    logger.removeHandler(kept)
    return kept.count > 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", default="warp", choices=("warp", "jax"))
    parser.add_argument("--depths", nargs="+", type=float, default=[0.002, 0.01], help="m")
    parser.add_argument("--states", type=int, default=128)
    given = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    is_silent = False
    for kinds in itertools.combinations_with_replacement(GEOMS, 2):
        model = mujoco.MjModel.from_xml_string(MODEL.format(kinds[0], GEOMS[kinds[0]], kinds[1], GEOMS[kinds[1]]))
        warned = "warned of" if is_warned_of(model, given.engine) else "as in MuJoCo"
        for depth in given.depths:
            try:
                quantiles = np.quantile(errors(model, given.engine, depth, given.states), (0.5, 0.9, 1.0))
            except UserError as error:
                print(f"{' × '.join(kinds)}: refused: {error}", flush=True)
                break
            is_silent |= warned == "as in MuJoCo" and not quantiles[1] < LARGEST_ERROR
            text = "median {:.1e}, 90% {:.1e}, largest {:.1e}".format(*quantiles)
            print(f"{' × '.join(kinds)}, {depth} m: {warned}, {text}", flush=True)
        jax.clear_caches()
    return int(is_silent)


if __name__ == "__main__":
    sys.exit(main())
