"""Elements of a model that can make a constraint: pairs of geoms, and the settings of each constraint."""

from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Int, Shaped

from mjx_walk.envs.physics.feature_table import Mask

__all__ = ["constraint_settings", "contact_friction", "moving_bodies", "names_of_pair", "pairs_that_move"]


def pairs_that_move(model: mujoco.MjModel) -> tuple[Int[np.ndarray, "n 2"], Int[np.ndarray, " n"]]:
    """Pairs of geoms that may touch, of which at least one moves, and the indices of their `<pair>`, or -1."""
    from mjx_walk.machine import quiet_mjx  # noqa: F401  # isort: skip
    from mjx_walk.envs.physics.static_pairs import moving_pairs

    is_off = model.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    pairs = np.array([] if is_off else [*moving_pairs(model)], int).reshape(-1, 3)
    return pairs[:, :2], pairs[:, 2]


def contact_friction(
    model: mujoco.MjModel, geoms: Int[np.ndarray, "n 2"], pairs: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " n"], Shaped[np.ndarray, " n"]]:
    """Dimension and sliding friction of the contacts of pairs of geoms, as C combines them."""
    priority = model.geom_priority[geoms]
    is_used = priority == priority.max(axis=1, keepdims=True)
    condim = np.where(is_used, model.geom_condim[geoms], 0).max(axis=1)
    friction = np.where(is_used, model.geom_friction[geoms, 0], 0.0).max(axis=1)
    is_own = pairs >= 0
    condim[is_own], friction[is_own] = model.pair_dim[pairs[is_own]], model.pair_friction[pairs[is_own], 0]
    return condim, friction


def names_of_pair(model: mujoco.MjModel, geoms: Int[np.ndarray, " 2"]) -> str:
    """Two geoms by their names or indices."""
    return "geoms " + " and ".join(f"'{model.geom(int(geom)).name or geom}'" for geom in geoms)


def moving_bodies(model: mujoco.MjModel) -> Mask:
    """Bodies with a degree of freedom."""
    return model.body_dofnum[model.body_weldid] > 0


def constraint_settings(
    model: mujoco.MjModel,
) -> Iterator[tuple[str, int, Shaped[np.ndarray, " 2"], Shaped[np.ndarray, " 5"]]]:
    """Kind and index of each element that can make a constraint, with its `solref` and `solimp`."""
    geoms, pairs = pairs_that_move(model)
    for geom in map(int, np.unique(geoms[pairs < 0])):
        yield "geom", geom, model.geom_solref[geom], model.geom_solimp[geom]
    for pair in map(int, pairs[pairs >= 0]):
        yield "pair", pair, model.pair_solref[pair], model.pair_solimp[pair]
        yield "pair", pair, model.pair_solreffriction[pair], model.pair_solimp[pair]
    for joint in np.flatnonzero(model.jnt_limited):
        yield "joint", int(joint), model.jnt_solref[joint], model.jnt_solimp[joint]
    for dof in np.flatnonzero(model.dof_frictionloss):
        yield "joint", int(model.dof_jntid[dof]), model.dof_solref[dof], model.dof_solimp[dof]
    for tendon in np.flatnonzero(model.tendon_limited):
        yield "tendon", int(tendon), model.tendon_solref_lim[tendon], model.tendon_solimp_lim[tendon]
    for tendon in np.flatnonzero(model.tendon_frictionloss):
        yield "tendon", int(tendon), model.tendon_solref_fri[tendon], model.tendon_solimp_fri[tendon]
    for eq in np.flatnonzero(model.eq_active0):
        yield "eq", int(eq), model.eq_solref[eq], model.eq_solimp[eq]
