"""A process uses its own device, whatever number that device has among those of all processes."""

import socket
import subprocess
import sys
from types import SimpleNamespace

import jax
import pytest
import warp as wp
from helpers import ENVIRONMENT

from mjx_walk.envs.physics.mjx_warp import warp_device
from mjx_walk.machine.devices import default_device, device_memory

IN_EVERY_PROCESS = """
import sys
import jax
jax.distributed.initialize(sys.argv[1], 2, int(sys.argv[2]))
from mjx_walk.envs.physics.mjx_warp import warp_device
from mjx_walk.machine.devices import default_device, device_memory
device = default_device()
assert device.process_index == jax.process_index() and device in jax.local_devices(), device
assert device_memory() > 0 and warp_device(device).is_cpu
print(device == jax.devices()[0])
"""


@pytest.mark.parametrize(("number", "place"), [(0, 0), (1, 0), (5, 1)])
def test_warp_counts_the_gpus_of_its_process(number, place, monkeypatch):
    monkeypatch.setattr(wp, "get_cuda_device", lambda ordinal: f"cuda:{ordinal}")
    assert warp_device(SimpleNamespace(platform="gpu", id=number, local_hardware_id=place)) == f"cuda:{place}"


def test_the_default_device_is_the_one_that_is_set():
    cpu = jax.local_devices(backend="cpu")[0]
    assert default_device() == cpu and device_memory() > 2**30
    for chosen in (cpu, "cpu"):
        with jax.default_device(chosen):
            assert default_device() == cpu and warp_device(default_device()).is_cpu


@pytest.mark.slow
def test_every_process_finds_its_own_device():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", IN_EVERY_PROCESS, address, str(index)],
            env=ENVIRONMENT,
            stdout=subprocess.PIPE,
            text=True,
        )
        for index in (0, 1)
    ]
    outputs = [process.communicate(timeout=300)[0].split()[-1:] for process in processes]
    assert outputs == [["True"], ["False"]]
