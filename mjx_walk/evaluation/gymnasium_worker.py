"""A child process that steps real Gymnasium environments; threads would block each other on Python's lock.

It exchanges pickles with its parent over pipes. It first reads `(env id, keywords, [(seed, changes)], with_infos)`,
where the changes are the fields of a `Perturbation`, and resets the environments. Then it reads actions, until the
input ends. Each answer holds observations, rewards, which episodes have terminated, which are truncated, and infos.
Environments whose episode is over are not stepped.
"""

import os
import pickle
import sys
import warnings
from collections.abc import Mapping, Sequence
from typing import IO

import numpy as np
from numpy.typing import ArrayLike

from mjx_walk.machine.streams import open_standard_streams

__all__ = ["send", "serve"]

_STDOUT, _STDERR = 1, 2


def serve() -> None:
    """Serve one parent.

    Raises:
        EOFError, BrokenPipeError: the parent has closed the pipes.
    """
    open_standard_streams()
    # A library's prints must not end up between the pickles, so they go to stderr.
    answers = os.fdopen(os.dup(_STDOUT), "wb")
    os.dup2(_STDERR, _STDOUT)
    warnings.simplefilter("ignore", DeprecationWarning)  # the user chose v4
    import gymnasium
    from gymnasium.envs.mujoco import MujocoEnv

    from mjx_walk.evaluation.perturbations import Perturbation, perturb
    from mjx_walk.machine.quiet_mujoco import hide_deprecations, write_no_log

    write_no_log()
    gymnasium.logger.min_level = gymnasium.logger.ERROR
    name, keywords, episodes, with_infos = pickle.load(sys.stdin.buffer)
    with hide_deprecations():
        envs = [gymnasium.make(name, **keywords) for _ in episodes]
    for env, (seed, changes) in zip(envs, episodes, strict=True):
        mujoco_env = env.unwrapped
        assert isinstance(mujoco_env, MujocoEnv)
        perturb(mujoco_env, Perturbation(*changes), seed)
    starts = [env.reset(seed=seed) for env, (seed, _) in zip(envs, episodes, strict=True)]
    obs, infos = np.stack([start for start, _ in starts]), [info for _, info in starts]
    terminated, truncated = np.zeros((2, len(envs)), bool)
    send(answers, (obs, np.zeros(len(envs)), terminated, truncated, _stacked(infos) if with_infos else {}))
    while True:
        actions = pickle.load(sys.stdin.buffer)
        rewards = np.zeros(len(envs))
        for i in np.flatnonzero(~(terminated | truncated)):
            obs[i], rewards[i], terminated[i], truncated[i], infos[i] = envs[i].step(actions[i])
        send(answers, (obs, rewards, terminated, truncated, _stacked(infos) if with_infos else {}))


def _stacked(infos: Sequence[Mapping[str, ArrayLike]]) -> dict[str, np.ndarray]:
    """The entries of all environments' `info`, which hold numbers: `[N, …] f64` by name."""
    return {name: np.array([info[name] for info in infos], np.float64) for name in infos[0]}


def send(pipe: IO[bytes], message: object) -> None:
    """Write one message to a pipe, and flush it."""
    pickle.dump(message, pipe, protocol=pickle.HIGHEST_PROTOCOL)
    pipe.flush()


if __name__ == "__main__":
    try:
        serve()
    except (EOFError, BrokenPipeError):
        os._exit(0)  # the parent reads no more; a normal exit would try to flush the pipe
