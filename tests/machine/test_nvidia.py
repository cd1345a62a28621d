"""A GPU that JAX or Warp does not use: one line says why, and what to install. The machines are made of files."""

import logging
import warnings

import jax
import pytest

from mjx_walk.cli.console import console
from mjx_walk.envs.physics import resolve_engine
from mjx_walk.machine import nvidia
from mjx_walk.machine.nvidia import Machine, warp_misfit, why_unused

VERSION = "NVRM version: NVIDIA UNIX x86_64 Kernel Module  {}  Sat Aug 19 01:15:15 UTC 2023\nGCC version: 11.4.0\n"
OPEN_MODULE = "NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  {}  Release Build  (dvs-builder@U22-I3)\n"
PLUGIN = {"jaxlib": "0.10.2", "jax-cuda13-plugin": "0.10.2"}
OLD_PLUGIN = {"jaxlib": "0.10.2", "jax-cuda12-plugin": "0.10.2"}


def machine(root, driver=None, devices=("nvidia0", "nvidiactl"), text=VERSION, pci=(), cuda=None):
    """A machine with these files."""
    for device in devices:
        (root / "dev").mkdir(exist_ok=True)
        (root / "dev" / device).touch()
    if driver:
        (root / "proc/driver/nvidia/gpus/0000:01:00.0").mkdir(parents=True)
        (root / "proc/driver/nvidia/version").write_text(text.format(driver))
    for number, (vendor, kind) in enumerate(pci):
        card = root / f"sys/bus/pci/devices/{number}"
        card.mkdir(parents=True)
        (card / "vendor").write_text(f"{vendor}\n")
        (card / "class").write_text(f"{kind}\n")
    return Machine.seen(root, lambda: cuda)


REASONS = {
    "no plugin": ({"driver": "580.159.04"}, {}, "CUDA plugin is not installed; pip install 'mjx-walk[cuda]'"),
    "no plugin, an older driver": (
        {"driver": "535.104.05"},
        {},
        "CUDA plugin is not installed; pip install 'mjx-walk[cuda12]', since the driver, 535.104.05, is older than 580",
    ),
    "no plugin, an old driver": (
        {"driver": "470.223.02"},
        {},
        "not installed; update the driver, 470.223.02, to 580 or later, and pip install 'mjx-walk[cuda]'",
    ),
    "no plugin, an unknown driver": (
        {},
        {},
        "not installed; pip install 'mjx-walk[cuda]' with driver 580 or later, 'mjx-walk[cuda12]' with driver 525",
    ),
    "WSL": (
        {"devices": ("dxg",), "cuda": 12020},
        {},
        "pip install 'mjx-walk[cuda12]', since the driver, for CUDA 12.2, is older than 580",
    ),
    "a library that is newer than the driver": (
        {"driver": "535.104.05", "cuda": 13000},
        {},
        "CUDA plugin is not installed; pip install 'mjx-walk[cuda]'",
    ),
    "a driver too old for CUDA 13": (
        {"driver": "550.54.14", "text": OPEN_MODULE},
        {"installed": PLUGIN},
        "the driver, 550.54.14, is older than 580, which JAX's CUDA 13 plugin needs; update it, or pip uninstall "
        "jax-cuda13-plugin jax-cuda13-pjrt and pip install 'mjx-walk[cuda12]'",
    ),
    "a driver too old for CUDA 12": (
        {"driver": "515.65.01"},
        {"installed": OLD_PLUGIN},
        "the driver, 515.65.01, is older than 525, which JAX's CUDA 12 plugin needs; update it",
    ),
    "hidden": ({"driver": "580.1"}, {"visible": "", "installed": PLUGIN}, "CUDA_VISIBLE_DEVICES= hides it; unset"),
    "hidden by -1": ({"driver": "580.1"}, {"visible": "-1", "installed": PLUGIN}, "CUDA_VISIBLE_DEVICES=-1 hides it"),
    "a plugin of another version": (
        {"driver": "580.1"},
        {"installed": PLUGIN | {"jaxlib": "0.10.1"}},
        "jax-cuda13-plugin 0.10.2 does not fit jaxlib 0.10.1; pip install 'jax[cuda13]==0.10.1'",
    ),
    "a plugin that fails": (
        {"driver": "580.1"},
        {"installed": PLUGIN, "error": "no supported devices\nfound", "visible": "0"},
        "its CUDA 13 plugin does not start (no supported devices found); check that nvidia-smi lists GPUs, "
        "CUDA_VISIBLE_DEVICES=0 names one, and LD_LIBRARY_PATH is unset",
    ),
    "a container": ({"driver": "580.1", "devices": ()}, {}, "this container has no access to it; start it with GPUs"),
    "no driver": (
        {"devices": (), "pci": [("0x10de", "0x030000")]},
        {},
        "no NVIDIA driver is loaded; install release 580",
    ),
}


