"""What every task shares: the model, the engine, resets, the guard against broken physics, the time limit."""

import abc
import dataclasses
from pathlib import Path
from typing import Any

import flax
import gymnasium
import jax
import jax.numpy as jnp
import mujoco

from mjx_walk.envs.physics import Derived, PhysicsState, make_engine, resolve_engine
from mjx_walk.envs.rewards import RewardStep, Shaping, Terms, load_reward_function, shaping_terms, term_names
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting

MAX_ABS_VALUE = 1e10
"""A position or velocity beyond it is a broken simulation, as in MuJoCo's own check (`mjMAXVAL`)."""

NO_TIME_LIMIT = 2**31 - 1
"""`max_episode_steps` of a task whose time limit is kept by somebody else."""

Memory = dict[str, jax.Array]
"""What a task remembers from the last step beside the physics state."""


class State(flax.struct.PyTreeNode):
    """One copy of an environment. Lean by design: everything else is rebuilt inside the step."""

    physics: PhysicsState
    memory: Memory
    obs: jax.Array
    """`[observation_size] f32`, in Gymnasium's order and units."""
    reward: jax.Array
    """`[] f32`."""
    terminated: jax.Array
    """`[] bool`: the task ended the episode; there is no future reward."""
    truncated: jax.Array
    """`[] bool`: the time limit ended it; the future was cut off."""
    steps: jax.Array
    """`[] i32`: steps since the reset."""
    metrics: dict[str, jax.Array]
    """`[] f32` each: the reward terms under Gymnasium's `info` names, `nonfinite` and `overflow`."""


@dataclasses.dataclass
class TaskOptions:
    """Keywords that all tasks share. Each task's own class adds Gymnasium's, under Gymnasium's names."""

    name: str = ""
    version: str = setting("v5", choices=("v5", "v4"))
    xml_file: str | None = None
    """A model of your own, as in Gymnasium; by default the version's own file."""
    frame_skip: int = setting(5, at_least=1)
    reset_noise_scale: float = setting(1e-2, at_least=0)
    exclude_current_positions_from_observation: bool = True
    max_episode_steps: int = setting(1000, at_least=1)
    shaping: Shaping = dataclasses.field(default_factory=Shaping)
    """Terms to add to the reward."""
    reward_function: str | None = None
    """`PATH.py:FUNCTION`, a reward of your own instead of Gymnasium's; see `mjx_walk.envs.rewards`."""

    def __post_init__(self):
        for field in dataclasses.fields(self):  # a range comes as a list from a configuration file
            if isinstance(getattr(self, field.name), list):
                setattr(self, field.name, tuple(getattr(self, field.name)))
        if self.xml_file and _model_path(self.xml_file).is_file():
            self.xml_file = str(_model_path(self.xml_file).resolve())  # also from another folder
        if isinstance(self.shaping, dict):
            unknown = self.shaping.keys() - {field.name for field in dataclasses.fields(Shaping)}
            if unknown:
                raise UserError(f"unknown key 'env.shaping.{min(unknown)}'")
            self.shaping = Shaping(**self.shaping)


