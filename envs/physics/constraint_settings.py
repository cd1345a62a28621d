"""Elements whose `solref` or `solimp` MuJoCo replaces or reads otherwise than MJX, for the table of `supported`."""

from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Shaped

from mjx_walk.envs.physics.elements import name_of, pairs_that_move

__all__ = ["mixed_solrefs", "solimps_without_width"]


def mixed_solrefs(model: mujoco.MjModel) -> Iterator[str]:
    """Elements with a `solref` of one positive number. MuJoCo puts its default there, MJX takes the numbers."""
    for kind, index, solref, _ in _used(model):
        if (solref[0] > 0) != (solref[1] > 0):
            yield name_of(model, kind, index)


def solimps_without_width(model: mujoco.MjModel) -> Iterator[str]:
    """Elements with a `solimp` of width zero, where MuJoCo takes the mean of `dmin` and `dmax`."""
    for kind, index, _, (dmin, dmax, width, *_) in _used(model):
        if width <= mujoco.mjMINVAL and dmin != dmax:
            yield name_of(model, kind, index)


def _used(
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
