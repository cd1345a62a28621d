"""Trainers in PyTorch: plain, and rsl_rl's. PyTorch is installed for campaigns only."""

import dataclasses
import re
import runpy
import sys

import gymnasium
import jax
import numpy as np
import pytest
from helpers import CLONE

import mjx_walk
from mjx_walk.utils.errors import UserError

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
torch = pytest.importorskip("torch", reason="pip install torch")

PENDULUM = {"env": "inverted_pendulum", "physics": "c"}
TASK = {"env": "hopper", "physics": "c", "max_episode_steps": 30}


@pytest.fixture(autouse=True)
def one_thread():
    """Several threads wait for each other while another test runs."""
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def env():
    return mjx_walk.make_torch_env(num_envs=8, **TASK)


def random_actions(count):
    return torch.rand(count, 8, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1


def test_steps_are_those_of_gymnasium(env):
    """A state of ours, set in Gymnasium, leads to the same observations, rewards and end."""
    real = gymnasium.make("Hopper-v5", max_episode_steps=30)
    real.reset(seed=0)
    env.reset(seed=0)
    physics = env._state.env.physics
    real.unwrapped.set_state(np.asarray(physics.qpos[0], np.float64), np.asarray(physics.qvel[0], np.float64))
    for actions in random_actions(30):
        _, reward, terminated, truncated, info = env.step(actions)
        obs, expected, is_terminated, _, _ = real.step(actions[0].numpy())
        np.testing.assert_allclose(info["final_obs"][0], obs, atol=2e-3)
        assert float(reward[0]) == pytest.approx(expected, abs=2e-3) and bool(terminated[0]) == is_terminated
        if is_terminated or truncated[0]:
            break
    assert is_terminated or truncated[0]


def test_tensors_are_the_users_own(env):
    """Values that a user overwrites or keeps stay apart from the environments."""
    records = []
    for overwrites in (False, True):
        obs, _ = env.reset(seed=1)
        kept = [obs.clone()]
        for actions in random_actions(20):
            if overwrites:
                obs.fill_(torch.nan)
            result = env.step(actions)
            obs = result[0]
            kept += [value.clone() for value in (*result[:4], result[4]["final_obs"], result[4]["episode"]["r"])]
            if overwrites:
                for value in (*result[1:4], result[4]["final_obs"], result[4]["episode"]["r"]):
                    value.zero_()
        records.append(kept)
    assert all(torch.equal(a, b) for a, b in zip(*records, strict=True))


def test_no_tensor_shares_memory_with_the_state(env):
    obs, _ = env.reset(seed=1)
    *others, info = env.step(random_actions(1)[0])
    tensors = [obs, *others, info["final_obs"], *info["episode"].values(), env.episode_steps]
    own = {leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(env._state)}
    assert not own & {tensor.data_ptr() for tensor in tensors}


def test_programs_are_compiled_once():
    env = mjx_walk.make_torch_env(num_envs=4, **PENDULUM)
    env.reset(seed=0)
    env.episode_steps = torch.arange(4)
    for _ in range(3):
        env.step(torch.zeros(4, 1))
    env.reset()
    env.step(torch.zeros(4, 1))
    assert env._batch.step._cache_size() == 1


@pytest.mark.parametrize("steps", [torch.zeros(5), torch.tensor(3), torch.full((8,), -1), torch.full((8,), 2**40)])
def test_bad_episode_steps_are_refused(env, steps):
    env.reset(seed=0)
    with pytest.raises(UserError, match=r"^episode_steps: give 8 integers from 0 on, one for each environment$"):
        env.episode_steps = steps


def test_kept_tensors_do_not_change(env):
    obs, _ = env.reset(seed=1)
    kept = [obs, env.episode_steps]
    copies = [value.clone() for value in kept]
    for actions in random_actions(5):
        env.step(actions)
    assert all(torch.equal(a, b) for a, b in zip(kept, copies, strict=True))


def test_an_end_is_marked_and_described(env):
    env.reset(seed=0)
    env.episode_steps = torch.full((8,), 29)
    obs, _, terminated, truncated, info = env.step(random_actions(1)[0])
    assert truncated.all() and info["_final_obs"].all() and info["_episode"].all() and not terminated.all()
    assert info["episode"]["l"].tolist() == [30] * 8 and not torch.equal(obs, info["final_obs"])
    assert env.episode_steps.tolist() == [0] * 8


def test_actions_may_be_of_any_dtype_and_need_gradients(env):
    env.reset(seed=0)
    actions = random_actions(1)[0]
    first = env.step(actions)[0]
    env.reset(seed=0)
    again = env.step(actions.double().requires_grad_().t().contiguous().t())[0]
    assert torch.equal(first, again)
    env.reset(seed=0)
    assert torch.equal(first, env.step(actions.numpy())[0])
    with pytest.raises(ValueError, match=r"Expected \(8, 3\), found .*4, 3"):
        env.step(actions[:4])


def test_a_step_needs_a_reset():
    fresh = mjx_walk.make_torch_env(num_envs=8, **TASK)
    with pytest.raises(gymnasium.error.ResetNeeded):
        fresh.step(random_actions(1)[0])
    with pytest.raises(gymnasium.error.ResetNeeded):
        fresh.episode_steps = torch.zeros(8)


@pytest.mark.parametrize(("device", "says"), [("cuda", "JAX computes on cpu"), ("graphics", "choose cpu or cuda")])
def test_another_device_is_refused(device, says):
    with pytest.raises(UserError, match=f"^device={device}: {says}"):
        mjx_walk.make_torch_env(num_envs=8, device=device, **TASK)


def test_the_example_learns_to_balance(monkeypatch, capsys):
    """It is docs/examples/torch_ppo.py, unchanged."""
    example = CLONE / "docs" / "examples" / "torch_ppo.py"
    monkeypatch.setattr(sys, "argv", [str(example), "inverted_pendulum", "64", "60_000"])
    runpy.run_path(str(example), run_name="__main__")
    returns = [float(text) for text in re.findall(r"return ([-\d.]+)", capsys.readouterr().out)]
    assert returns[0] < 60 and max(returns) > 200


def test_rsl_rl_learns_to_balance(monkeypatch, capsys, tmp_path):
    """It is docs/examples/rsl_rl_ppo.py, unchanged."""
    pytest.importorskip("rsl_rl", reason="pip install rsl-rl-lib")
    example = CLONE / "docs" / "examples" / "rsl_rl_ppo.py"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example), "inverted_pendulum", "64", "30"])
    runpy.run_path(str(example), run_name="__main__")
    lengths = [float(text) for text in re.findall(r"Mean episode length: ([\d.]+)", capsys.readouterr().out)]
    assert max(lengths) > 5 * lengths[0]


def test_rsl_rls_actions_span_the_range_of_the_motors():
    pytest.importorskip("rsl_rl", reason="pip install rsl-rl-lib")
    env = mjx_walk.make_rsl_rl_env(num_envs=8, seed=3, **PENDULUM)
    plain = mjx_walk.make_torch_env(num_envs=8, **PENDULUM)
    plain.reset(seed=3)
    actions = torch.linspace(-1, 1, 8)[:, None]
    obs, _, dones, extras = env.step(actions)
    expected, *_ = plain.step(3 * actions)  # the motor of the pendulum takes -3 to 3
    assert torch.equal(obs["policy"], expected) and dones.dtype == torch.long and not extras["time_outs"].any()
    assert dataclasses.asdict(env.cfg)["name"] == "inverted_pendulum"  # as its loggers read it
