"""An environment of another library as a task that the trainers take."""

import dataclasses
import numbers
from typing import ClassVar, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import keystr
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.envs import NO_TIME_LIMIT, BaseTask, State, TaskOptions
from mjx_walk.envs.base_task import no_model
from mjx_walk.envs.physics.base import PhysicsState
from mjx_walk.envs.physics.preparation import Preparation
from mjx_walk.envs.state import Carry, check_action_shape, first_state, is_finite
from mjx_walk.machine.compat import standard_dtypes
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import setting
from mjx_walk.utils.types import PyTree

__all__ = ["ExternalEnv", "ExternalTask", "Moment", "make_task_class"]


class Moment(NamedTuple):
    """What an environment of another library returns for a reset or a step."""

    inner: PyTree
    """Its own state, with its random keys."""
    obs: Array
    """`[observation_size]`."""
    reward: Array
    """`[]`."""
    terminated: Array
    """`[] bool`: no reward follows."""
    truncated: Array
    """`[] bool`: a time limit of its own has ended the episode."""
    terms: dict[str, Array]
    """`[]` each: parts of the reward."""


class ExternalEnv(Protocol):
    """One unbatched environment of another library, as pure functions. It does not reset itself."""

    library: str
    action_low: Float[Array, " action_size"]
    action_high: Float[Array, " action_size"]
    dt: float
    """Time of a step, s; infinite if it is not known."""

    def reset(self, key: PRNGKeyArray) -> Moment:
        """Start an episode."""
        ...

    def step(self, inner: PyTree, action: Float[Array, " action_size"]) -> Moment:
        """Step once, from the `inner` state of the moment before."""
        ...


@dataclasses.dataclass
class _Library:
    """A simulator that needs no preparation."""

    name: str
    calls_host: bool = False
    preparation: Preparation = dataclasses.field(default_factory=Preparation)


