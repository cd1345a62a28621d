"""The package works editable, from a wheel or sdist, next to a clone, and from a clone."""

import ast
import importlib.metadata
import itertools
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

CLONE = Path(__file__).parent.parent

USE = """
import mjx_walk, sys
assert "jax" not in sys.modules, "import mjx_walk should be light"
from mjx_walk.settings.config import load_config
from mjx_walk.envs import TASKS
assert load_config(["env=walker2d"]).num_envs == 64
env = mjx_walk.make_env("walker2d", physics="c")
assert type(env) is TASKS["walker2d"][0] and env.observation_size == 17
print(mjx_walk.__file__)
"""


def python_use(cwd, paths=(), executable=sys.executable):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths)), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [executable, "-c", USE], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.split()[-1])


@pytest.mark.parametrize("python", ["3.11", "3.12"])
def test_constraints_allow_what_the_package_needs(python):
    """Names and versions alone, one for each package, with every requirement among them."""
    lines = [line for line in (CLONE / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    pinned = [Requirement(line) for line in lines]
    pinned = [pin for pin in pinned if pin.marker is None or pin.marker.evaluate({"python_version": python})]
    versions = {pin.name: str(pin.specifier).removeprefix("==") for pin in pinned}
    assert len(versions) == len(pinned) and all(re.fullmatch(r"[\d.]+", version) for version in versions.values())
    project = tomllib.loads((CLONE / "pyproject.toml").read_text())["project"]
    for requirement in map(Requirement, (*project["dependencies"], *project["optional-dependencies"]["warp"])):
        assert requirement.specifier.contains(versions[requirement.name.lower()]), requirement


def test_every_import_is_declared():
    """What the package imports from elsewhere is a dependency, or belongs to an extra for users."""
    project = tomllib.loads((CLONE / "pyproject.toml").read_text())["project"]
    extras = {name: needed for name, needed in project["optional-dependencies"].items() if name not in ("dev", "docs")}
    requirements = [Requirement(line) for line in (*project["dependencies"], *itertools.chain(*extras.values()))]
    declared = {_as_name(requirement.name) for requirement in requirements}
    distributions = importlib.metadata.packages_distributions()
    modules = {name.partition(".")[0] for name in _imports() if name}
    elsewhere = modules - {*sys.stdlib_module_names, "mjx_walk"}
    assert {"jax", "tensorstore", "warp"} < elsewhere
    # A package that only campaigns install need not be there.
    absent = {name: [_as_name(name)] for name in elsewhere} | {"rsl_rl": ["rsl-rl-lib"]}
    undeclared = {name for name in elsewhere if not declared & {*map(_as_name, distributions.get(name, absent[name]))}}
    assert not undeclared


def _imports():
    """Names of all modules that the package imports."""
    for path in (*CLONE.glob("mjx_walk/**/*.py"), *CLONE.glob("envs/**/*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and not node.level:
                yield node.module


def _as_name(distribution):
    return re.sub(r"[-_.]+", "-", distribution).lower()


@pytest.fixture(scope="module")
def clone(tmp_path_factory):
    """A plain clone: what git tracks, nothing else."""
    path = tmp_path_factory.mktemp("clone") / "mjx_walk_clone"
    files = subprocess.run(["git", "ls-files", "-z"], cwd=CLONE, capture_output=True, text=True, check=True).stdout
    for name in filter(None, files.split("\0")):
        target = path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(CLONE / name, target, follow_symlinks=False)
    return path


@pytest.fixture(scope="module")
def built(clone, tmp_path_factory):
    """Wheel and sdist, and the wheel built from the sdist."""
    out = tmp_path_factory.mktemp("dist")
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(clone)],
        check=True,
        capture_output=True,
    )
    return next(out.glob("*.whl")), next(out.glob("*.tar.gz"))


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """The unpacked wheel."""
    target = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(built[0]) as wheel:
        wheel.extractall(target)
    return target


def test_wheel_and_sdist_hold_the_package_and_nothing_else(built):
    names = zipfile.ZipFile(built[0]).namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"mjx_walk"}
    needed = {
        "mjx_walk/envs/humanoid.py",
        "mjx_walk/configs/train.yaml",
        "mjx_walk/configs/recipe/gpu/swimmer_ppo.yaml",
    }
    assert needed <= set(names)
    assert not [name for name in names if name.endswith(".xml")]  # Gymnasium's models stay Gymnasium's
    with tarfile.open(built[1]) as sdist:
        inside = {name.partition("/")[2] for name in sdist.getnames()}
    assert {"mjx_walk/envs/humanoid.py", "mjx_walk/configs/train.yaml", "LICENSE", "README.md"} <= inside


def test_wheel_from_elsewhere(installed, tmp_path):
    assert python_use(tmp_path, [installed]).is_relative_to(installed)


@pytest.mark.slow
def test_wheel_with_the_clone_as_current_folder(installed, clone):
    assert python_use(clone, [installed]).is_relative_to(clone)  # Python takes the current folder first


def test_plain_clone(clone):
    assert python_use(clone).is_relative_to(clone)


@pytest.mark.slow
def test_editable(clone, tmp_path):
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    site = next((tmp_path / "venv" / "lib").glob("python*")) / "site-packages"
    for path in [*site.glob("setuptools*"), *site.glob("pkg_resources")]:  # Python 3.11 brings one that is too old
        shutil.rmtree(path)
    (site / "dependencies.pth").write_text("\n".join(path for path in sys.path if "site-packages" in path))
    subprocess.run(
        [python, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index", "-e", str(clone)],
        check=True,
        capture_output=True,
    )
    assert python_use(tmp_path, executable=python).is_relative_to(clone)
    listed = subprocess.run([python.with_name("mjx-walk")], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert listed.stdout.startswith("usage: mjx-walk COMMAND")


def printed(code, *paths):
    """The output of a fresh interpreter whose path is the clone and then `paths`."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (CLONE, *paths)))}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("use", ["import mjx_walk.algos", "mjx_walk.make_env('walker2d', physics='jax')"])
def test_without_warp_mjx_prints_nothing(use):
    code = f"import sys; sys.modules['warp'] = None; import mjx_walk; {use}; print(sys.modules['mujoco.mjx'].__name__)"
    assert printed(code) == "mujoco.mjx\n"


def test_the_c_engine_does_not_import_mjx():
    code = "import mjx_walk, sys; mjx_walk.make_env('walker2d', physics='c'); print('mujoco.mjx' in sys.modules)"
    assert printed(code) == "False\n"


@pytest.mark.slow
def test_mjx_is_imported_without_searches_for_garbage():
    code = """if True:
        import gc, mjx_walk
        searches = []
        gc.callbacks.append(lambda phase, _: searches.append(phase))
        from mjx_walk.machine import quiet_mjx
        print(gc.isenabled(), len(searches) <= 2)  # one, once they are allowed again
    """
    assert printed(code) == "True True\n"


def test_tensorboard_does_not_import_pytorch(tmp_path):
    (tmp_path / "torch.py").write_text("print('PyTorch')\nclass Tensor: ...")
    code = "import mjx_walk.logs.tensorboard; print('TensorBoard'); import torch"
    assert printed(code, tmp_path) == "TensorBoard\nPyTorch\n"