class Task(abc.ABC):
    """A Gymnasium MuJoCo environment as pure functions of `State`.

    Subclasses say what is observed and what is rewarded; nothing in them knows about engines.
    """

    GYMNASIUM_NAME: str
    """As registered, without the version."""
    XML_FILES: dict[str, str]
    """The model of each version, in Gymnasium's assets."""
    REWARD_TERMS: dict[str, tuple[str, ...]]
    """Signed reward terms of each version, under the names of Gymnasium's `info`."""
    V5_ONLY: tuple[str, ...] = ("xml_file", "frame_skip")
    """Keywords that Gymnasium's v4 class does not take."""
    HAS_Y: bool = True
    """Whether `qpos[1]` is a way to the side."""

    def __init__(self, options: TaskOptions, physics: str = "auto"):
        """
        Args:
            options: Gymnasium's keywords.
            physics: engine name, or `auto`.

        Raises:
            UserError: an unknown version or engine, a keyword that v4 does not take, or a model file or a reward
                function that is not there or does not work.
        """
        if options.version not in self.XML_FILES:
            raise UserError(f"unknown version '{options.version}' of {options.name}; choose one of: v5, v4")
        defaults = type(options)()
        changed = [name for name in self.V5_ONLY if getattr(options, name) != getattr(defaults, name)]
        if options.version == "v4" and changed:
            raise UserError(f"{options.name} v4 does not take {', '.join(changed)}; use version=v5")
        self.options = options
        self.model = load_model(options.xml_file or self.XML_FILES[options.version])
        self.dt = self.model.opt.timestep * options.frame_skip
        self.engine = make_engine(resolve_engine(physics), self.model, options.frame_skip, self.derived_names())
        low, high = self.model.actuator_ctrlrange.T
        self.action_low, self.action_high = jnp.float32(low), jnp.float32(high)
        self.action_size = self.model.nu
        self.init_qpos = jnp.asarray(self.model.qpos0, jnp.float32)
        self.init_qvel = jnp.zeros(self.model.nv, jnp.float32)
        self.observation_size = sum(self.observation_blocks().values())
        if options.shaping.keep_y and not self.HAS_Y:
            raise UserError(f"env.shaping.keep_y={options.shaping.keep_y}: {options.name} has no y")
        if options.shaping.falling and not getattr(options, "terminate_when_unhealthy", False):
            raise UserError(f"env.shaping.falling={options.shaping.falling}: no fall ends an episode here")
        self._reward_function = load_reward_function(options.reward_function) if options.reward_function else None
        self.reward_terms = self._reward_terms()
        self.metric_names = (*self.reward_terms, "nonfinite", "overflow")

    @property
    def gymnasium_id(self) -> str:
        """The environment in the real Gymnasium that this one equals."""
        return f"{self.GYMNASIUM_NAME}-{self.options.version}"

    def gymnasium_kwargs(self) -> dict[str, Any]:
        """Keywords for `gymnasium.make` that give the same task; those at their default are left out."""
        defaults = type(self.options)()
        not_theirs = {"name", "version", "max_episode_steps", "shaping", "reward_function"}
        return {
            field.name: getattr(self.options, field.name)
            for field in dataclasses.fields(self.options)
            if field.name not in not_theirs and getattr(self.options, field.name) != getattr(defaults, field.name)
        }

    @property
    def has_own_reward(self) -> bool:
        """Whether it is trained on another reward than Gymnasium's."""
        return self._reward_function is not None or any(dataclasses.asdict(self.options.shaping).values())

    # What a task defines.

    @abc.abstractmethod
    def derived_names(self) -> tuple[str, ...]:
        """The `mjData` arrays that `observe` and `reward_and_termination` read."""

    @abc.abstractmethod
    def observation_blocks(self) -> dict[str, int]:
        """The observation's parts by their `mjData` names, in order, with their sizes."""

    @abc.abstractmethod
    def observe(self, physics: PhysicsState, derived: Derived) -> jax.Array:
        """The observation, `[observation_size] f32`."""

    def remember(self, physics: PhysicsState, derived: Derived) -> Memory:
        """What the next step's reward needs from this one beside the physics state."""
        return {}

    @abc.abstractmethod
    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, memory: Memory, action: jax.Array
    ) -> tuple[dict[str, jax.Array], jax.Array, jax.Array]:
        """Signed reward terms of a step, their sum as Gymnasium adds them up, and whether the episode ends."""

    # What all tasks are.

    def reset(self, key: jax.Array) -> State:
        """A random start. Source: `reset_model` of each Gymnasium class: uniform noise around the model's pose."""
        qpos_key, qvel_key = jax.random.split(key)
        scale = self.options.reset_noise_scale
        qpos_noise = jax.random.uniform(qpos_key, self.init_qpos.shape, minval=-scale, maxval=scale)
        qvel_noise = jax.random.uniform(qvel_key, self.init_qvel.shape, minval=-scale, maxval=scale)
        return self.reset_to(self.init_qpos + qpos_noise, self.init_qvel + qvel_noise)

    def reset_to(self, qpos: jax.Array, qvel: jax.Array, warmstart: jax.Array | None = None) -> State:
        """A given start. Source: Gymnasium's `set_state` after a reset.

        Args:
            qpos: `[nq]`, m and rad. Quaternions are kept and observed as given, not normalised.
            qvel: `[nv]`, m/s and rad/s.
            warmstart: `[nv]`, the constraint solver's starting point (`qacc_warmstart`); zero by default.
        """
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        warmstart = jnp.zeros_like(qvel) if warmstart is None else jnp.asarray(warmstart, jnp.float32)
        physics = PhysicsState(qpos, qvel, warmstart)
        derived = self.engine.forward(physics)
        return State(
            physics=physics,
            memory=self.remember(physics, derived),
            obs=self.observe(physics, derived),
            reward=jnp.zeros((), jnp.float32),
            terminated=jnp.zeros((), bool),
            truncated=jnp.zeros((), bool),
            steps=jnp.zeros((), jnp.int32),
            metrics={name: jnp.zeros((), jnp.float32) for name in self.metric_names},
        )

    def _own_reward(self, step: RewardStep) -> tuple[Terms, jax.Array]:
        """All reward terms and the reward, with what the options add to Gymnasium's or put in its place."""
        terms, reward = step.terms, step.reward
        if self._reward_function:
            terms = {name: jnp.float32(term) for name, term in self._reward_function(step).items()}
            reward = sum(terms.values(), jnp.float32(0.0))
        added = shaping_terms(self.options.shaping, step)
        return terms | added, sum(added.values(), reward)

    def _reward_terms(self) -> tuple[str, ...]:
        terms = dict.fromkeys(self.REWARD_TERMS[self.options.version], jnp.float32(0.0))
        physics = PhysicsState(self.init_qpos, self.init_qvel, self.init_qvel)
        obs, action = jnp.zeros(self.observation_size), jnp.zeros(self.action_size)
        step = RewardStep(terms, jnp.float32(0.0), physics, physics, obs, action, jnp.zeros((), bool), self.dt)
        names, shaped = tuple(terms), shaping_terms(self.options.shaping, step)
        if self._reward_function:
            names = term_names(self._reward_function, str(self.options.reward_function), step, shaped)
        return (*names, *shaped)

    def step(self, state: State, action: jax.Array) -> State:
        """One environment step of `frame_skip` physics steps.

        Args:
            state: from `reset`, `reset_to` or `step`; a state that has ended may be stepped on, as in Gymnasium.
            action: `[action_size] f32`, in Gymnasium's units. The motors clip it; its cost is charged unclipped.

        Returns:
            The next state. Broken physics (not finite, or beyond `MAX_ABS_VALUE`) ends the episode instead: the
            state before it is kept, the reward is zero, `terminated` and `metrics["nonfinite"]` are set.
        """
        action = jnp.asarray(action, jnp.float32)
        physics, derived, overflow = self.engine.step(state.physics, action)
        memory = self.remember(physics, derived)
        obs = self.observe(physics, derived)
        terms, reward, terminated = self.reward_and_termination(state, physics, derived, memory, action)
        rewarded = RewardStep(terms, reward, state.physics, physics, obs, action, terminated, self.dt)
        terms, reward = self._own_reward(rewarded)

        is_finite = _is_finite((physics.qpos, physics.qvel)) & _is_finite(
            (physics.qacc_warmstart, obs, reward), jnp.inf
        )
        physics, memory, obs = jax.tree.map(
            lambda new, old: jnp.where(is_finite, new, old),
            (physics, memory, obs),
            (state.physics, state.memory, state.obs),
        )
        # A strong zero: weakly typed metrics would have every program compiled twice.
        zero = jnp.float32(0.0)
        terms = {name: jnp.where(is_finite, value, zero) for name, value in terms.items()}
        steps = state.steps + 1
        return State(
            physics=physics,
            memory=memory,
            obs=obs,
            reward=jnp.where(is_finite, reward, zero),
            terminated=terminated | ~is_finite,
            truncated=steps >= self.options.max_episode_steps,
            steps=steps,
            metrics=terms | {"nonfinite": jnp.float32(~is_finite), "overflow": jnp.float32(overflow)},
        )


def _is_finite(arrays, limit: float = MAX_ABS_VALUE) -> jax.Array:
    return jnp.array([jnp.all(jnp.abs(x) < limit) for x in arrays]).all()


def _model_path(xml_file: str) -> Path:
    """By the rules of Gymnasium's `xml_file`: a bare name is one of its assets, else it is a path."""
    path = Path(xml_file).expanduser()
    if len(path.parts) == 1 and not path.exists():
        return Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / xml_file
    return path


def load_model(xml_file: str) -> mujoco.MjModel:
    """Load a model, one of Gymnasium's or one's own.

    Raises:
        UserError: there is no such file, or MuJoCo cannot read it.
    """
    path = _model_path(xml_file)
    if not path.is_file():
        raise UserError(f"model file not found: {path}")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise UserError(f"MuJoCo cannot read {path}: {str(error).splitlines()[0]}") from error
