"""What imports do, and which modules are named where import-linter does not look: in strings."""

import importlib.util
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from helpers import ENVIRONMENT

CLONE = Path(__file__).parent.parent
LAYERS = tomllib.loads((CLONE / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]["layers"]

IMPORT_ALL = """
import contextlib, gc, importlib, os, pkgutil, warnings
import gymnasium, jax, onnx, tensorboardX, wandb  # some of these set variables
OPTIONAL = ("h5py", "minari", "torch", "stable_baselines3", "tensordict", "rsl_rl")
for name in OPTIONAL:
    with contextlib.suppress(ModuleNotFoundError):
        importlib.import_module(name)
from mujoco.mjx._src import collision_driver
from mujoco.mjx.third_party.mujoco_warp._src import collision_primitive

def world():
    collisions = dict(collision_driver._COLLISION_FUNC), collision_primitive.plane_capsule
    return dict(os.environ), gc.isenabled(), gc.get_freeze_count(), dict(jax.config.values), collisions

before = world()
import mjx_walk
names = [module.name for module in pkgutil.walk_packages(mjx_walk.__path__, "mjx_walk.")]
assert "mjx_walk.envs.physics.mjx_warp" in names and "mjx_walk.train" in names
for name in names:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        assert error.name in OPTIONAL, error
after = world()
assert before == after, [pair for pair in zip(before, after) if pair[0] != pair[1]]
assert not jax._src.xla_bridge.backends_are_initialized()
"""


def test_importing_every_module_changes_nothing():
    done = subprocess.run([sys.executable, "-c", IMPORT_ALL], env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def modules_in_strings():
    """Pairs of a module and one that it names in a string: an entry point, or a module to start in a process."""
    for path in (*CLONE.glob("mjx_walk/**/*.py"), *CLONE.glob("envs/**/*.py")):
        source = ".".join(path.relative_to(CLONE).with_suffix("").parts).removeprefix("mjx_walk.")
        for names in re.findall(r'"mjx_walk\.([\w.]+)(?::\w+)?"|start_module\("([\w.]+)"', path.read_text()):
            yield source, "".join(names)


def layer(name):
    return next(i for i, names in enumerate(LAYERS) if name.partition(".")[0] in names.split(" | "))


def test_modules_named_in_strings_exist_in_the_same_room_or_below():
    found = {(source, name) for source, name in modules_in_strings() if name != "progress"}  # a logger
    assert {("interop.registration", "interop.gymnasium_env"), ("viewing.film", "viewing.film")} <= found
    for source, name in found:
        assert importlib.util.find_spec(f"mjx_walk.{name}"), f"{source} names {name}"
        starts_training = name == "train"  # in a process of its own
        assert source == "__init__" or starts_training or layer(source) <= layer(name), f"{source} names {name}"
