"""Tasks and algorithms of users: registration, and one clear line for each mistake."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import unregistered

import mjx_walk
from mjx_walk.algos import ALGORITHMS, PPO, PPOConfig, make_algorithm
from mjx_walk.algos.base import Algorithm
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.envs import TASKS, Task, TaskOptions, make_env, registry
from mjx_walk.envs.walker2d import Walker2d, Walker2dOptions
from mjx_walk.settings.recipes import fallback
from mjx_walk.utils.errors import UserError


@dataclasses.dataclass
class BackwardOptions(Walker2dOptions):
    factor: float = -1.0


class Backward(Walker2d):
    """Walker2d that is paid for walking backward, and observes only angles."""

    options: BackwardOptions

    def observation_blocks(self):
        return {"qpos": self.model.nq - 2}

    def observe(self, physics, derived):
        return physics.qpos[2:]

    def reward_and_termination(self, before, physics, derived, carry, action):
        terms, reward, terminated = super().reward_and_termination(before, physics, derived, carry, action)
        forward = self.options.factor * terms["reward_forward"]
        return terms | {"reward_forward": forward}, reward - terms["reward_forward"] + forward, terminated


class Unfinished(Task):
    XML_FILES = {"v5": "ant.xml"}
    REWARD_TERMS = {"v5": ("reward",)}


class Undecorated(TaskOptions):
    speed: float = 1.0


@dataclasses.dataclass
class GreedyConfig(PPOConfig):
    greed: float = 2.0


class Greedy(PPO):
    """PPO under another name."""


@pytest.fixture(autouse=True)
def _unregistered():
    """What a test registers is gone after it."""
    with unregistered():
        yield


def test_a_registered_task_is_made_by_name():
    mjx_walk.register_task("backward", Backward)
    task = make_env("backward", physics="c", factor=-2.0, healthy_reward=0.0, ctrl_cost_weight=0.0)
    assert (task.observation_size, task.is_in_gymnasium, task.gymnasium_id) == (7, False, "backward")
    reference = make_env("walker2d", physics="c", healthy_reward=0.0, ctrl_cost_weight=0.0)
    state, action = jax.jit(task.reset)(jax.random.PRNGKey(0)), jnp.full(6, 0.5)
    after = jax.jit(task.step)(state, action)
    expected = jax.jit(reference.step)(reference.reset_to(*state.physics[:2]), action)
    np.testing.assert_allclose(after.reward, -2.0 * expected.reward, rtol=1e-6)
    mjx_walk.register_task("backward", Backward)  # the same class again, as in a notebook


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("walker2d", Backward), "'walker2d' is a task of this package; choose another name"),
        (("all", Backward), "a task cannot be called 'all'"),
        (("My Robot", Backward), "a task cannot be called 'My Robot'"),
        (("robot", 5), "the task 'robot' is 5; give a subclass of mjx_walk.envs.Task"),
        (("robot", Unfinished), "the class Unfinished of the task 'robot' does not define: derived_names, initial_"),
        (("robot", Backward, dict), "the options of the task 'robot' are <class 'dict'>; give a dataclass"),
        (("robot", Backward, Undecorated), "decorate Undecorated, the options of the task 'robot', with @data"),
    ],
)
def test_mistakes_with_tasks(arguments, says):
    with pytest.raises(UserError) as refused:
        mjx_walk.register_task(*arguments)
    assert says in str(refused.value) and "\n" not in str(refused.value)


def test_another_class_does_not_take_a_name():
    mjx_walk.register_task("robot", Backward)
    with pytest.raises(UserError, match="a task 'robot' is registered already, from "):
        mjx_walk.register_task("robot", Walker2d)


def test_unknown_arrays_are_refused():
    class Curious(Backward):
        def derived_names(self):
            return ("qpsos",)

    mjx_walk.register_task("curious", Curious)
    with pytest.raises(UserError, match=r"no array 'qpsos' \(did you mean: qpos\?\); the task names"):
        make_env("curious", physics="c")


def test_the_name_of_a_class():
    assert [registry.task_name(task) for task in (Backward, Walker2d)] == ["backward", "walker2d"]
    assert registry.task_name(type("MyRobot2D", (), {})) == "my_robot2_d"
    assert all(registry.task_name(task) == name for name, (task, _) in TASKS.items())


def test_an_algorithm_is_made_by_name():
    mjx_walk.register_algorithm("greedy", Greedy, GreedyConfig)
    config = ALGORITHMS["greedy"][1](greed=3.0)
    algorithm = make_algorithm(make_env("walker2d", physics="c"), 8, EvaluationConfig(1), config)
    assert type(algorithm) is Greedy and algorithm.config.greed == 3.0 and config.name == "greedy"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("ppo", Greedy, GreedyConfig), "'ppo' is an algorithm of this package; choose another name"),
        (("Greedy", Greedy, GreedyConfig), "an algorithm cannot be called 'Greedy'"),
        (("greedy", Backward, GreedyConfig), "give a subclass of mjx_walk.algos.Algorithm"),
        (("greedy", Algorithm, GreedyConfig), "the class Algorithm of the algorithm 'greedy' does not define: collect"),
        (("greedy", Greedy, TaskOptions), "derive them from OnPolicyConfig or OffPolicyConfig"),
    ],
)
def test_mistakes_with_algorithms(arguments, says):
    with pytest.raises(UserError) as refused:
        mjx_walk.register_algorithm(*arguments)
    assert says in str(refused.value) and "\n" not in str(refused.value)


def test_recipes_follow_the_classes():
    assert fallback("cpu/backward_ppo") is None
    mjx_walk.register_task("backward", Backward)
    mjx_walk.register_algorithm("greedy", Greedy, GreedyConfig)
    assert fallback("gpu/backward_sac") == "gpu/sac"
    assert fallback("cpu/ant_greedy") == "cpu/ant_ppo"