@pytest.mark.parametrize(("files", "surroundings", "says"), REASONS.values(), ids=REASONS.keys())
def test_one_line_says_why_and_what_to_do(tmp_path, files, surroundings, says):
    arguments = {"visible": None, "installed": {"jaxlib": "0.10.2"}} | surroundings
    line = why_unused(machine(tmp_path, **files), **arguments)
    assert line.startswith("this machine has an NVIDIA GPU, but JAX runs on the CPU: ")
    assert says in line and "\n" not in line


@pytest.mark.parametrize(
    "files",
    [{}, {"pci": [("0x1002", "0x030000"), ("0x10de", "0x040300")]}, {"devices": ("dxg", "dri")}],
    ids=["a CPU", "AMD's card, and NVIDIA's sound", "WSL without NVIDIA"],
)
def test_without_a_gpu_there_is_no_line(tmp_path, files):
    assert why_unused(machine(tmp_path, **{"devices": ()} | files), None, {}) is None


@pytest.mark.parametrize(
    ("driver", "version", "says"),
    [
        ("580.95.05", "1.18.0", None),
        ("535.104.05", "1.18.0+cu12", None),
        ("535.104.05", "1.18.0", "the NVIDIA driver, 535.104.05, is older than 580, which Warp 1.18.0 needs"),
        ("470.1", "1.18.0+cu12", "older than 525, which Warp 1.18.0+cu12 needs; update it"),
        (None, "1.18.0", None),
    ],
)
def test_warp_needs_a_driver_too(tmp_path, driver, version, says):
    misfit = warp_misfit(machine(tmp_path, driver), version)
    assert misfit is says is None or says in misfit


@pytest.mark.parametrize(("platforms", "name", "count"), [(None, "auto", 1), ("cpu", "auto", 0), (None, "c", 0)])
def test_it_is_said_once_and_not_to_those_who_want_the_cpu(tmp_path, monkeypatch, platforms, name, count):
    machine(tmp_path, "580.1")
    monkeypatch.setattr(nvidia, "ROOT", tmp_path)
    nvidia.warn_of_unused_gpu.cache_clear()
    former = jax.config.jax_platforms
    jax.config.update("jax_platforms", platforms)
    try:
        with warnings.catch_warnings(record=True) as caught:
            assert [resolve_engine(name), resolve_engine(name)] == ["c", "c"]
    finally:
        jax.config.update("jax_platforms", former)
        nvidia.warn_of_unused_gpu.cache_clear()
    assert ["'mjx-walk[cuda]'" in str(warning.message) for warning in caught] == [True] * count


def test_jax_does_not_say_it_a_second_time(caplog):
    with console():
        for text in (
            "An NVIDIA GPU may be present on this machine, but",
            "CUDA backend failed to initialize:",
            "other",
        ):
            logging.getLogger("jax._src.xla_bridge").warning(text)
    assert caplog.messages == ["other"]
