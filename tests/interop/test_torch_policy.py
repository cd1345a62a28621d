"""Policies as PyTorch's modules. PyTorch is installed for campaigns only."""

import importlib.util
import json

import jax
import numpy as np
import pytest
from helpers import command_here
from safetensors import safe_open

import mjx_walk
from mjx_walk import zoo
from mjx_walk.algos import make_algorithm
from mjx_walk.evaluation.saved_policies import make_task
from mjx_walk.interop.torch_policy import MODULE, WEIGHTS, write_policy
from mjx_walk.settings.config import load_config
from mjx_walk.settings.saved_config import save_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST
from mjx_walk.utils.errors import UserError

needs_torch = pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="pip install torch")


def assert_equal_actions(run, folder):
    import torch

    torch.set_num_threads(1)
    spec = importlib.util.spec_from_file_location("policy", folder / MODULE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    observations = np.random.default_rng(1).normal(size=(32, run.task.observation_size))
    with torch.no_grad():
        actions = module.Policy(folder / WEIGHTS)(torch.from_numpy(observations)).numpy()
    assert actions.std() > 1e-3
    np.testing.assert_allclose(actions, run.policy(observations), atol=2e-5)


@pytest.mark.slow
@needs_torch
@pytest.mark.parametrize("name", ["humanoid-csac", "humanoid_standup-td3", "pusher-csac", "walker2d-ppo"])
def test_modules_act_as_policies_of_the_zoo(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert command_here("export", f"run=zoo:{name}", "format=torch") == 0
    assert capsys.readouterr().out.startswith(f"{name}.torch: the best policy (step ")
    assert_equal_actions(mjx_walk.load_run(f"zoo:{name}", physics="c"), tmp_path / f"{name}.torch")


@pytest.mark.slow
@needs_torch
@pytest.mark.parametrize(
    "settings",
    [
        ("algo=ppo", "algo.distribution=normal", "algo.activation=elu"),
        ("algo=ppo", "algo.distribution=normal", "algo.state_dependent_std=true", "algo.observation_clip=null"),
        ("algo=td3", "algo.policy_layer_norm=true", "algo.policy_hidden_layer_sizes=[16,16]"),
    ],
)
def test_modules_act_as_other_networks(settings, tmp_path):
    """Networks and normalizers with random numbers."""
    config = load_config(["env=hopper", "physics=c", *settings])
    algorithm = make_algorithm(make_task(config), config.num_envs, config.evaluation, config.algo)
    shapes, rng = jax.eval_shape(algorithm.policy_params, algorithm.state_shapes()), np.random.default_rng(0)
    params = jax.tree.map(lambda leaf: np.asarray(rng.uniform(0.1, 0.5, leaf.shape), leaf.dtype), shapes)
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    save_config(config, folder.config)
    checkpoint.save(folder.policy(BEST), params, {"env_steps": 0})
    run = mjx_walk.load_run(folder.path, physics="c")
    write_policy(tmp_path, run, {})
    assert_equal_actions(run, tmp_path)


def test_files_describe_the_policy(tmp_path):
    assert command_here("export", "run=zoo:hopper-csac", "format=torch", f"out={tmp_path}") == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == [MODULE, WEIGHTS]
    with safe_open(tmp_path / WEIGHTS, "numpy") as file:
        metadata, names = file.metadata(), {*file.keys()}
    assert metadata["task"] == "Hopper-v5" and json.loads(metadata["network"])["sizes"] == [11, 512, 512, 3]
    assert json.loads(metadata["seconds_per_step"]) == 0.008
    assert {"mean", "std", "low", "high", "network.0.weight", "network.4.bias"} < names


def test_the_name_of_a_file_is_refused(tmp_path, capsys):
    assert command_here("export", "run=zoo:hopper-csac", "format=torch", f"out={tmp_path}/policy.safetensors") == 2
    assert (
        "format=torch writes a folder with policy.safetensors and policy.py; name a folder" in capsys.readouterr().err
    )
    assert not any(tmp_path.iterdir())


def test_networks_that_pytorch_lacks_are_refused(tmp_path, monkeypatch):
    run = mjx_walk.load_run(zoo.open_run("zoo:hopper-csac").path, physics="c")
    monkeypatch.setattr(run.config.algo, "activation", "gelu")
    with pytest.raises(UserError, match="no activation 'gelu'"):
        write_policy(tmp_path, run, {})
    monkeypatch.setattr(run.config.algo, "activation", "tanh")
    with pytest.raises(UserError, match="do not give this policy's actions"):
        write_policy(tmp_path, run, {})
    assert not [*tmp_path.iterdir()]