class ExternalTask(BaseTask):
    """A task that another library simulates. `make_task_class` makes a subclass for each environment.

    The library's state is in `State.memory`, an array for each leaf. `State.physics` is empty. The time limit, resets
    and batches are this package's.
    """

    ENV: ClassVar[ExternalEnv]
    XML_FILES = {}

    @standard_dtypes()
    def __init__(self, options: TaskOptions, physics: str = "auto"):
        """
        Args:
            options: env options. Only `max_episode_steps` has an effect.
            physics: `auto`.

        Raises:
            UserError: another engine, an option without effect, or observations that are not flat.
        """
        super().__init__(options)
        self._check_options()
        self.engine = _Library(self.ENV.library)
        if physics != "auto":
            raise no_model(options.name, self.engine.name)
        self.model_sources = {}
        self.action_low, self.action_high = self.ENV.action_low, self.ENV.action_high
        self.action_size = len(self.action_low)
        self.dt = self.ENV.dt
        self.reward_terms = self.REWARD_TERMS["v5"]
        start = _at_reset(self.ENV)
        if len(start.obs.shape) != 1:
            raise UserError(f"{options.name} has observations of the shape {start.obs.shape}; flatten them first")
        self.observation_size = start.obs.shape[0]
        self._layout = jax.tree.structure(start.inner)
        self._leaves = {keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(start.inner)}
        for name, leaf in self._leaves.items():
            if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                raise UserError(f"{options.name} keeps the typed key {name}; make it with jax.random.PRNGKey")

    @classmethod
    def resolve_physics(cls, physics: str) -> str:
        if physics != "auto":
            raise no_model(cls.__name__, cls.ENV.library)
        return physics

    def _check_options(self) -> None:
        given = sorted(self.options.changed().keys() - {"name", "task", "max_episode_steps"})
        if given:
            names = ", ".join(f"env.{name}" for name in given)
            raise UserError(f"{self.options.name} does not take {names}; it takes env.max_episode_steps")

    @standard_dtypes()
    def reset(self, key: PRNGKeyArray) -> State:
        """Start an episode, as the library does with this key."""
        start = self.ENV.reset(key)
        none = jnp.zeros(0, jnp.float32)
        obs = jnp.asarray(start.obs, jnp.float32)
        names = (*self.reward_terms, "nonfinite", "overflow")
        return first_state(PhysicsState(none, none, none), self._packed(start.inner), obs, names)

    @standard_dtypes()
    def step(self, state: State, action: Float[Array, " action_size"]) -> State:
        """Step once.

        Returns:
            The next state. If the observation or the reward is not finite, the episode ends: `terminated` and
            `metrics["nonfinite"]` are set, the reward is zero, and the library's state and observation stay unchanged.

        Raises:
            ValueError: the action has another shape.
            UserError: the library's state changes its structure. A traced step raises it while it is traced.
        """
        check_action_shape(action, (self.action_size,))
        after = self.ENV.step(self._unpacked(state.memory), jnp.asarray(action, jnp.float32))
        new = (self._packed(after.inner), jnp.asarray(after.obs, jnp.float32))
        reward = jnp.asarray(after.reward, jnp.float32)
        valid = is_finite((new[1], reward), jnp.inf)
        memory, obs = jax.tree.map(lambda new, old: jnp.where(valid, new, old), new, (state.memory, state.obs))
        zero = jnp.float32(0.0)
        terms = {name: jnp.where(valid, jnp.float32(after.terms[name]), zero) for name in self.reward_terms}
        steps = state.steps + 1
        return state.replace(
            memory=memory,
            obs=obs,
            reward=jnp.where(valid, reward, zero),
            terminated=after.terminated | ~valid,
            truncated=after.truncated | (steps >= self.max_episode_steps),
            steps=steps,
            metrics=terms | {"nonfinite": jnp.float32(~valid), "overflow": zero},
        )

    def _packed(self, inner: PyTree) -> Carry:
        """The library's state as arrays by name, as checkpoints store them.

        Raises:
            UserError: it has other leaves, shapes or dtypes than at a reset.
        """
        found = {keystr(path): jnp.asarray(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(inner)}
        for name in sorted(found.keys() | self._leaves.keys()):
            before, after = (_described(leaves.get(name)) for leaves in (self._leaves, found))
            if before != after:
                raise UserError(
                    f"{self.options.name} changes its state: {name} is {before} after a reset and {after} after a step"
                )
        return {name: jnp.asarray(leaf, self._leaves[name].dtype) for name, leaf in found.items()}

    def _unpacked(self, memory: Carry) -> PyTree:
        return jax.tree.unflatten(self._layout, [memory[name] for name in self._leaves])


def _described(leaf: Array | jax.ShapeDtypeStruct | None) -> str:
    return "missing" if leaf is None else f"{leaf.dtype}{list(leaf.shape)}"


def _at_reset(env: ExternalEnv) -> Moment:
    """Shapes and dtypes of a reset."""
    return jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), jnp.uint32))


def make_task_class(env: ExternalEnv, name: str, max_episode_steps: int) -> type[ExternalTask]:
    """A class that `run(task=…)` and `load_run(task=…)` take.

    Args:
        env: the environment.
        name: of the class. `BraxAnt` is registered as `brax_ant`.
        max_episode_steps: time limit, if `env.max_episode_steps` gives no other one.

    Raises:
        UserError: an invalid time limit.
    """
    is_integer = isinstance(max_episode_steps, numbers.Integral) and not isinstance(max_episode_steps, bool)
    if not is_integer or not 1 <= max_episode_steps <= NO_TIME_LIMIT:
        raise UserError(f"a time limit of {max_episode_steps} steps: give an integer from 1 to {NO_TIME_LIMIT:,}")
    limit = setting(int(max_episode_steps), at_least=1, at_most=NO_TIME_LIMIT)
    options = dataclasses.make_dataclass(
        "ExternalOptions", [("max_episode_steps", int, limit)], bases=(TaskOptions,), namespace={"__module__": __name__}
    )
    with standard_dtypes():
        terms = tuple(_at_reset(env).terms)
    members = {
        "ENV": env,
        "REWARD_TERMS": {"v5": terms},
        "__annotations__": {"options": options},
        "__module__": __name__,
        "__doc__": f"An environment of {env.library}.",
    }
    return type(name, (ExternalTask,), members)
