"""A process that steps real Gymnasium environments for `evaluation`: threads would wait for one another's Python.

It speaks pickles over its pipes. In: `(env id, keywords, seeds)`; out: observations. Then, until the input ends, in:
actions; out: observations, rewards, and which episodes are over. An episode that is over is not stepped on.
"""

import os
import pickle
import sys
import warnings

import numpy as np


def serve() -> None:
    """Serve one parent.

    Raises:
        EOFError, BrokenPipeError: it has closed its pipes.
    """
    # Whatever a library prints must not end up between the pickles.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    warnings.simplefilter("ignore", DeprecationWarning)  # v4 is asked for knowingly
    import gymnasium

    gymnasium.logger.min_level = gymnasium.logger.ERROR
    name, keywords, seeds = pickle.load(sys.stdin.buffer)
    envs = [gymnasium.make(name, **keywords) for _ in seeds]
    obs = np.stack([env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=True)])
    is_over = np.zeros(len(envs), bool)
    _send(answers, obs)
    while True:
        actions = pickle.load(sys.stdin.buffer)
        rewards = np.zeros(len(envs))
        for i in np.flatnonzero(~is_over):
            obs[i], rewards[i], terminated, truncated, _ = envs[i].step(actions[i])
            is_over[i] = terminated or truncated
        _send(answers, (obs, rewards, is_over))


def _send(pipe, message) -> None:
    pickle.dump(message, pipe, protocol=pickle.HIGHEST_PROTOCOL)
    pipe.flush()


if __name__ == "__main__":
    try:
        serve()
    except (EOFError, BrokenPipeError):
        os._exit(0)  # The parent has gone, or is done: nobody reads what is still buffered.
