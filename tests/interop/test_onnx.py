"""ONNX gives the actions that JAX gives."""

import json
import re
import subprocess
import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
from helpers import blocks, command_here, slow_except

import mjx_walk
from mjx_walk import zoo
from mjx_walk.algos import make_algorithm
from mjx_walk.api import make_task
from mjx_walk.evaluation.saved_policies import deterministic_act
from mjx_walk.interop.onnx import translate
from mjx_walk.settings.config import load_config
from mjx_walk.utils.errors import UserError


def assert_equal(model, act, observations, dtype=np.float64):
    session = onnxruntime.InferenceSession(model.SerializeToString())
    (found,) = session.run(["action"], {"observation": observations.astype(dtype)})
    expected = np.asarray(act(np.float32(observations)))
    assert found.shape == expected.shape and found.dtype == np.float32
    assert expected.size == 1 or expected.std() > 0.01
    # For the policies in the zoo, float32 alone changes an action by up to 1.5e-5 against float64.
    np.testing.assert_allclose(found, expected, atol=4e-5)


@pytest.mark.parametrize("name", slow_except(("humanoid-csac", "humanoid-td3", "walker2d-ppo"), zoo.names()))
def test_policies_of_the_zoo(name):
    run = mjx_walk.load_run(f"zoo:{name}", "c")
    normalizer = run.policy_params[0]
    rng = np.random.default_rng(0)
    observations = np.asarray(normalizer.mean) + 2.0 * np.asarray(normalizer.std) * rng.normal(
        size=(64, run.task.observation_size)
    )
    model = translate(run.act, run.task.observation_size, name)
    assert_equal(model, run.act, observations)
    assert_equal(model, run.act, observations[:1])
    assert_equal(translate(run.act, run.task.observation_size, name, "float32"), run.act, observations, np.float32)
    num_weights = sum(x.size for x in jax.tree.leaves(run.policy_params))
    assert len(model.SerializeToString()) < 4 * num_weights + 10_000  # each is written once


@pytest.mark.parametrize(
    "overrides",
    [
        ["algo=ppo", "algo.distribution=normal", "algo.activation=tanh"],
        ["algo=a2c", "algo.state_dependent_std=true", "algo.activation=relu"],
        ["algo=reinforce", "algo.activation=leaky_relu"],
        ["algo=sac", "algo.policy_layer_norm=true", "algo.activation=elu"],
        ["algo=sac", "algo.observation_clip=null", "algo.activation=gelu"],
        ["algo=td3", "algo.policy_layer_norm=true", "algo.activation=silu", "env.version=v4"],
        ["algo=ddpg", "algo.activation=softplus", "env=humanoid"],
        ["algo=csac", "algo.activation=sigmoid"],
    ],
)
def test_every_setting_of_the_networks(overrides):
    """Random weights, of a size that spreads the actions."""
    config = load_config(["env=walker2d", "physics=c", *overrides])
    task = make_task(config)
    algorithm = make_algorithm(task, config.num_envs, config.evaluation, config.algo)
    normalizer, params = algorithm.policy_params(jax.jit(algorithm.init)(jax.random.PRNGKey(0)))
    normalizer = normalizer.replace(mean=normalizer.mean + 0.3, std=normalizer.std * 2.0)
    rng = np.random.default_rng(0)

    def drawn(x):
        noise = rng.normal(size=x.shape)
        return jnp.float32(noise * 1.5 / np.sqrt(len(x)) if x.ndim == 2 else x + 0.1 * noise)

    params = jax.tree.map(drawn, params)
    act = deterministic_act(algorithm, (normalizer, params))
    observations = rng.normal(size=(64, task.observation_size))
    assert_equal(translate(act, task.observation_size, "policy"), act, observations)


def test_what_cannot_be_translated_is_named():
    with pytest.raises(UserError, match="there is no translation for 'sort'"):
        translate(jnp.sort, 5, "policy")


def test_example_of_readme(tmp_path, capsys):
    """Gymnasium driven by nothing but onnxruntime."""
    assert command_here("export", "run=zoo:humanoid-csac", f"out={tmp_path}/humanoid-csac.onnx") == 0
    assert "observation [N, 348] → action [N, 17]" in capsys.readouterr().out
    (example,) = [block for block in blocks("python") if block.startswith("# without_jax.py")]
    assert len(example.splitlines()) <= 15
    example += '\nimport sys\nassert not {"jax", "mjx_walk"} & set(sys.modules)'
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (total,) = re.findall(r"return ([\d,]+)", done.stdout)
    assert int(total.replace(",", "")) > 11_500
    facts = onnxruntime.InferenceSession(tmp_path / "humanoid-csac.onnx").get_modelmeta().custom_metadata_map
    model = gymnasium.make(facts["task"], **json.loads(facts["keywords"])).unwrapped.model
    assert json.loads(facts["motors"]) == [model.actuator(i).name for i in range(17)]
    assert json.loads(facts["seconds_per_step"]) == pytest.approx(0.015)
    assert sum(json.loads(facts["observation"]).values()) == 348
    assert (facts["algorithm"], facts["policy"]) == ("csac", "best")


def test_export_prints_a_one_line_error(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for arguments, message in (
        ((), "say which run: run=RUN_DIR, or run=zoo:NAME; python -m mjx_walk.zoo lists the names"),
        (("run=zoo:walker2d-sac", "format=tflite"), "format=tflite"),
        (("run=zoo:walker2d-sac", f"out={tmp_path}/file/policy.onnx"), "cannot write"),
    ):
        assert command_here("export", *arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: ") and message in line


def test_policies_multiply_in_float32_whatever_the_device_s_precision():
    run = mjx_walk.load_run("zoo:walker2d-td3", "c")
    with jax.default_matmul_precision("tensorfloat32"):
        program = str(jax.make_jaxpr(run.act)(jnp.zeros(17)))
    assert program.count("dot_general[") == program.count("precision=(Precision.HIGHEST, Precision.HIGHEST)") == 3
