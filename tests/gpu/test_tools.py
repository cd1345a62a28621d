"""Second half of the GPU gate: parity, what users bring, and what one does with a policy."""

import json
import os
import re

import gymnasium
import numpy as np
import pytest
from gpu_gate import checked_rows, require, run, run_python
from helpers import CLONE

from mjx_walk import zoo
from mjx_walk.envs import GYMNASIUM_TASKS
from mjx_walk.storage.scores import read_scores

pytestmark = pytest.mark.gpu

PARITY = [("warp", name, "v5") for name in GYMNASIUM_TASKS]
PARITY += [("warp", "walker2d", "v4"), ("jax", "inverted_pendulum", "v5"), ("jax", "walker2d", "v5")]

OWN_TASK = """
import dataclasses
import jax.numpy as jnp
from mjx_walk.envs import TaskOptions
from mjx_walk.envs.half_cheetah import HalfCheetah

class Backward(HalfCheetah):
    REWARD_TERMS = {"v5": ("reward_back", "reward_calm")}

    def derived_names(self):
        return ("cfrc_ext", "subtree_com")

    def reward_and_termination(self, before, physics, derived, carry, action):
        back = (before.physics.qpos[0] - physics.qpos[0]) / self.dt
        calm = -1e-4 * jnp.square(derived["cfrc_ext"]).sum()
        return {"reward_back": back, "reward_calm": calm}, back + calm, jnp.zeros((), bool)
"""
OWN_REWARD = """
def bent(step):
    return step.terms | {"reward_knee": 0.5 * abs(step.after.qpos[4])}
"""
SMALL = ("algo=ppo", "num_envs=512", "iterations_per_call=2", "evaluation.gymnasium_episodes=2")

IMPLICITFAST = """
import sys
sys.path[:0] = ["tests", "tests/envs"]
import feature_models
import jax
from test_integrators import FEATURES, assert_equal_steps
assert jax.default_backend() == "gpu"
assert_equal_steps(feature_models.load(*FEATURES, option='integrator="implicitfast"'), "warp")
"""
BOXES = """
import sys
sys.path[:0] = ["tests", "tests/envs"]
import jax
from test_supported import test_boxes_touch_on_warp_as_in_mujoco
assert jax.default_backend() == "gpu"
test_boxes_touch_on_warp_as_in_mujoco()
"""
BATCHES = """
import gymnasium
import numpy as np
import mjx_walk
envs = gymnasium.make_vec("mjx_walk/Humanoid-v5", num_envs=256, physics="warp")
obs, _ = envs.reset(seed=0)
policy = mjx_walk.load_run("zoo:humanoid-csac").policy
total = np.zeros(256)
for _ in range(100):
    obs, reward, terminated, truncated, _ = envs.step(policy(obs))
    assert not terminated.any() and obs.shape == (256, 348)
    total += reward
print(total.mean())
"""
TENSORS = """
import torch
import mjx_walk
env = mjx_walk.make_torch_env("humanoid", 256, device="cuda", physics="warp")
actions = torch.rand(40, 256, 17, device="cuda") * 0.8 - 0.4
sums = []
for overwrites in (False, True):
    obs, _ = env.reset(seed=0)
    assert obs.is_cuda and obs.shape == (256, 348)
    sums.append(0.0)
    for action in actions:
        if overwrites:
            obs.fill_(torch.nan)
        obs, reward, terminated, truncated, info = env.step(action)
        assert reward.is_cuda and terminated.dtype == torch.bool
        sums[-1] += info["final_obs"][:, 2].abs().sum().item() + reward.sum().item()
    assert 0 < info["episode"]["l"].min() < 40  # some have fallen
assert abs(sums[0] / sums[1] - 1) < 0.05, sums
print(sums[0])
"""
ACTIONS = """
import sys
import numpy as np
import mjx_walk
run = mjx_walk.load_run("zoo:humanoid-csac")
observations = np.random.default_rng(0).normal(size=(64, 348))
np.savez(sys.argv[1], observations=observations, actions=run.policy(observations))
"""
RENDERER = """
import os
from mjx_walk.viewing.rendering import choose_opengl
choose_opengl()
print(os.environ["MUJOCO_GL"])
"""


@pytest.mark.parametrize(("physics", "name", "version"), PARITY)
def test_parity(physics, name, version, record_property):
    printed = run("parity", f"env={name}", f"version={version}", f"physics={physics}", "num_envs=24", "steps=40")
    assert "on NVIDIA" in printed and "within tolerance" in printed
    (steps,) = re.findall(r": ([\d,]+) steps", printed)
    (terminations,) = re.findall(r"(\d+ terminations, \d+ mismatches)", printed)
    record_property("measured", f"{steps} steps, {terminations}")


def test_implicitfast_with_activations():
    run_python(IMPLICITFAST, cwd=CLONE)


