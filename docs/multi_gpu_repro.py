"""Step Warp's physics on two devices from one process: `python docs/multi_gpu_repro.py PROGRAM [GRAPH_MODE]`.

Prints three lines: compiled, checked against the reference, and environment steps per second. The reference comes from
a CPU: run `JAX_PLATFORMS=cpu NUM_STEPS=1 python docs/multi_gpu_repro.py one` first. `UNUSED=drop` avoids the
crash of `shard_map` and `pmap`; `docs/multi_gpu.md` says why.
"""

import concurrent.futures
import faulthandler
import functools
import os
import sys
import time

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import warp as wp
from jax.interpreters import partial_eval
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from mujoco import mjx

PROGRAMS = ("one", "shard_map", "pmap", "jit", "local", "threads")
NUM_ENVS = int(os.environ.get("NUM_ENVS", "2048"))
"""Per device."""
NUM_STEPS = int(os.environ.get("NUM_STEPS", "10"))
NUM_SUBSTEPS = 5
REFERENCE = os.environ.get("REFERENCE", "one_process_reference.npy")


def make_unroll(graph_mode):
    """Humanoid-v5's physics, `(state [B, …], ctrl [B, nu]) → qpos [T, B, nq]`, and inputs for two devices."""
    assets = os.path.join(os.path.dirname(gymnasium.__file__), "envs/mujoco/assets")
    model = mujoco.MjModel.from_xml_path(os.path.join(assets, "humanoid.xml"))
    model.opt.solver, model.opt.iterations, model.opt.ls_iterations = mujoco.mjtSolver.mjSOL_NEWTON, 8, 8
    mode = None if graph_mode == "default" else wp.JaxCallableGraphMode[graph_mode]
    mx = mjx.put_model(model, impl="warp", graph_mode=mode, device=jax.local_devices()[0])
    mx = jax.tree.map(np.asarray, mx.tree_replace({"opt._impl.warn_overflow": 0}))

    def unroll(state, ctrl):
        with jax.ensure_compile_time_eval():
            blank = mjx.make_data(model, impl="warp", naconmax=40 * len(ctrl) + 256, njmax=112)
            blank = jax.tree.map(np.asarray, blank)
        blank = jax.tree.map(lambda x: jnp.array(x) if x.any() else jnp.zeros(x.shape, x.dtype), blank)

        def fill(qpos, qvel, warmstart, ctrl):
            return blank.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)

        def env_step(state, _):
            data = jax.vmap(fill)(*state, ctrl)
            for _ in range(NUM_SUBSTEPS):
                data = jax.vmap(functools.partial(mjx.step, mx))(data)
            return (data.qpos, data.qvel, data.qacc_warmstart), data.qpos

        return jax.lax.scan(env_step, state, length=NUM_STEPS)[1]

    rng, num = np.random.default_rng(0), 2 * NUM_ENVS
    qpos = np.float32(model.qpos0 + rng.normal(0, 0.05, (num, model.nq)))
    qpos[:, 2] -= rng.uniform(0, 0.3, num)  # many feet touch the floor
    state = (qpos, np.zeros((num, model.nv), np.float32), np.zeros((num, model.nv), np.float32))
    return unroll, (state, np.float32(rng.uniform(-0.4, 0.4, (num, model.nu))))


def without_unused_inputs(function):
    """Drop unused constants, make empty ones inside, and use all others: `shard_map` then has no unused input."""

    def changed(*args):
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*args)
        eqns = closed.jaxpr.replace(constvars=(), invars=[*closed.jaxpr.constvars, *closed.jaxpr.invars])
        jaxpr, is_used = partial_eval.dce_jaxpr(eqns, [True] * len(eqns.outvars))
        constants = [x if x.size else jnp.zeros(x.shape, x.dtype) for x in closed.consts]
        constants = jax.lax.optimization_barrier(constants)
        inputs = [*constants, *jax.tree.leaves(args)]
        out = jax.core.eval_jaxpr(jaxpr, (), *(x for x, used in zip(inputs, is_used, strict=True) if used))
        return jax.tree.unflatten(jax.tree.structure(shape), out)

    return changed


def compile_call(program, unroll, inputs):
    """A compiled function without arguments, and what makes its result one `[T, 2·NUM_ENVS, nq]`."""
    devices = jax.local_devices()[:2]
    if os.environ.get("UNUSED") == "drop":
        unroll = without_unused_inputs(unroll)
    together = functools.partial(np.concatenate, axis=1)
    if program in ("one", "local", "threads"):
        targets = devices if program != "one" else devices[:1] * 2
        halves = zip(*(np.split(x, 2) for x in jax.tree.leaves(inputs)), strict=True)
        parts = [
            jax.device_put(jax.tree.unflatten(jax.tree.structure(inputs), half), device)
            for half, device in zip(halves, targets, strict=True)
        ]
        steps = [jax.jit(unroll).lower(*part).compile() for part in parts]
        if program == "threads":
            pool = concurrent.futures.ThreadPoolExecutor(2)
            return lambda: list(pool.map(lambda step, part: step(*part), steps, parts)), together
        return lambda: [step(*part) for step, part in zip(steps, parts, strict=True)], together
    mesh = Mesh(np.array(devices), ("devices",))
    over, out = P("devices"), P(None, "devices")
    if program == "pmap":
        inputs = jax.tree.map(lambda x: x.reshape(2, NUM_ENVS, *x.shape[1:]), inputs)
        step, to_result = jax.pmap(unroll, "devices", devices=devices), lambda x: together(np.asarray(x))
    else:
        if program == "shard_map":
            unroll = jax.shard_map(unroll, mesh=mesh, in_specs=over, out_specs=out, check_vma=False)
        step, to_result = jax.jit(unroll, out_shardings=NamedSharding(mesh, out)), np.asarray
    inputs = jax.device_put(inputs, NamedSharding(mesh, over))
    compiled = step.lower(*inputs).compile()
    return lambda: compiled(*inputs), to_result


def main(program, graph_mode="default", seconds=2.0):
    """Compile, run, compare, measure."""
    unroll, inputs = make_unroll(graph_mode)
    start = time.perf_counter()
    call, to_result = compile_call(program, unroll, inputs)
    print(f"{program} {graph_mode} compiled in {time.perf_counter() - start:.1f} s", flush=True)
    qpos = to_result(jax.block_until_ready(call()))
    if not os.path.exists(REFERENCE):
        np.save(REFERENCE, qpos[:1])
    qpos = to_result(jax.block_until_ready(call()))  # the second call replays what Warp has recorded
    difference = np.abs(qpos[0] - np.load(REFERENCE)[0]).max()
    is_finite, largest = np.isfinite(qpos).all(), np.abs(qpos).max()
    found = f"difference after one step {difference:.1e}, finite {is_finite}, largest position {largest:.3f}"
    print(f"{program} {graph_mode} checked: {found}", flush=True)
    start, calls = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        jax.block_until_ready(call())
        calls += 1
    rate = calls * NUM_STEPS * 2 * NUM_ENVS / (time.perf_counter() - start)
    print(f"{program} {graph_mode} {rate:,.0f} steps/s", flush=True)


if __name__ == "__main__":
    faulthandler.enable()
    if len(sys.argv) not in (2, 3) or sys.argv[1] not in PROGRAMS:
        sys.exit(f"usage: multi_gpu_repro.py {'|'.join(PROGRAMS)} [GRAPH_MODE]")
    main(*sys.argv[1:])
