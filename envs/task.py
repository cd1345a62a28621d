"""Base of all Gymnasium tasks: model, engine, resets, finiteness check, time limit."""

import abc

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray

from mjx_walk.envs import models
from mjx_walk.envs.base_task import BaseTask
from mjx_walk.envs.custom_reward import CustomReward
from mjx_walk.envs.ground.terrain import Terrain
from mjx_walk.envs.model_changes import ModelSnapshot
from mjx_walk.envs.model_files import source_hashes
from mjx_walk.envs.motors import motor_dofs
from mjx_walk.envs.physics import Derived, Engine, PhysicsState, make_engine, resolve_engine
from mjx_walk.envs.pickling import build_again, files_of
from mjx_walk.envs.randomization.episode import Randomizer
from mjx_walk.envs.resets import InitialState
from mjx_walk.envs.reward_shaping import RewardStep, Terms, check_shaping
from mjx_walk.envs.state import Carry, State, check_action_shape, first_state, is_finite, physics_state
from mjx_walk.envs.task_options import TaskOptions, check_version, with_absolute_paths
from mjx_walk.envs.view import View
from mjx_walk.machine.compat import standard_dtypes
from mjx_walk.storage.files import working_folder

__all__ = ["Task"]


class Task(BaseTask):
    """A Gymnasium MuJoCo environment as pure functions of `State`.

    Subclasses define observations, rewards and terminations. They do not depend on the engine.
    """

    engine: Engine
    V5_ONLY: tuple[str, ...] = ("xml_file", "frame_skip")
    """Env options that Gymnasium's v4 class does not take."""
    V4_ONLY: tuple[str, ...] = ()
    """Env options that Gymnasium's v5 class does not take."""
    MISSING_VERSIONS: dict[str, str] = {}
    """Why a version is not available, by version."""
    MODEL_NEEDS: models.ModelNeeds = models.ModelNeeds()
    """Sizes of a model that the task reads by index."""
    HAS_X: bool = True
    """Whether `qpos[0]` is the root's forward coordinate x."""
    HAS_Y: bool = True
    """Whether `qpos[1]` is the root's lateral coordinate y."""
    HEIGHT_INDEX: int | None = None
    """Index of the root's height in `qpos`. None: the root cannot leave the ground."""
    VIEW: View = View()
    """View of the task's own model. `view` is for the model of `xml_file`."""

    @standard_dtypes()
    def __init__(self, options: TaskOptions, physics: str = "auto", keep_info: bool = False):
        """
        Args:
            options: env options.
            physics: name of the engine, or `auto`.
            keep_info: whether `State.memory` also holds the arrays of `info_arrays`. `reset_info` and `step_info` need
                them, training does not.

        Raises:
            UserError: an unknown version or engine, an option that the version does not take, shaping that has no
                effect, a model file or reward function that is missing or invalid, or a model that lacks what the task
                reads or has what the engine does not simulate.
        """
        check_version(options, self.XML_FILES, self.MISSING_VERSIONS, {"v5": self.V5_ONLY, "v4": self.V4_ONLY})
        options = with_absolute_paths(options, working_folder())
        super().__init__(options)
        self.model_file = models.model_file(options.xml_file or self.XML_FILES[options.version], options.name)
        self.ground = Terrain(options.ground, options.name, self.HAS_X, self.HAS_Y, self.HEIGHT_INDEX)
        self.model = self.load_model()
        self.model_sources = source_hashes(self.model_file)
        self.body_ids = {body: models.body_id(self.model, body) for body in self.named_bodies()}
        models.check_model(self.model, options.name, self.MODEL_NEEDS)
        self.ground.check(self.model)
        if options.xml_file:
            models.warn_of_coordinates(self.model, options.name, self.HAS_X, self.HEIGHT_INDEX)
        self.view = self.VIEW._replace(body=min(self.VIEW.body, self.model.nbody - 1))
        self.dt = self.model.opt.timestep * self.num_substeps()
        self.kept_arrays = self.info_arrays() if keep_info else ()
        derived = tuple(dict.fromkeys((*self.derived_names(), *self.kept_arrays)))
        engine, substeps = resolve_engine(physics), self.num_substeps()
        self.randomizer = Randomizer(options.randomize, self.model, substeps, self.action_range())
        self.engine = make_engine(engine, self.model, substeps, derived, self.randomizer.models)
        models.check_pose(self.model, derived)
        self._snapshot = ModelSnapshot(self.model, derived)
        self.action_low, self.action_high = map(jnp.float32, self.action_range())
        self.action_size = self.model.nu
        self.init_qpos = jnp.asarray(self.model.qpos0, jnp.float32)
        self.init_qvel = jnp.zeros(self.model.nv, jnp.float32)
        self.observation_size = sum(self.observation_blocks().values())
        self._motor_dofs = motor_dofs(self.model)
        self._check_shaping()
        self._custom_reward = CustomReward(options.reward_function, options.shaping, self._motor_dofs)
        self.reward_terms = self._custom_reward.term_names(self._example_step())
        self.metric_names = (*self.reward_terms, "nonfinite", "overflow")

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle and copy a task as its arguments: engines hold threads and compiled functions."""
        return build_again, (type(self), files_of(self), self.options, self.engine.name, bool(self.kept_arrays))

    def _check_shaping(self) -> None:
        has_x = self.HAS_X and models.is_coordinate(self.model, 0, axis=0)
        has_y = self.HAS_Y and models.is_coordinate(self.model, 1, axis=1)
        has_motors, can_fall = self._motor_dofs.size > 0, self.terminates_on_fall
        check_shaping(self.options.shaping, self.options.name, has_x, has_y, has_motors, can_fall)

    @classmethod
    def resolve_physics(cls, physics: str) -> str:
        return resolve_engine(physics)

    @property
    def reward_hashes(self) -> dict[str, str]:
        return self._custom_reward.hashes

    @property
    def has_custom_reward(self) -> bool:
        return self._custom_reward.changes_reward

    # Defined by each task, up to `reset`.

    def named_bodies(self) -> tuple[int | str, ...]:
        """Bodies that `observe`, `carry` and `reward_and_termination` read, as keys of `body_ids`."""
        return ()

    def export_metadata(self) -> dict[str, object]:
        """Facts, as for JSON, that a program without this package needs to use a policy. An ONNX file holds them."""
        return {}

    def load_model(self) -> mujoco.MjModel:
        """The model of `model_file` on `ground`. A task may complete it."""
        spec, model = models.load_compiled_spec(self.model_file)
        return self.ground.added_to(spec, model) if self.ground.is_on else model

    def num_substeps(self) -> int:
        """Physics steps of one environment step."""
        return self.options.frame_skip

    def action_range(self) -> Float[np.ndarray, "2 action_size"]:
        """Lowest and highest actions, in the motors' units."""
        return self.model.actuator_ctrlrange.T

    @abc.abstractmethod
    def initial_state(self, key: PRNGKeyArray) -> InitialState:
        """Draw the position and velocity of a reset. Source: `reset_model` of the Gymnasium class."""

    @abc.abstractmethod
    def derived_names(self) -> tuple[str, ...]:
        """Names of the `mjData` arrays that `observe`, `carry` and `reward_and_termination` read."""

    @abc.abstractmethod
    def observation_blocks(self) -> dict[str, int]:
        """Sizes of the observation's blocks by their `mjData` names, in order."""

    @abc.abstractmethod
    def observe(self, physics: PhysicsState, derived: Derived) -> Float[Array, " observation_size"]:
        """Observation of the physics, in Gymnasium's order and units."""

    def observe_all(self, physics: PhysicsState, derived: Derived, carry: Carry) -> Float[Array, " observation_size"]:
        """Observation. A task that observes its carry overrides it."""
        return self.observe(physics, derived)

    def carry(self, physics: PhysicsState, derived: Derived) -> Carry:
        """Quantities that the next step's reward needs, in addition to the physics state."""
        return {}

    def initial_carry(self, key: PRNGKeyArray, physics: PhysicsState, derived: Derived) -> Carry:
        """The carry of a reset. A task that draws random values for its episodes overrides it."""
        return self.carry(physics, derived)

    def next_carry(
        self, before: State, physics: PhysicsState, derived: Derived, action: Float[Array, " action_size"]
    ) -> Carry:
        """The carry after a step. A task whose carry depends on the former one, in `before.memory`, overrides it."""
        return self.carry(physics, derived)

    @abc.abstractmethod
    def reward_and_termination(
        self, before: State, physics: PhysicsState, derived: Derived, carry: Carry, action: Float[Array, " action_size"]
    ) -> tuple[Terms, Float[Array, ""], Bool[Array, ""]]:
        """Gymnasium's reward terms, reward and termination of one step.

        Args:
            before: state before the step.
            physics: physics state after the step. On hills, it and `before` have the root's height above the ground.
            derived: the arrays of `derived_names`, after the step, as they are in the world.
            carry: the task's carry after the step.
            action: in Gymnasium's units.

        Returns:
            Signed reward terms; the reward, their sum as Gymnasium computes it; and whether the task terminates.
        """

    @standard_dtypes()
    def reset(self, key: PRNGKeyArray) -> State:
        """Random initial state, drawn by `initial_state`."""
        start = self.ground.start(jax.random.fold_in(key, 2), self.initial_state(key))
        return self.reset_to(*start, key=jax.random.fold_in(key, 1))

    @standard_dtypes()
    def reset_to(
        self,
        qpos: Float[Array | np.ndarray, " nq"],
        qvel: Float[Array | np.ndarray, " nv"],
        warmstart: Float[Array | np.ndarray, " nv"] | None = None,
        act: Float[Array | np.ndarray, " na"] | None = None,
        key: PRNGKeyArray | None = None,
    ) -> State:
        """Initial state at a given position and velocity. Source: Gymnasium's `set_state` after a reset.

        Args:
            qpos: m and rad. Quaternions are stored and observed as given, not normalized.
            qvel: m/s and rad/s.
            warmstart: initial guess of the constraint solver (`qacc_warmstart`), m/s² and rad/s². Default: zeros.
            act: activations of actuators. Default: zeros, as after `mj_resetData`.
            key: for random values of the task's carry and for randomized physics. Default: seed 0.

        Raises:
            UserError: another shape, or `model` has changed. A traced reset raises it while it is traced.
        """
        self._snapshot.refuse_changes()
        key = jax.random.PRNGKey(0) if key is None else key
        draws = self.randomizer.draw_episode(key)
        physics = physics_state(self.model, qpos, qvel, warmstart, act, self.randomizer.draw_model(key))
        derived = self.engine.forward(physics)
        seen = self.ground.relative(physics)
        carry = self.initial_carry(key, seen, derived)
        obs = self.randomizer.observe(draws, self.observe_all(seen, derived, carry))
        return first_state(physics, carry | self._kept(derived), obs, self.metric_names, draws)

    @standard_dtypes()
    def step(self, state: State, action: Float[Array, " action_size"]) -> State:
        """Advance by one environment step, which is `frame_skip` physics steps.

        Args:
            state: returned by `reset`, `reset_to` or `step`. As in Gymnasium, a finished episode may be continued.
            action: in Gymnasium's units. The motors clip it; the control cost uses the unclipped action.

        Returns:
            The next state. If the physics are not finite or exceed `MAX_ABS_VALUE`, the episode ends: `terminated` and
            `metrics["nonfinite"]` are set, the reward is zero, and the physics state and observation stay unchanged.

        Raises:
            ValueError: the action has another shape. A traced step raises it while it is traced.
            UserError: `model` has changed, likewise.
        """
        self._snapshot.refuse_changes()
        check_action_shape(action, (self.action_size,))
        action = jnp.asarray(action, jnp.float32)
        draws, start, control = self.randomizer.disturb(state.draws, state.physics, action)
        physics, derived, overflow = self.engine.step(start, control)
        before, seen = state.replace(physics=self.ground.relative(state.physics)), self.ground.relative(physics)
        carry = self.next_carry(before, seen, derived, action) | self._kept(derived)
        obs = self.randomizer.observe(draws, self.observe_all(seen, derived, carry))
        terms, reward, terminated = self.reward_and_termination(before, seen, derived, carry, action)
        terms, reward = self._custom_reward(
            RewardStep(terms, reward, before.physics, seen, obs, action, terminated, self.dt)
        )

        # Activations may be large, as the position that an integrator commands.
        others = (physics.qacc_warmstart, obs, reward, *jax.tree.leaves(physics.act))
        valid = is_finite((physics.qpos, physics.qvel)) & is_finite(others, jnp.inf)
        physics, carry, obs = jax.tree.map(
            lambda new, old: jnp.where(valid, new, old), (physics, carry, obs), (state.physics, state.memory, state.obs)
        )
        # A float32 zero: weakly typed metrics would compile every program twice.
        zero = jnp.float32(0.0)
        terms = {name: jnp.where(valid, value, zero) for name, value in terms.items()}
        steps = state.steps + 1
        return State(
            physics=physics,
            memory=carry,
            obs=obs,
            reward=jnp.where(valid, reward, zero),
            terminated=terminated | ~valid,
            truncated=steps >= self.max_episode_steps,
            steps=steps,
            metrics=terms | {"nonfinite": jnp.float32(~valid), "overflow": jnp.float32(overflow)},
            draws=draws,
        )

    def _kept(self, derived: Derived) -> Carry:
        return {name: derived[name] for name in self.kept_arrays}

    def _example_step(self) -> RewardStep:
        terms = dict.fromkeys(self.gymnasium_reward_terms, jnp.float32(0.0))
        physics = physics_state(self.model, self.init_qpos, self.init_qvel)
        obs, action = jnp.zeros(self.observation_size), jnp.zeros(self.action_size)
        return RewardStep(terms, jnp.float32(0.0), physics, physics, obs, action, jnp.zeros((), bool), self.dt)
