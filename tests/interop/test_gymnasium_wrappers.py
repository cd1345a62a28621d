"""Every wrapper of Gymnasium does with these environments what it does with Gymnasium's own, refusals included."""

import gc

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector
from helpers import renders, slow_except
from side_by_side import assert_same, make_both, outcome

TASKS = ("Walker2d-v5", "Humanoid-v5")
FRAMES = {"render_mode": "rgb_array", "width": 64, "height": 64}


def halved(x):
    return x / 2


SINGLE = {
    "AtariPreprocessing": wrappers.AtariPreprocessing,
    "DelayObservation": lambda env: wrappers.DelayObservation(env, delay=2),
    "DtypeObservation": lambda env: wrappers.DtypeObservation(env, np.float32),
    "DiscretizeObservation": lambda env: wrappers.DiscretizeObservation(env, 3),
    "FilterObservation": lambda env: wrappers.FilterObservation(env, ["state"]),
    "FlattenObservation": wrappers.FlattenObservation,
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "TransformObservation": lambda env: wrappers.TransformObservation(env, halved, env.observation_space),
    "MaxAndSkipObservation": wrappers.MaxAndSkipObservation,
    "NormalizeObservation": wrappers.NormalizeObservation,
    "ReshapeObservation": lambda env: wrappers.ReshapeObservation(env, (1, *env.observation_space.shape)),
    "RescaleObservation": lambda env: wrappers.RescaleObservation(env, -1.0, 1.0),
    "TimeAwareObservation": wrappers.TimeAwareObservation,
    "ClipAction": wrappers.ClipAction,
    "DiscretizeAction": lambda env: wrappers.DiscretizeAction(env, 3, multidiscrete=True),
    "TransformAction": lambda env: wrappers.TransformAction(env, halved, env.action_space),
    "RescaleAction": lambda env: wrappers.RescaleAction(env, -0.5, 0.5),
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.5),
    "RepeatAction": lambda env: wrappers.RepeatAction(env, 2),
    "ClipReward": lambda env: wrappers.ClipReward(env, -0.5, 0.5),
    "TransformReward": lambda env: wrappers.TransformReward(env, halved),
    "NormalizeReward": wrappers.NormalizeReward,
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 5),
    "Autoreset": lambda env: wrappers.Autoreset(wrappers.TimeLimit(env, 5)),
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    "OrderEnforcing": wrappers.OrderEnforcing,
    "RecordEpisodeStatistics": lambda env: wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(env, 5)),
    "ArrayConversion": lambda env: wrappers.ArrayConversion(env, __import__("jax").numpy, np),
    "JaxToNumpy": lambda env: wrappers.JaxToNumpy(env),
    "JaxToTorch": lambda env: wrappers.JaxToTorch(env),
    "NumpyToTorch": lambda env: wrappers.NumpyToTorch(env),
}
VECTOR = {
    "VectorizeTransformObservation": lambda env: vector.VectorizeTransformObservation(
        env, wrappers.ReshapeObservation, shape=(1, *env.single_observation_space.shape)
    ),
    "VectorizeTransformAction": lambda env: vector.VectorizeTransformAction(
        env, wrappers.TransformAction, func=halved, action_space=env.single_action_space
    ),
    "VectorizeTransformReward": lambda env: vector.VectorizeTransformReward(
        env, wrappers.ClipReward, min_reward=0.0, max_reward=0.5
    ),
    "DictInfoToList": vector.DictInfoToList,
    "TransformObservation": lambda env: vector.TransformObservation(env, halved),
    "FilterObservation": lambda env: vector.FilterObservation(env, ["state"]),
    "FlattenObservation": vector.FlattenObservation,
    "GrayscaleObservation": vector.GrayscaleObservation,
    "ResizeObservation": lambda env: vector.ResizeObservation(env, (8, 8)),
    "ReshapeObservation": lambda env: vector.ReshapeObservation(env, (1, *env.single_observation_space.shape)),
    "RescaleObservation": lambda env: vector.RescaleObservation(env, -1.0, 1.0),
    "DtypeObservation": lambda env: vector.DtypeObservation(env, np.float32),
    "NormalizeObservation": vector.NormalizeObservation,
    "TransformAction": lambda env: vector.TransformAction(env, halved),
    "ClipAction": vector.ClipAction,
    "RescaleAction": lambda env: vector.RescaleAction(env, -0.5, 0.5),
    "TransformReward": lambda env: vector.TransformReward(env, halved),
    "ClipReward": lambda env: vector.ClipReward(env, -0.5, 0.5),
    "NormalizeReward": vector.NormalizeReward,
    "RecordEpisodeStatistics": vector.RecordEpisodeStatistics,
    "ArrayConversion": lambda env: vector.ArrayConversion(env, __import__("jax").numpy, np),
    "JaxToNumpy": lambda env: vector.JaxToNumpy(env),
    "JaxToTorch": lambda env: vector.JaxToTorch(env),
    "NumpyToTorch": lambda env: vector.NumpyToTorch(env),
}