def test_contacts_of_boxes():
    run_python(BOXES)


def test_hills(tmp_path):
    run("train", *SMALL, "env=walker2d", "env.ground=mixed", "run_dir=run", "total_steps=1", cwd=tmp_path)
    checked_rows(tmp_path / "run", 1)
    assert "Walker2d-v5 on warp, on hills: " in run("eval", "run=run", "backend=sim", "episodes=4", cwd=tmp_path)


def test_own_task(tmp_path):
    (tmp_path / "backward.py").write_text(OWN_TASK)
    settings = (*SMALL, f"env.task={tmp_path}/backward.py:Backward", "recipe=gpu/half_cheetah_ppo")
    run("train", *settings, f"run_dir={tmp_path}/run", "total_steps=1", cwd=tmp_path)
    (row,) = checked_rows(tmp_path / "run", 1)
    assert np.isfinite(list(row.values())).all()
    assert "Final policy" in run("eval", f"run={tmp_path}/run", "episodes=4", cwd=tmp_path)


def test_own_body(tmp_path):
    assets = os.path.join(os.path.dirname(gymnasium.__file__), "envs", "mujoco", "assets")
    with open(os.path.join(assets, "walker2d_v5.xml")) as file:
        model = file.read()
    heavy = model.replace('name="torso_geom"', 'name="torso_geom" mass="10"')
    assert heavy != model
    (tmp_path / "heavy.xml").write_text(heavy)
    run("train", *SMALL, "env=walker2d", "env.xml_file=heavy.xml", "run_dir=run", "total_steps=1", cwd=tmp_path)
    checked_rows(tmp_path / "run", 1)
    assert len(json.loads((tmp_path / "run" / "eval_gymnasium.json").read_text())["final"]["returns"]) == 2


def test_own_reward(tmp_path):
    (tmp_path / "reward.py").write_text(OWN_REWARD)
    run(
        "train",
        *SMALL,
        "env=walker2d",
        "env.reward_function=reward.py:bent",
        "run_dir=run",
        "total_steps=100_000",
        cwd=tmp_path,
    )
    rows = checked_rows(tmp_path / "run", -(-100_000 // (512 * 64)))
    assert rows[-1]["episode/reward_knee"] > 0


@pytest.mark.parametrize("name", ["humanoid-csac", "walker2d-ppo"])
def test_evaluation_in_the_engine(name, record_property):
    printed = run("eval", f"run=zoo:{name}", "backend=sim", "episodes=100")
    mean = float(re.search(r": ([\d,.]+) ± ", printed)[1].replace(",", ""))
    expected = read_scores(zoo.open_run(f"zoo:{name}").gymnasium_scores).blocks["best"]["mean"]
    record_property("measured", f"{mean:,.0f}, in Gymnasium {expected:,.0f}")
    assert abs(mean / expected - 1) < 0.02


def test_play(tmp_path, record_property):
    require("imageio_ffmpeg")
    try:
        renderer = run_python(RENDERER).strip()
    except AssertionError as error:
        if "nothing to render with" in str(error):
            pytest.skip("missing: OpenGL")
        raise
    run("play", "run=zoo:humanoid-csac", "out=walk.mp4", "gait=gait.png", cwd=tmp_path)
    sizes = [(tmp_path / name).stat().st_size for name in ("walk.mp4", "gait.png")]
    assert min(sizes) > 50_000
    record_property("measured", f"{renderer}, {sizes[0]:,} bytes")


def test_onnx_equals_the_policy(tmp_path, record_property):
    require("onnx", "onnxruntime")
    import onnxruntime

    run("export", "run=zoo:humanoid-csac", "format=onnx", "out=policy.onnx", cwd=tmp_path)
    run_python(ACTIONS, str(tmp_path / "actions.npz"))
    with np.load(tmp_path / "actions.npz") as saved:
        observations, actions = saved["observations"], saved["actions"]
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    (found,) = session.run(["action"], {"observation": observations})
    assert actions.shape == (64, 17) and actions.std() > 0.01
    difference = np.abs(found - actions).max()
    record_property("measured", f"largest difference {difference:.1e}")
    assert difference < 1e-4


def test_pytorch(tmp_path, record_property):
    """Tensors on the GPU that a user may overwrite, and the example of the documentation."""
    require("torch")
    run_python(TENSORS)
    example = (CLONE / "docs" / "examples" / "torch_ppo.py").read_text()
    printed = run_python(example, "inverted_pendulum", "256", "1_000_000")
    returns = [float(text) for text in re.findall(r"return ([-\d.]+)", printed)]
    record_property("measured", f"returns of the example: {returns[0]:,.0f} to {max(returns):,.0f}")
    assert max(returns) > 500


def test_gymnasium_batch(record_property):
    total = float(run_python(BATCHES))
    record_property("measured", f"return of 100 steps: {total:,.0f}")
    assert 800 < total < 1000
