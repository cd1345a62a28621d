"""Trainings of one test process that differ in steps, seed and folder alone are traced and compiled once."""

import contextlib
from typing import Any

import pytest

from mjx_walk.algos import make_algorithm
from mjx_walk.envs import BUILT_IN_TASKS
from mjx_walk.evaluation.saved_policies import make_task
from mjx_walk.training.programs import make_program

_MADE: dict[Any, Any] = {}
"""Tasks on the `c` engine, their algorithms and the programs of these, by their settings."""


@contextlib.contextmanager
def shared_programs():
    """Within it, trainings in one process share what earlier ones have compiled. It must not change traced code."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("mjx_walk.api.make_task", _task)
        patched.setattr("mjx_walk.api.make_algorithm", _algorithm)
        patched.setattr("mjx_walk.training.trainer.make_program", _program)
        yield


def _once(key, make):
    return _MADE[key] if key in _MADE else _MADE.setdefault(key, make())


def _task(config):
    env = config.env
    if config.physics != "c" or env.name not in BUILT_IN_TASKS or env.xml_file or env.reward_function:
        return make_task(config)
    return _once(repr(env), lambda: make_task(config))


def _algorithm(task, num_envs, evaluation, algo, axis_name=None):
    def build():
        return make_algorithm(task, num_envs, evaluation, algo, axis_name=axis_name)

    settings = (num_envs, repr(evaluation), repr(algo), axis_name)
    return _once((task, *settings), build) if task in _MADE.values() else build()


def _program(algorithm, *settings):
    def build():
        return make_program(algorithm, *settings)

    return _once((algorithm, *settings), build) if algorithm in _MADE.values() else build()
