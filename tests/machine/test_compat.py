"""JAX's settings: prepared by those who start programs, and restored at the end of a run."""

import contextlib
import os
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import pytest
from helpers import ENVIRONMENT, TINY, TINY_CALL

import mjx_walk
from mjx_walk.machine.compat import temporary_jax_settings

FLAG = "--xla_cpu_experimental_ynn_fusion_type"


def settings_of_process():
    environment = {name: value for name, value in os.environ.items() if name != "CRC32C_SW_MODE"}  # by tensorboardX
    return dict(jax.config.values), jax.config.jax_default_matmul_precision, environment


@pytest.mark.parametrize("chosen", [None, "own"])
def test_a_run_leaves_the_settings_of_its_caller(chosen, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    own = str(tmp_path / chosen) if chosen else None
    former = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", own)
    try:
        before = settings_of_process()
        with jax.default_matmul_precision("bfloat16"), temporary_jax_settings("float32"):
            assert jax.config.jax_default_matmul_precision == "float32"
            assert jax.config.jax_compilation_cache_dir == (own or str(tmp_path / "user" / "mjx_walk" / "jax"))
        callers = (jax.enable_x64(True), jax.default_prng_impl("rbg"), jax.numpy_rank_promotion("raise"))
        warned = pytest.warns(UserWarning, match="JAX_DISABLE_JIT is ignored here")
        with contextlib.ExitStack() as settings:
            for setting in (*callers, jax.disable_jit(), warned):
                settings.enter_context(setting)
            run = mjx_walk.run([*TINY, f"run_dir={tmp_path}/run", f"total_steps={TINY_CALL}"])
        assert settings_of_process() == before
        assert not {leaf.dtype for leaf in jax.tree.leaves(run.policy_params)} & {jnp.dtype("f8"), jnp.dtype("i8")}
    finally:
        jax.config.update("jax_compilation_cache_dir", former)


CACHED = """
import os, sys
import jax
from mjx_walk.machine.compat import temporary_jax_settings
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

def compile_a_program(name):
    jax.jit(lambda x: x + hash(name) % 1000)(1.0)

compile_a_program("before")
for name in ("first", "second"):
    with temporary_jax_settings("float32"):
        compile_a_program(name)
    programs = len(os.listdir(sys.argv[1]))
    compile_a_program(f"after {name}")
    assert len(os.listdir(sys.argv[1])) == programs, "the cache stays open"
    print(programs)
"""


def test_the_cache_is_used_in_runs_alone(tmp_path):
    env = ENVIRONMENT | {"XDG_CACHE_HOME": str(tmp_path), "PYTHONHASHSEED": "0"}
    env.pop("JAX_COMPILATION_CACHE_DIR", None)
    code = [sys.executable, "-c", CACHED, str(tmp_path / "mjx_walk" / "jax")]
    done = subprocess.run(code, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    first, second = map(int, done.stdout.split())
    assert 0 < first < second


def flags_and_warnings(code, flags):
    lines = f"import os, warnings\nwarnings.simplefilter('always')\n{code}\nprint(os.environ['XLA_FLAGS'])"
    env = ENVIRONMENT | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    done = subprocess.run([sys.executable, "-c", lines], env=env, capture_output=True, text=True, check=True)
    return done.stdout.strip(), done.stderr.count("JAX started without XLA_FLAGS")


@pytest.mark.parametrize(
    ("before", "flags", "expected", "num_warnings"),
    [
        ("import jax", "", f"{FLAG}=-reduce", 0),
        ("import jax", f"{FLAG}=dot", f"{FLAG}=dot", 0),
        ("import jax; jax.devices()", "", f"{FLAG}=-reduce", 1),
        ("import jax; jax.devices()", f"{FLAG}=-reduce", f"{FLAG}=-reduce", 0),
    ],
)
def test_prepare_jax_sets_a_flag_and_warns_once_if_it_is_late(before, flags, expected, num_warnings):
    code = f"{before}\nimport mjx_walk\nmjx_walk.prepare_jax()\nmjx_walk.make_env('walker2d', physics='c')"
    assert flags_and_warnings(code, flags) == (expected, num_warnings)


def test_no_test_runs_without_the_flag():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mjx_walk.prepare_jax()
    assert FLAG in os.environ["XLA_FLAGS"]


@pytest.mark.parametrize(("physics", "is_compiled_alone"), [("c", False), ("c", True), ("jax", False)])
def test_a_task_keeps_its_dtypes_inside_a_program_with_64_bits(physics, is_compiled_alone):
    """Traced, not run. A `scan` needs the same dtypes in and out."""
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        task = mjx_walk.make_env("inverted_pendulum", physics=physics)
        step = jax.jit(task.step) if is_compiled_alone else task.step

        def play(keys):
            state = jax.vmap(task.reset)(keys)
            actions = jnp.zeros((2, 3, 1))
            assert actions.dtype == jnp.float64
            return jax.lax.scan(lambda state, action: (jax.vmap(step)(state, action), state.obs), state, actions)

        state, obs = jax.eval_shape(play, jax.random.split(jax.random.PRNGKey(0), 3))
    assert {str(leaf.dtype) for leaf in jax.tree.leaves((state, obs))} == {"float32", "int32", "bool"}


def test_a_policy_of_the_zoo_acts_alike_with_64_bits():
    actions = []
    for has_64_bits in (False, True):
        with jax.enable_x64(has_64_bits):
            run = mjx_walk.load_run("zoo:walker2d-td3", physics="c")
            actions.append(run.policy(jnp.linspace(-1.0, 1.0, 17)))
    assert actions[0].dtype == actions[1].dtype == "float32" and (actions[0] == actions[1]).all()
