"""The kernels that are compiled in parallel are those that a step launches."""

import functools
import logging
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import pytest
import warp as wp
from helpers import slow_except

import mjx_walk
from mjx_walk.envs import GYMNASIUM_TASKS
from mjx_walk.envs.physics import warp_kernels


@pytest.mark.parametrize("name", slow_except(["inverted_pendulum", "humanoid"], GYMNASIUM_TASKS))
def test_they_are_those_of_a_reset_and_a_step(name, monkeypatch):
    env = mjx_walk.make_env(name, physics="warp")
    foreseen = warp_kernels.launched_variants(env.engine._mj_model, env.engine._njmax)
    launched = {}

    def note(launch, kernel, *arguments, **options):
        dim = options["dim"] if "dim" in options else arguments[0]
        if math.prod(dim if isinstance(dim, Sequence) else [dim]):
            launched.setdefault(kernel.module, set()).add(options.get("block_dim"))
        return launch(kernel, *arguments, **options)

    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    for function in ("launch", "launch_tiled"):
        monkeypatch.setattr(wp, function, functools.partial(note, getattr(wp, function)))
    jax.block_until_ready(jax.jit(env.reset)(jax.random.PRNGKey(1)))
    jax.block_until_ready(jax.jit(env.step)(state, jnp.zeros(env.action_size)))
    names, names_foreseen = ({module.name: sizes for module, sizes in x.items()} for x in (launched, foreseen))
    assert len(names) > 20 and names == names_foreseen


def test_what_warp_s_cache_lacks_is_compiled_and_said(monkeypatch, tmp_path, caplog):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(warp_kernels, "_SECONDS_BETWEEN_MESSAGES", 0.0)
    env = mjx_walk.make_env("inverted_pendulum", physics="warp")
    caplog.set_level(logging.INFO, "mjx_walk.progress")
    for future in warp_kernels.load_kernels(env.engine._mj_model, env.engine._njmax, wp.get_device("cpu")):
        future.result()
    last = caplog.messages[-1].split()
    assert last[3] == last[5] and caplog.messages[-1].startswith("Warp has compiled ")
