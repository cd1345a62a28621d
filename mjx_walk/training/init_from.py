"""The networks that a training begins with, if they come from another run or from the zoo."""

import logging
from pathlib import Path
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array

from mjx_walk import zoo
from mjx_walk.algos import Algorithm, TrainState, with_replay_of, without_replay
from mjx_walk.evaluation.saved_policies import choose_policy, load_policy
from mjx_walk.settings.config import Config
from mjx_walk.settings.saved_config import read_saved_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import PolicyParams, leaves_with

__all__ = ["Networks", "begin_with", "read_networks"]

_LOGGER = logging.getLogger(__name__)


class Networks(NamedTuple):
    """What a training takes from another one: all networks and running statistics, or the policy alone."""

    leaves: dict[str, Array]
    """Leaves of its TrainState, by their paths."""
    policy: PolicyParams | None


def read_networks(config: Config, algorithm: Algorithm) -> Networks | None:
    """The networks that `init_from` names.

    From a run of the same algorithm, those of the newest checkpoint. From another one, and from the zoo, the best
    policy with its normalizer.

    Args:
        config: of the training. None is read without `init_from`, or where the run itself has a checkpoint.
        algorithm: its algorithm.

    Raises:
        UserError: there is no such run, or its networks have other sizes.
    """
    if not config.init_from or (config.resume and _has_checkpoint(RunFolder(Path(str(config.run_dir))))):
        return None
    folder = zoo.open_run(config.init_from)
    shapes = algorithm.state_shapes()
    try:
        if read_saved_config(folder).algo.name == config.algo.name and _has_checkpoint(folder):
            leaves, metadata = checkpoint.restore_newest(folder.checkpoints, _inherited(shapes))
            _LOGGER.info(f"Training begins with the networks of {config.init_from}, step {metadata['env_steps']:,}")
            return Networks(cast(dict[str, Array], leaves), None)
        name = choose_policy(folder, BEST)
        policy, metadata = load_policy(folder, name, jax.eval_shape(algorithm.policy_params, shapes))
    except UserError as error:
        if "should be" not in str(error):
            raise
        found = str(error).rpartition(": ")[2]
        raise UserError(f"init_from={config.init_from} has networks of other sizes: {found}") from error
    _LOGGER.info(
        f"Training begins with the {name} policy of {config.init_from}, step {metadata['env_steps']:,}; "
        "other networks begin anew"
    )
    return Networks({}, policy)


def begin_with(algorithm: Algorithm, state: TrainState, networks: Networks) -> TrainState:
    """The state of a training that begins with these networks.

    Args:
        algorithm: of one run, on one device.
        state: before the first iteration.
        networks: see `read_networks`.
    """
    rest = without_replay(state)
    if networks.policy is not None:
        rest = algorithm.with_policy(rest, networks.policy)
    rest = jax.tree_util.tree_map_with_path(lambda path, leaf: networks.leaves.get(_name(path), leaf), rest)
    params = algorithm.policy_params(rest)
    rest = rest.replace(evaluation=rest.evaluation.replace(policy_params=params, best_policy_params=params))
    # Copies, since the step consumes every array once.
    rest = jax.tree.map(lambda new, old: jnp.array(new, old.dtype), rest, without_replay(state))
    return with_replay_of(state, rest)


def _has_checkpoint(folder: RunFolder) -> bool:
    return bool(checkpoint.list_steps(folder.checkpoints))


def _inherited(shapes: TrainState) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes of networks and running statistics, by the paths of their leaves."""
    leaves = jax.tree_util.tree_leaves_with_path(shapes)
    flags = zip(leaves_with(shapes, "per_device"), leaves_with(shapes, "restarts"), strict=True)
    return {_name(path): leaf for (path, leaf), has in zip(leaves, flags, strict=True) if not any(has)}


def _name(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")
