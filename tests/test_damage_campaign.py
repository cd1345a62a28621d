"""A run folder with one damaged file resumes and acts as before, or says what is wrong; nothing differs in silence."""

import shutil
import warnings

import jax
import numpy as np
import pytest
from faults import Tally
from helpers import TINY, TINY_OFF_POLICY, train_here

from mjx_walk import api
from mjx_walk.algos import make_algorithm
from mjx_walk.evaluation import saved_policies
from mjx_walk.logs.metrics import read_rows
from mjx_walk.settings.saved_config import MAY_DIFFER, differences
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import read_scores
from mjx_walk.training.checks import prepared
from mjx_walk.training.distributed import Processes
from mjx_walk.training.recorder import Recorder
from mjx_walk.training.restoring import restore_newest
from mjx_walk.utils.errors import UserError

RUNS = {"ppo": (*TINY, "env.max_episode_steps=8"), "sac": (*TINY_OFF_POLICY, "algo=sac")}


class Examiner:
    """What an intact run folder gives, for comparison."""

    def __init__(self, run_dir):
        self.source = run_dir
        self.config = self.resolve(run_dir)
        self.task = saved_policies.make_task(self.config)
        config = self.config
        self.algorithm = make_algorithm(self.task, config.num_envs, config.evaluation, config.algo)
        self.like = jax.eval_shape(self.algorithm.init, jax.random.PRNGKey(0))
        self.states = {}
        for path in checkpoint.list_steps(run_dir / "checkpoints"):
            self.states[int(path.name)] = jax.device_get(checkpoint.restore(path, self.like)[0])
        self.rows = read_rows(run_dir / "metrics.jsonl")
        folder = RunFolder(run_dir)
        names = saved_policies.kept_policies(folder)
        self.policies = {name: saved_policies._load(folder, name, self.algorithm) for name in names}
        self.scores = read_scores(run_dir / "eval_gymnasium.json")

    def resolve(self, run_dir):
        return api.resolve([f"run_dir={run_dir}", "resume=true"])

    def differences(self, run_dir):
        """What a damaged folder gives that differs, as a resume, a player and a reader of scores see it."""
        found = []
        config = self.resolve(run_dir)
        found += differences(self.config, config, [key for key in MAY_DIFFER if key != "total_steps"])
        with prepared([config]) as (folders, _):
            recorder = Recorder(config, self.algorithm, folders[0], Processes())
            state, metadata = restore_newest(folders[0].checkpoints, self.like, Processes())
            recorder.begin(metadata["env_steps"], will_train=False, restored=metadata)
            recorder.close()
        found += [] if metadata["env_steps"] == max(self.states) else ["an older checkpoint"]
        found += [] if _same(state, self.states[metadata["env_steps"]]) else ["another state"]
        found += [] if read_rows(run_dir / "metrics.jsonl") == self.rows else ["other rows"]
        for name, (params, policy_metadata) in self.policies.items():
            other = saved_policies._load(folders[0], saved_policies.choose_policy(folders[0], name), self.algorithm)
            found += [] if _same(other[0], params) and other[1] == policy_metadata else [f"another {name} policy"]
        return found

    def scores_differ_in_silence(self, run_dir):
        try:
            return read_scores(run_dir / "eval_gymnasium.json") != self.scores
        except (OSError, ValueError):
            return False


def _same(one, other):
    leaves = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in leaves)


@pytest.fixture(scope="module", params=RUNS)
def examiner(request, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("runs") / request.param
    settings = (
        "total_steps=384",
        "checkpoint.every_calls=1",
        "iterations_per_call=1",
        "evaluation.gymnasium_episodes=1",
    )
    train_here(run_dir, *settings, tiny=RUNS[request.param])
    return Examiner(run_dir)


def damage(path, rng):
    """Damage a file in a random way. Returns what was done."""
    data = bytearray(path.read_bytes())
    size = len(data)
    kind = rng.choice(["flip", "digit", "cut", "zeros", "noise", "empty", "removed", "more", "other"])
    at = rng.randrange(size) if size else 0
    digits = [i for i, byte in enumerate(data) if 48 <= byte < 58]
    if kind == "digit" and digits:
        i = rng.choice(digits)
        data[i] = 48 + (data[i] - 47) % 10
    elif kind == "removed":
        path.unlink()
        return kind
    elif kind == "cut":
        del data[at:]
    elif kind == "zeros":
        data[at : at + 512] = bytes(len(data[at : at + 512]))
    elif kind == "noise":
        data[at : at + 64] = rng.randbytes(len(data[at : at + 64]))
    elif kind == "empty":
        data.clear()
    elif kind == "more":
        data += rng.randbytes(100)
    elif kind == "other":
        data = bytearray(rng.choice([b"null", b"[]", b"{}", b"\xff\xfe", b"\x80\x04]q\x00."]))
    elif size:
        kind = "flip"
        data[at] ^= 1 << rng.randrange(8)
    path.write_bytes(data)
    return kind


def damage_again_and_again(examiner, folder, rng, count):
    tally, run_dir = Tally(f"damages, {examiner.source.name}"), folder / "run"
    for _ in range(count):
        shutil.rmtree(run_dir, ignore_errors=True)
        shutil.copytree(examiner.source, run_dir)
        path = rng.choice(sorted(path for path in run_dir.rglob("*") if path.is_file()))
        what = f"{path.relative_to(run_dir)}: {damage(path, rng)}"
        tally.tried += 1
        try:
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                found = examiner.differences(run_dir)
            if (found and not said) or examiner.scores_differ_in_silence(run_dir):
                tally.bad["silent differences"].append(f"{what}: {found}")
        except UserError as error:
            tally.bad["lost"].append(f"{what}: {error}")
        except Exception as error:
            tally.bad["tracebacks"].append(f"{what}: {error!r}")
    tally.report()


@pytest.mark.campaign
def test_damages(examiner, tmp_path, rng, num_faults):
    damage_again_and_again(examiner, tmp_path, rng, max(1, num_faults // len(RUNS)))


@pytest.mark.slow
def test_twenty_damages(examiner, tmp_path, rng):
    damage_again_and_again(examiner, tmp_path, rng, 10)
