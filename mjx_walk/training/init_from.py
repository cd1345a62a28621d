"""The networks that a training begins with, if they come from another run or from the zoo."""

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array

from mjx_walk import zoo
from mjx_walk.algos import Algorithm, TrainState, with_replay_of, without_replay
from mjx_walk.evaluation.saved_policies import choose_policy, load_policy
from mjx_walk.settings.config import Config
from mjx_walk.settings.saved_config import read_algorithm
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import PolicyParams, leaves_with

__all__ = ["Networks", "begin_with", "read_networks"]

_LOGGER = logging.getLogger(__name__)
_ACTING = ("activation", "distribution", "observation_clip")
"""Settings of algorithms that change the actions of a policy, but not the sizes of its networks."""
_POLICY_SIZES = ("policy_hidden_layer_sizes", "policy_layer_norm", "state_dependent_std")
_SIZES = (*_POLICY_SIZES, "value_hidden_layer_sizes", "critic_hidden_layer_sizes", "critic_layer_norm", "num_atoms")
"""Settings of algorithms that change the sizes of networks, those of the policy first."""


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
    source = read_algorithm(folder)
    is_same = source["name"] == config.algo.name and _has_checkpoint(folder)
    try:
        networks, described = (_all_networks if is_same else _best_policy)(folder, algorithm)
    except UserError as error:
        if "should be" not in str(error):
            raise
        found = str(error).rpartition(": ")[2]
        differing = _differing(config, source, (*(_SIZES if is_same else _POLICY_SIZES), *_ACTING))
        advice = "".join(f" algo.{name}={str(value).replace(' ', '')}" for name, value in differing.items())
        also = f"; its own networks need{advice}" if advice else ""
        raise UserError(f"init_from={config.init_from} has networks of other sizes: {found}{also}") from error
    _LOGGER.info(f"Training begins with the {described.format(config.init_from)}")
    _warn_of_other_actions(config, source)
    return networks


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


def _all_networks(folder: RunFolder, algorithm: Algorithm) -> tuple[Networks, str]:
    """The networks of the newest checkpoint, and what they are, with `{}` for the run."""
    leaves, metadata = checkpoint.restore_newest(folder.checkpoints, _inherited(algorithm.state_shapes()))
    return Networks(cast(dict[str, Array], leaves), None), f"networks of {{}}, step {metadata['env_steps']:,}"


def _best_policy(folder: RunFolder, algorithm: Algorithm) -> tuple[Networks, str]:
    """The best policy, and what it is, with `{}` for the run."""
    name = choose_policy(folder, BEST)
    policy, metadata = load_policy(folder, name, jax.eval_shape(algorithm.policy_params, algorithm.state_shapes()))
    described = f"{name} policy of {{}}, step {metadata['env_steps']:,}; other networks begin anew"
    return Networks({}, policy), described


def _warn_of_other_actions(config: Config, source: Mapping[str, object]) -> None:
    """Name the settings because of which the same networks act differently."""
    for name, value in _differing(config, source, _ACTING).items():
        own = getattr(config.algo, name)
        _LOGGER.warning(
            f"{config.init_from} was trained with algo.{name}={value}, and this run has {own}: "
            "the same networks act differently"
        )


def _differing(config: Config, source: Mapping[str, object], names: Iterable[str]) -> dict[str, object]:
    """Those of some settings that differ, with the value of the algorithm from which the networks come.

    Args:
        config: of the training.
        source: settings of that algorithm.
        names: settings. Those that an algorithm lacks are left out.
    """
    common = [name for name in names if name in source and hasattr(config.algo, name)]
    own = {name: getattr(config.algo, name) for name in common}
    return {name: source[name] for name in common if _plain(own[name]) != _plain(source[name])}


def _plain(value: object) -> object:
    return list(value) if isinstance(value, list | tuple) else value


def _has_checkpoint(folder: RunFolder) -> bool:
    return bool(checkpoint.list_steps(folder.checkpoints))


def _inherited(shapes: TrainState) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes of networks and running statistics, by the paths of their leaves."""
    leaves = jax.tree_util.tree_leaves_with_path(shapes)
    flags = zip(leaves_with(shapes, "per_device"), leaves_with(shapes, "restarts"), strict=True)
    return {_name(path): leaf for (path, leaf), has in zip(leaves, flags, strict=True) if not any(has)}


def _name(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")
