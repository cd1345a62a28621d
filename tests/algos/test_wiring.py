"""Each setting of each algorithm reaches what the algorithm computes.

Two programs are traced for each setting, without being compiled: an iteration under the algorithm's base configuration,
and one with the setting changed. Dead code is removed, so a setting that is read but does not affect the next state
leaves the program as it was.
"""

import dataclasses
import functools
import re

import jax
import numpy as np
import pytest
from helpers import small_settings
from jax.interpreters import partial_eval
from toy_tasks import EndlessReward

from mjx_walk.algos import ALGORITHMS, make_algorithm
from mjx_walk.common.inline_evaluation import EvaluationConfig
from mjx_walk.utils.setting_fields import has_effect

CHANGES = {
    "distribution": {"tanh_normal": "normal", "normal": "tanh_normal"},
    "activation": {"swish": "tanh", "relu": "tanh"},
    "target_entropy": {-0.5: -0.7},
    "normalized_return_max": {None: 3.0, 5.0: 3.0},
    "max_value_grad_norm": {None: 0.5},
    "max_grad_norm": {None: 0.5},
    "final_discount": {None: 0.9},
    "final_target_entropy": {None: -1.0},
    "policy_delay": {1: 2},
    "learning_starts": {8: 16},
    "random_steps": {None: 4},
    "replay_capacity": {64: 128},
    "ou_noise_std": {0.0: 0.1},
    "max_tail_discount": {0.95: 0.93},
}
"""New values by name and base value, where `changed` has no rule."""
NEEDS = {
    "target_kl": {"learning_rate_schedule": "adaptive_kl"},
    "init_noise_std": {"distribution": "normal"},
    "state_dependent_std": {"distribution": "normal"},
    "min_log_std": {"distribution": "normal"},
    "max_log_std": {"distribution": "normal"},
    "schedule_steps": {"learning_rate_schedule": "linear"},
    "normalized_return_max": {"normalize_rewards": True},
    "ou_noise_theta": {"ou_noise_std": 0.1},
    "entropy_schedule": {"entropy_coef": 0.1},
}
"""Other settings without which a setting has no effect."""
NOT_TRACED = {
    **{(algo, "name"): "it selects the algorithm" for algo in ALGORITHMS},
    ("reinforce", "max_value_grad_norm"): "it adds an optimizer without parameters, which old checkpoints may hold",
}
ALL_SETTINGS_FAST = ("ppo", "a2c", "sac")
"""They cover every base class. For the other algorithms, inherited settings are slow tests."""


def cases():
    for algo, (_, config) in ALGORITHMS.items():
        own = config.__annotations__
        for field in dataclasses.fields(config):
            if (algo, field.name) not in NOT_TRACED:
                marks = [] if algo in ALL_SETTINGS_FAST or field.name in own else [pytest.mark.slow]
                yield pytest.param(algo, field.name, marks=marks, id=f"{algo}-{field.name}")


def changed(name, value):
    """Another valid value of a setting."""
    if name in CHANGES:
        return CHANGES[name][value]
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        choices = next(
            f.metadata["choices"] for _, c in ALGORITHMS.values() for f in dataclasses.fields(c) if f.name == name
        )
        return next(choice for choice in choices if choice != value)
    if isinstance(value, tuple):
        return (5,)
    return 2 * value if isinstance(value, int) else 0.9 * value


@functools.cache
def base_program(algo, needs):
    return program(algo, **dict(needs))


def program(algo, **settings):
    """The text of an iteration from a key to the state, without dead code, and its constants."""
    config = ALGORITHMS[algo][1](**small_settings(algo, **settings))
    algorithm = make_algorithm(EndlessReward(), 4, EvaluationConfig(1), config)
    iteration = lambda key: algorithm.learn(*algorithm.collect(algorithm.init(key)))[0]  # noqa: E731
    traced = jax.make_jaxpr(iteration)(jax.random.PRNGKey(0))
    jaxpr, _used = partial_eval.dce_jaxpr(traced.jaxpr, [True] * len(traced.jaxpr.outvars))
    constants = [np.asarray(x).tobytes() for x in jax.tree.leaves(traced.consts)]
    return re.sub(r"0x[0-9a-f]+", "", str(jaxpr)), constants


@pytest.mark.parametrize(("algo", "name"), cases())
def test_a_setting_changes_the_program_where_it_has_an_effect(algo, name):
    """With the settings that it needs, and without them."""
    for needs in [NEEDS[name], {}] if name in NEEDS else [{}]:
        config = ALGORITHMS[algo][1](**small_settings(algo, **needs))
        value = changed(name, getattr(config, name))
        is_same = program(algo, **needs | {name: value}) == base_program(algo, tuple(needs.items()))
        assert is_same is not has_effect(config, name), needs
