"""A program that uses Hydra itself, and this package."""

import copy
import dataclasses
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import hydra
import pytest
from helpers import ENVIRONMENT
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton
from omegaconf import OmegaConf
from omegaconf.basecontainer import BaseContainer

from mjx_walk.settings.config import load_config
from mjx_walk.settings.own_hydra import own_hydra

PROGRAM = """
import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from mjx_walk.settings.config import load_config

ConfigStore.instance().store(name="main", node={"speed": 1, "defaults": [{"env": "ant"}]})
ConfigStore.instance().store(group="env", name="ant", node={"legs": 4})

@hydra.main(config_name="main", version_base="1.3")
def main(cfg):
    before = GlobalHydra.instance().hydra
    for seed in (1, 2):
        assert load_config(["env=ant", "hardware=cpu", f"seed={seed}"]).seed == seed
    assert GlobalHydra.instance().hydra is before and HydraConfig.get().job.num == cfg.speed - 3
    print(cfg.env.legs, hydra.compose("main", ["speed=5"]).speed)

main()
"""


@dataclasses.dataclass
class Theirs:
    legs: int = 4


def test_the_state_of_hydra_is_the_one_from_before(tmp_path):
    load_config(["hardware=cpu"])  # Hydra finds its plugins once
    store = ConfigStore.instance()
    former = copy.copy(store.repo)
    (tmp_path / "theirs.yaml").write_text("speed: 1\n")
    try:
        for group, name in (("env", "humanoid"), ("algo", "ppo"), ("recipe", "cpu/humanoid_ppo"), (None, "schema")):
            store.store(group=group, name=name, node=Theirs)
        OmegaConf.register_new_resolver("now", lambda text: "theirs", replace=True)
        with hydra.initialize_config_dir(str(tmp_path), version_base="1.2"):
            repo, resolvers = copy.deepcopy(store.repo), dict(BaseContainer._resolvers)
            instances = dict(Singleton._instances)
            initialized = GlobalHydra.instance().hydra
            for _ in range(2):
                assert load_config(["env=walker2d", "algo=sac", "hardware=cpu"]).env.name == "walker2d"
            assert store.repo == repo and BaseContainer._resolvers == resolvers
            assert Singleton._instances == instances and ConfigStore.instance() is store
            assert GlobalHydra.instance().hydra is initialized and hydra.compose("theirs", ["speed=2"]).speed == 2
    finally:
        store.repo.clear()
        store.repo.update(former)
        OmegaConf.clear_resolver("now")


def test_other_threads_keep_their_own_state(tmp_path):
    """While one thread loads a configuration, another composes its own and registers a resolver."""
    (tmp_path / "theirs.yaml").write_text("speed: 1\ndouble: ${twice:${speed}}\n")

    def work():
        OmegaConf.register_new_resolver("twice", lambda number: 2 * number)
        config = hydra.compose("theirs", ["speed=4"])
        return config.double, len(Singleton.get_state()["omegaconf_resolvers"])

    with hydra.initialize_config_dir(str(tmp_path), version_base="1.3"), ThreadPoolExecutor(1) as pool:
        with own_hydra():
            num_resolvers = len(BaseContainer._resolvers)
            assert pool.submit(work).result() == (8, num_resolvers + 1)
            assert not OmegaConf.has_resolver("twice") and not GlobalHydra.instance().is_initialized()
        assert OmegaConf.has_resolver("twice") and hydra.compose("theirs").double == 2
        with own_hydra():
            pool.submit(OmegaConf.clear_resolvers).result()
        assert not OmegaConf.has_resolver("twice")


@pytest.mark.slow  # a process of its own
def test_a_program_of_hydras_calls_this_package(tmp_path):
    """Also in a sweep, in which Hydra goes on after each job."""
    (tmp_path / "theirs.py").write_text(PROGRAM)
    command = [sys.executable, "theirs.py", "-m", "speed=3,4"]
    ran = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert ran.stdout.splitlines()[-1] == "4 5" and ran.stdout.count("4 5") == 2, ran.stderr
