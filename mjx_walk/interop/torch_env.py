"""Many environments for trainers in PyTorch. Tensors share the memory of JAX's arrays, so nothing is copied."""

from typing import Any

import gymnasium
import jax
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from mjx_walk.envs.state import check_action_shape
from mjx_walk.interop.env_batch import BatchState, EnvBatch
from mjx_walk.machine.devices import default_device
from mjx_walk.utils.errors import UserError

__all__ = ["TorchEnv", "shared_device"]


class TorchEnv:
    """B environments on one device. `reset` and `step` are those of Gymnasium's `VectorEnv`, with tensors for arrays.

    Finished environments reset in the same step.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, batch: EnvBatch, device: torch.device):
        self.num_envs, self.device, self.dt = batch.num_envs, device, batch.task.dt
        self.max_episode_steps, self.options = batch.task.max_episode_steps, batch.task.options
        self.single_observation_space = batch.observation_space("float32")
        self.single_action_space = batch.action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._batch = batch
        self._state: BatchState | None = None

    def reset(self, *, seed: int | None = None) -> tuple[torch.Tensor, dict[str, Any]]:
        """Start an episode in each environment.

        Args:
            seed: determines the random starts. Without one, the first reset draws a seed, and later ones continue
                from it.

        Returns:
            Observations, `[B, observation_size] f32`, and an empty `info`.
        """
        self._state, obs = self._batch.reset(self._state, seed)
        return torch.from_dlpack(obs), {}

    def step(
        self, actions: torch.Tensor | np.ndarray
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Step all environments, and reset those whose episode ends.

        Args:
            actions: `[B, action_size]`, a tensor or an array, in Gymnasium's units. The motors clip them.

        Returns:
            Observations after the resets, `[B, observation_size] f32`; rewards, `[B] f32`; `terminated` and
            `truncated`, `[B] bool`; and `info`. Its `final_obs` holds the observations before the resets, and its
            `episode` the returns `r` and lengths `l` of the episodes so far. `_final_obs` and `_episode`, `[B] bool`,
            mark the episodes that end in this step.

        Raises:
            ValueError: the actions have another shape.
            gymnasium.error.ResetNeeded: `reset` was not called.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        check_action_shape(actions, (self.num_envs, self._batch.task.action_size))
        actions = torch.as_tensor(actions, dtype=torch.float32, device=self.device).detach().contiguous()
        self._state, step = self._batch.step(self._state, jax.dlpack.from_dlpack(actions))
        step = step._make(map(torch.from_dlpack, step))
        is_over = step.terminated | step.truncated
        info = {
            "final_obs": step.final_obs,
            "_final_obs": is_over,
            "episode": {"r": step.returns, "l": step.lengths},
            "_episode": is_over,
        }
        return step.obs, step.reward, step.terminated, step.truncated, info

    @property
    def episode_steps(self) -> torch.Tensor:
        """Steps of the current episodes, `[B] i32`.

        Set it to spread the ends of the first episodes. Writing into the tensor has no effect.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called.
            UserError: a tensor of another shape or of negative numbers is set.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset first")
        return torch.from_dlpack(self._state.env.steps).clone()  # the state's memory is reused

    @episode_steps.setter
    def episode_steps(self, steps: torch.Tensor) -> None:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset first")
        steps = torch.as_tensor(steps, device=self.device)
        if steps.shape != (self.num_envs,) or steps.min() < 0 or steps.max() >= 2**31:
            raise UserError(f"episode_steps: give {self.num_envs} integers from 0 on, one for each environment")
        array = jax.numpy.array(jax.dlpack.from_dlpack(steps.to(torch.int32).contiguous()))
        self._state = self._state.replace(env=self._state.env.replace(steps=array))

    def close(self) -> None:
        """Release the memory of the environments."""
        self._state = None


def shared_device(device: str | torch.device | None) -> torch.device:
    """The device that JAX and PyTorch both use.

    Args:
        device: the one that the user names, if any.

    Raises:
        UserError: they have none in common, or it is not the given one.
    """
    of_jax = default_device()
    if of_jax.platform == "gpu" and not torch.cuda.is_available():
        raise UserError("JAX uses a GPU, but PyTorch sees none; install PyTorch for CUDA, or set JAX_PLATFORMS=cpu")
    shared = torch.device("cuda", of_jax.local_hardware_id) if of_jax.platform == "gpu" else torch.device("cpu")
    if device is None:
        return shared
    try:
        wanted = torch.device(device)
    except RuntimeError as error:
        raise UserError(f"device={device}: choose cpu or cuda") from error
    if wanted.type != shared.type or wanted.index not in (None, shared.index):
        advice = "set CUDA_VISIBLE_DEVICES" if wanted.type == shared.type else "set JAX_PLATFORMS, or leave device out"
        raise UserError(f"device={device}: JAX computes on {shared}; {advice}")
    return shared
