"""Many environments in one compiled program: `gymnasium.make_vec("mjx_walk/Humanoid-v5", num_envs=4096)`."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

from mjx_walk.envs import NO_TIME_LIMIT, State, make_options
from mjx_walk.envs.info import Info
from mjx_walk.envs.state import check_action_shape
from mjx_walk.interop.compiled_env import CompiledEnv
from mjx_walk.interop.gymnasium_info import add_flags, add_info
from mjx_walk.interop.gymnasium_programs import refuse_fork
from mjx_walk.interop.gymnasium_sub_env import SubEnv
from mjx_walk.interop.live_data import Start
from mjx_walk.interop.mujoco_attributes import RENDER_MODES, split_keywords
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.value_types import type_problem

__all__ = ["MjxWalkVectorEnv"]


class MjxWalkVectorEnv(CompiledEnv, gymnasium.vector.VectorEnv):
    """B environments that behave as in Gymnasium's `SyncVectorEnv`, with the same modes of automatic resets.

    Resets are drawn on the device: a seed determines an environment's episodes, but gives other starts than Gymnasium.
    Copies and pickles keep the states and random generators.
    """

    metadata = {"render_modes": list(RENDER_MODES), "autoreset_mode": AutoresetMode.NEXT_STEP}
    _NOT_PICKLED = (*CompiledEnv._NOT_PICKLED, "_init", "envs")

    def __init__(
        self,
        num_envs: int,
        env: str,
        physics: str = "auto",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **keywords: object,
    ):
        """
        Args:
            num_envs: number of environments, B.
            env: name of the task.
            physics: engine.
            autoreset_mode: as in `SyncVectorEnv`, finished environments reset in the next step, in the same step, or
                only when `reset` is called.
            keywords: Gymnasium's, and those of `TaskOptions`. `max_episode_steps=-1` means no time limit, as in
                `gymnasium.make`.

        Raises:
            UserError: an unknown name, engine or keyword, or a `render_mode` that is of one environment.
        """
        refuse_fork()
        if type_problem(num_envs, int) or num_envs < 1:
            raise UserError(f"num_envs={num_envs}: must be an integer of at least 1")
        prng = jax.config.values["jax_default_prng_impl"]
        if prng != "threefry2x32":  # NumPy draws keys of its shape
            raise UserError(f"JAX_DEFAULT_PRNG_IMPL={prng}: make_vec needs threefry2x32; unset it")
        options, self._rendering = split_keywords(keywords)
        mode = self._rendering.get("render_mode")
        if mode == "human" or str(mode).endswith("_list"):
            does = "shows" if mode == "human" else "collects the frames of"
            raise UserError(
                f"render_mode={mode!r} {does} one environment: use gymnasium.make or vectorization_mode='sync'"
            )
        self._options, self._physics = make_options(env, **_with_gymnasiums_limit(options)), physics
        self.num_envs = num_envs
        self._state: State | None = None
        # For `data`: what the last step started from, its actions, and arguments of later `set_state`s by environment.
        self._last_step: tuple[Start, np.ndarray] | None = None
        self._placed: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._keys: np.ndarray | jax.Array | None = None
        self._seeds: tuple[int, ...] = ()
        self._is_over = np.zeros(num_envs, np.bool_)
        self._build()
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.single_observation_space, self.single_action_space = self._describe()
        self.metadata |= {"autoreset_mode": self.autoreset_mode}
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _build(self) -> None:
        super()._build()
        self._init = {name: getattr(self._gymnasium_env, name).copy() for name in ("init_qpos", "init_qvel")}
        self.envs = [SubEnv(self, i) for i in range(self.num_envs)]

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each environment, drawn if it is asked for before the first reset, as in Gymnasium."""
        if self._keys is None:
            self._seed([None] * self.num_envs, np.ones(self.num_envs, np.bool_))
        return self._seeds

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, object] | None = None):
        """Start episodes in all environments, or in those of `options["reset_mask"]`, `[B] bool`.

        Args:
            seed: one for each environment, or an int, to which environment i adds i. Without a seed, an environment
                continues its sequence of random numbers.
            options: as in `SyncVectorEnv`.

        Raises:
            UserError: the model, `data`, `init_qpos` or `init_qvel` has changed.
        """
        self._refuse_changes()
        seeds = self._listed_seeds(seed)
        mask = _checked_mask(options["reset_mask"], self.num_envs) if options and "reset_mask" in options else None
        if mask is not None and self._state is None and not mask.all():
            raise gymnasium.error.ResetNeeded("reset all environments before you reset some with reset_mask")
        self._seed(seeds, np.ones(self.num_envs, np.bool_) if mask is None else mask)
        mask, before = (np.ones(self.num_envs, np.bool_), None) if mask is None else (mask, self._state)
        self._state, self._keys, reset_info = self._programs.reset_many(before, self._keys, mask)
        self._is_over = self._is_over & ~mask
        self._placed = {i: placed for i, placed in self._placed.items() if not mask[i]}
        info: dict[str, Any] = {}
        add_info(info, jax.device_get(reset_info), mask)
        return np.array(self._state.obs, np.float64), info

    def step(self, actions):
        """Step all environments.

        Args:
            actions: `[B, action_size]`, in Gymnasium's units.

        Raises:
            ValueError: the actions have another shape.
            UserError: the model, `data`, `init_qpos` or `init_qvel` has changed.
        """
        self._refuse_changes()
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        check_action_shape(actions, (self.num_envs, self._gymnasium_env.model.nu))
        mode, was_over = self.autoreset_mode, self._is_over
        if mode == AutoresetMode.DISABLED:
            assert not was_over.any(), f"reset the finished environments first: {np.flatnonzero(was_over)}"
        actions = np.array(actions, np.float32)
        self._last_step, self._placed = (Start(self._state.physics, self._state.draws, self._state.steps), actions), {}
        self._state, last, self._keys, *infos = self._programs.step_many(
            self._state, actions, self._keys, was_over, mode=mode
        )
        returned = self._state if mode == AutoresetMode.NEXT_STEP else last
        obs, outcome, metrics, infos = jax.device_get(
            (self._state.obs, (returned.terminated, returned.truncated), last.metrics, infos)
        )
        terminated, truncated = (np.array(flags) for flags in outcome)
        self._is_over = terminated | truncated
        reward = self._programs.reward(last.replace(metrics=metrics))
        info: dict[str, Any] = {}
        if mode == AutoresetMode.NEXT_STEP:
            reward = np.where(was_over, 0.0, reward)
            self._add_infos(info, infos, metrics, ~was_over)
        else:
            is_reset = self._is_over if mode == AutoresetMode.SAME_STEP else np.zeros_like(self._is_over)
            if is_reset.any():
                self._add_final(info, np.asarray(last.obs), infos[0], metrics, is_reset)
            self._add_infos(info, infos, metrics, ~is_reset)
        return np.array(obs, np.float64), reward, terminated, truncated, info

    def _add_infos(self, info: dict[str, np.ndarray], infos: list[Info], metrics: Info, stepped: np.ndarray) -> None:
        """Add the `info` of the step where an environment stepped, and that of the reset elsewhere."""
        step_info, reset_info = infos
        add_info(info, step_info, stepped)
        add_flags(info, metrics, stepped)
        add_info(info, reset_info, ~stepped)

    def _add_final(
        self, info: dict[str, Any], last_obs: np.ndarray, step_info: Info, metrics: Info, is_over: np.ndarray
    ) -> None:
        """Add `final_obs`, an object array, and `final_info` of the episodes that end in this step."""
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(is_over):
            final_obs[i] = np.array(last_obs[i], np.float64)
        final_info: dict[str, Any] = {}
        add_info(final_info, step_info, is_over)
        add_flags(final_info, metrics, is_over)
        info |= {"final_obs": final_obs, "_final_obs": is_over.copy()}
        info |= {"final_info": final_info, "_final_info": is_over.copy()}

    # These need nothing of Gymnasium's class but `envs`, which are `SubEnv`s here.
    render = SyncVectorEnv.render  # type: ignore[assignment]
    call = SyncVectorEnv.call  # type: ignore[assignment]
    get_attr = SyncVectorEnv.get_attr  # type: ignore[assignment]
    set_attr = SyncVectorEnv.set_attr  # type: ignore[assignment]

    def close_extras(self, **kwargs: object) -> None:
        """Close the OpenGL contexts."""
        self.envs[0]._close_gymnasium_env()

    def _refuse_changes(self) -> None:
        super()._refuse_changes()
        for name, value in self._init.items():
            if not np.array_equal(getattr(self._gymnasium_env, name), value):
                raise UserError(
                    f"resets on the device ignore your change to {name}; use vectorization_mode='sync', whose resets "
                    "read it"
                )

    def _listed_seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int):
            return [seed + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seeds in a list must be num_envs={self.num_envs} in number, got {len(seed)}")
        return list(seed)

    def _seed(self, seeds: list[int | None], mask: np.ndarray) -> None:
        """Give the environments of a mask that have a new seed the key that follows from it, `[2] u32`."""
        if self._keys is None:
            drawn = self.np_random.integers(2**31, size=self.num_envs).tolist()
            seeds = [draw if seed is None else seed for seed, draw in zip(seeds, drawn, strict=True)]
            self._keys, self._seeds = np.zeros((self.num_envs, 2), np.uint32), tuple(drawn)
        elif all(seed is None for seed in seeds):
            return
        keys, known = np.array(self._keys), list(self._seeds)
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                rng, known[i] = seeding.np_random(seeds[i])
                keys[i] = rng.integers(2**32, size=2, dtype=np.uint32)
        self._keys, self._seeds = keys, tuple(known)


def _with_gymnasiums_limit(options: dict[str, object]) -> dict[str, object]:
    """Options with a `max_episode_steps` as `gymnasium.make` takes it: None is the task's own limit, -1 is none."""
    others = {name: value for name, value in options.items() if name != "max_episode_steps"}
    limit = options.get("max_episode_steps")
    if limit is None:
        return others
    is_unlimited = not type_problem(limit, int) and limit == -1
    return others | {"max_episode_steps": NO_TIME_LIMIT if is_unlimited else limit}


def _checked_mask(mask: object, num_envs: int) -> np.ndarray:
    """Check a `reset_mask` as `SyncVectorEnv` does.

    Raises:
        TypeError: the mask is not an array of bools.
        ValueError: its shape is not `[num_envs]`, or it selects no environment.
    """
    if not isinstance(mask, np.ndarray):
        raise TypeError(f"`options['reset_mask']` must be a numpy array, got {type(mask)}")
    if mask.shape != (num_envs,):
        raise ValueError(f"`options['reset_mask']` must have shape `({num_envs},)`, got {mask.shape}")
    if mask.dtype != np.bool_:
        raise TypeError(f"`options['reset_mask']` must have `dtype=np.bool_`, got {mask.dtype}")
    if not mask.any():
        raise ValueError("`options['reset_mask']` must select at least one environment")
    return mask
