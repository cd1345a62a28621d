"""Tasks so small that the right value and the right action are known, and Continuous Mountain Car."""

import jax
import jax.numpy as jnp
from brax.envs.base import Env
from brax.envs.base import State as BraxState

from mjx_walk.envs import State, TaskOptions, TrainableTask
from mjx_walk.envs.physics import PhysicsState


class ToyTask(TrainableTask):
    """What the trainer reads of a `Task`, for one action in `[-1, 1]`. The state is `qpos` and `qvel`."""

    action_size = 1
    action_low, action_high = jnp.float32([-1.0]), jnp.float32([1.0])
    reward_terms = ("reward_toy",)
    metric_names = ("reward_toy", "nonfinite", "overflow")
    observation_size = 1
    dt = 0.01

    def __init__(self, max_episode_steps: int = 10):
        self.options = TaskOptions(name="toy", max_episode_steps=max_episode_steps)
        self.max_episode_steps = max_episode_steps

    def start(self, key):
        """`(qpos, qvel)`."""
        return jnp.zeros(1), jnp.zeros(1)

    def move(self, qpos, qvel, action):
        """`(qpos, qvel, reward, terminated)`."""
        raise NotImplementedError

    def observe(self, qpos, qvel):
        return qpos

    def reset(self, key) -> State:
        qpos, qvel = self.start(key)
        return self._state(qpos, qvel, jnp.float32(0.0), jnp.zeros((), bool), jnp.zeros((), jnp.int32))

    def step(self, state: State, action) -> State:
        qpos, qvel, reward, terminated = self.move(state.physics.qpos, state.physics.qvel, action[0])
        return self._state(qpos, qvel, jnp.float32(reward), jnp.asarray(terminated, bool), state.steps + 1)

    def _state(self, qpos, qvel, reward, terminated, steps) -> State:
        zero = jnp.float32(0.0)
        return State(
            physics=PhysicsState(qpos, qvel, jnp.zeros(1)),
            memory={},
            obs=self.observe(qpos, qvel),
            reward=reward,
            terminated=terminated,
            truncated=steps >= self.options.max_episode_steps,
            steps=steps,
            metrics={"reward_toy": reward, "nonfinite": zero, "overflow": zero},
        )


class ConstantReward(ToyTask):
    """One step, reward 1."""

    def move(self, qpos, qvel, action):
        return qpos, qvel, 1.0, True


class ObservedReward(ToyTask):
    """One step; the reward is the observation, 1 or -1."""

    def start(self, key):
        return jax.random.rademacher(key, (1,), jnp.float32), jnp.zeros(1)

    def move(self, qpos, qvel, action):
        return qpos, qvel, qpos[0], True


class DelayedReward(ToyTask):
    """Two steps, observed as 0 and 1; reward 1 on the second."""

    def move(self, qpos, qvel, action):
        return qpos + 1.0, qvel, qpos[0], qpos[0] >= 1.0


class EndlessReward(ToyTask):
    """Reward 1 at every step; never ends, but the time limit cuts it off."""

    def move(self, qpos, qvel, action):
        return qpos, qvel, 1.0, False


class RewardedAction(ToyTask):
    """One step; the best action is 0.5."""

    def move(self, qpos, qvel, action):
        return qpos, qvel, -jnp.square(action - 0.5), True


class RewardedObservedAction(ObservedReward):
    """One step; the best action is half the observation."""

    def move(self, qpos, qvel, action):
        return qpos, qvel, -jnp.square(action - 0.5 * qpos[0]), True


class OneOf(ToyTask):
    """The task at an index of `TASKS`, which may be traced: one program, vmapped, trains on all of them."""

    TASKS = (ConstantReward, ObservedReward, DelayedReward, EndlessReward, RewardedAction, RewardedObservedAction)

    def __init__(self, index):
        super().__init__(max_episode_steps=3)
        self._index = index
        self._tasks = [task() for task in self.TASKS]

    def _choose(self, function, *arguments):
        outcomes = [jax.tree.map(jnp.asarray, function(task, *arguments)) for task in self._tasks]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves)[self._index], *outcomes)

    def start(self, key):
        return self._choose(lambda task: task.start(key))

    def move(self, qpos, qvel, action):
        return self._choose(lambda task: task.move(qpos, qvel, action))


class MountainCar(ToyTask):
    """Source: `gymnasium/envs/classic_control/continuous_mountain_car.py`, v0."""

    observation_size = 2

    def __init__(self, max_episode_steps: int = 999):
        super().__init__(max_episode_steps)

    def start(self, key):
        return jax.random.uniform(key, (1,), minval=-0.6, maxval=-0.4), jnp.zeros(1)

    def move(self, qpos, qvel, action):
        qvel = qvel + jnp.clip(action, -1.0, 1.0) * 0.0015 - 0.0025 * jnp.cos(3.0 * qpos)
        qvel = jnp.clip(qvel, -0.07, 0.07)
        qpos = jnp.clip(qpos + qvel, -1.2, 0.6)
        qvel = jnp.where((qpos == -1.2) & (qvel < 0), 0.0, qvel)
        is_there = (qpos[0] >= 0.45) & (qvel[0] >= 0)
        return qpos, qvel, 100.0 * is_there - 0.1 * jnp.square(action), is_there

    def observe(self, qpos, qvel):
        return jnp.concatenate([qpos, qvel])


class BraxSizes(Env):
    """Sizes for Brax's trainer. Its transitions come from our own environment."""

    observation_size, action_size, backend = 17, 6, "mjx"

    def reset(self, rng):
        return BraxState(None, jnp.zeros(17), jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        return state
