"""MuJoCo's live viewer, driven by a policy."""

import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_walk.envs import Task
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing.episode import camera_settings, make_gymnasium

__all__ = ["show"]


def show(task: Task, policy: Callable[[np.ndarray], np.ndarray], seed: int = 0) -> None:
    """Play episodes in real time until the user closes the window.

    Args:
        task: the environment and its keywords.
        policy: `[observation_size] → [action_size]`, both in Gymnasium's units.
        seed: of the first episode; each further episode adds one.

    Raises:
        UserError: there is no screen, or macOS needs `mjpython`.
    """
    import glfw
    import mujoco.viewer

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)  # the error below says it in words
        has_screen = glfw.init()
    if not has_screen:
        raise UserError("viewer=true needs a screen; leave it out to write a film instead")
    env = make_gymnasium(task)
    inner: Any = env.unwrapped
    try:
        window = mujoco.viewer.launch_passive(inner.model, inner.data, show_left_ui=False, show_right_ui=False)
    except RuntimeError as error:
        hint = "on macOS run it with mjpython instead of python" if sys.platform == "darwin" else str(error)
        raise UserError(f"the viewer could not be opened: {hint}") from error
    with window:
        for name, value in camera_settings(task.view).items():
            setattr(window.cam, name, value)
        is_over = True
        while window.is_running():
            if is_over:
                obs, _ = env.reset(seed=seed)
                seed += 1
            started = time.perf_counter()
            obs, _, terminated, truncated, _ = env.step(policy(obs))
            is_over = terminated or truncated
            window.sync()
            time.sleep(max(0.0, inner.dt - (time.perf_counter() - started)))
    env.close()
