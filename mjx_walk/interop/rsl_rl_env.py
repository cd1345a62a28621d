"""Many environments as a `VecEnv` of rsl_rl."""

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from mjx_walk.interop.torch_env import TorchEnv

__all__ = ["RslRlEnv"]


class RslRlEnv(VecEnv):
    """B environments. Their observations are the group `policy`. Actions are in [-1, 1] for every motor.

    Writing into `episode_length_buf` has no effect; set it.
    """

    def __init__(self, env: TorchEnv, seed: int | None = None):
        self._env = env
        self.num_envs, self.device = env.num_envs, env.device
        self.num_actions = env.single_action_space.shape[0]
        self.max_episode_length = env.max_episode_steps
        self.cfg = env.options
        space = env.single_action_space
        low, high = (torch.as_tensor(bound, device=env.device) for bound in (space.low, space.high))
        self._center, self._half_range = (low + high) / 2, (high - low) / 2
        obs, _ = env.reset(seed=seed)
        self._obs = self._grouped(obs)

    def _grouped(self, obs: torch.Tensor) -> TensorDict:
        return TensorDict({"policy": obs}, batch_size=[self.num_envs], device=self.device)

    @property
    def episode_length_buf(self) -> torch.Tensor:  # type: ignore[override]
        """Steps of the current episodes, `[B] i64`. rsl_rl sets them to spread the ends of the first episodes."""
        return self._env.episode_steps.long()

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self._env.episode_steps = steps

    def get_observations(self) -> TensorDict:
        """Current observations, `[B, observation_size] f32`."""
        return self._obs

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """Step all environments, and reset those whose episode ends.

        Args:
            actions: `[B, action_size]`. -1 and 1 are the ends of the motors' ranges, which clip what lies beyond.

        Returns:
            Observations after the resets; rewards, `[B] f32`; `[B] i64`, 1 where an episode ends; and `time_outs`,
            `[B] bool`, where the time limit alone ends it.
        """
        scaled = self._center + self._half_range * actions.to(self.device)
        obs, reward, terminated, truncated, _ = self._env.step(scaled)
        self._obs = self._grouped(obs)
        return self._obs, reward, (terminated | truncated).long(), {"time_outs": truncated & ~terminated}