def with_pixels(env):
    return wrappers.AddRenderObservation(env)


FRAME_WRAPPERS = {
    "AddRenderObservation": lambda env: wrappers.AddRenderObservation(env, render_only=False),
    "GrayscaleObservation": lambda env: wrappers.GrayscaleObservation(with_pixels(env)),
    "ResizeObservation": lambda env: wrappers.ResizeObservation(with_pixels(env), (8, 8)),
    "AddWhiteNoise": lambda env: wrappers.AddWhiteNoise(with_pixels(env), 0.2),
    "ObstructView": lambda env: wrappers.ObstructView(with_pixels(env), 0.2, 4),
    "RenderCollection": wrappers.RenderCollection,
    "RecordVideo": lambda env: wrappers.RecordVideo(env, "films"),
    "HumanRendering": wrappers.HumanRendering,
}
VECTOR_FRAME_WRAPPERS = {
    "RecordVideo": lambda env: vector.RecordVideo(env, "films"),
    "HumanRendering": vector.HumanRendering,
}
NORMALIZING = {"NormalizeObservation": 0.05, "NormalizeReward": 0.05}
"""Tolerances where the wrapper divides by a standard deviation of few steps."""


def test_every_wrapper_is_listed():
    assert set(wrappers.__all__) - {"vector"} == SINGLE.keys() | FRAME_WRAPPERS.keys()
    assert set(vector.__all__) == VECTOR.keys() | VECTOR_FRAME_WRAPPERS.keys()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", SINGLE)
def test_wrapper(name, task):
    ours, real = make_both(task)
    assert_same(outcome(SINGLE[name], ours), outcome(SINGLE[name], real), NORMALIZING.get(name, 2e-3))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", VECTOR)
def test_vector_wrapper(name, task):
    """Resets without noise start all episodes alike, so that the environments stay together through them."""
    keywords = {"num_envs": 3, "reset_noise_scale": 0.0, "max_episode_steps": 7}
    ours, real = make_both(task, gymnasium.make_vec, **keywords)
    assert_same(outcome(VECTOR[name], ours), outcome(VECTOR[name], real), NORMALIZING.get(name, 2e-3))


def frame_outcomes(wrap, *arguments, **keywords):
    """Outcomes of both. Gymnasium's closed viewers delete OpenGL objects of others when they are collected."""
    ours, real = make_both("Walker2d-v5", *arguments, **keywords)
    for env in (ours, real):
        gc.collect()
        yield outcome(wrap, env, 4)
    gc.collect()


@renders
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", slow_except(["AddRenderObservation", "HumanRendering"], FRAME_WRAPPERS))
def test_wrapper_of_frames(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_same(*frame_outcomes(FRAME_WRAPPERS[name], **FRAMES))


@renders
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", VECTOR_FRAME_WRAPPERS)
def test_vector_wrapper_of_frames(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keywords = {"num_envs": 3, "reset_noise_scale": 0.0} | FRAMES
    assert_same(*frame_outcomes(VECTOR_FRAME_WRAPPERS[name], gymnasium.make_vec, **keywords))
