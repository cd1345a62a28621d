"""Several seeds side by side in one program are the runs that they would be one by one."""

import json
import shutil

import numpy as np
import pytest
from helpers import TINY, TINY_CALL, TINY_OFF_POLICY, command_here, leaves, train, train_here

from mjx_walk import train as train_command
from mjx_walk.settings.config import load_config
from mjx_walk.settings.saved_config import save_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.training import restoring
from mjx_walk.training.distributed import Processes
from mjx_walk.training.restoring import have_saved, restore_together
from mjx_walk.utils.errors import UnreadableError, UserError

SEEDS = "seeds=[3,5]"


def assert_alike(run, other, exactly):
    assert run.keys() == other.keys() and len(run) > 50
    for name, leaf in run.items():
        if exactly or not np.issubdtype(np.asarray(leaf).dtype, np.floating):
            np.testing.assert_array_equal(leaf, other[name], err_msg=name)
        else:
            np.testing.assert_allclose(leaf, other[name], rtol=1e-2, atol=1e-2, err_msg=name)


def moved(run_dir):
    """Change of the policy's parameters in the second call, as one vector."""
    before, after = leaves(run_dir, 1), leaves(run_dir, 2)
    names = [name for name in after if ".policy.params." in name and "optimizer" not in name]
    assert len(names) >= 4
    return np.concatenate([np.ravel(after[name] - before[name]) for name in names])


@pytest.mark.parametrize(
    ("algo", "tiny"), [("ppo", TINY), pytest.param("sac", TINY_OFF_POLICY, marks=pytest.mark.slow)]
)
def test_seeds_side_by_side_are_the_runs_of_each(tmp_path, algo, tiny):
    settings = [f"algo={algo}", f"total_steps={2 * TINY_CALL}", "checkpoint.every_calls=1"]
    tiny = [setting for setting in tiny if "every_calls" not in setting]
    train_here(tmp_path / "both", *settings, SEEDS, tiny=tiny)
    train_here(tmp_path / "alone", *settings, "seed=5", tiny=tiny)
    assert_alike(leaves(tmp_path / "both" / "seed_5", 2), leaves(tmp_path / "alone", 2), exactly=False)
    one, other, alone = (moved(tmp_path / name) for name in ("both/seed_5", "both/seed_3", "alone"))
    assert np.linalg.norm(one - alone) < 0.3 * np.linalg.norm(alone) < np.linalg.norm(other - alone)
    rows = [
        [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        for run in (tmp_path / "both" / "seed_5", tmp_path / "alone")
    ]
    for together, apart in zip(*rows, strict=True):
        assert together.keys() == apart.keys() and together["env_steps"] == apart["env_steps"]
        assert together["episode/count"] == apart["episode/count"]
        assert (together["speed/seeds_together"], apart["speed/seeds_together"]) == (2, 1)


@pytest.mark.slow
def test_seeds_side_by_side_resume_exactly_and_each_may_go_on_alone(tmp_path, capsys):
    train_here(tmp_path / "full", f"total_steps={4 * TINY_CALL}", SEEDS)
    train_here(tmp_path / "halves", f"total_steps={2 * TINY_CALL}", f"algo.schedule_steps={4 * TINY_CALL}", SEEDS)
    shutil.copytree(tmp_path / "halves", tmp_path / "one")
    further = (f"total_steps={4 * TINY_CALL}", "resume=true")
    train(tmp_path / "halves", *further, SEEDS, tiny=[])
    for seed in (3, 5):
        full, halves = (leaves(tmp_path / name / f"seed_{seed}", 4) for name in ("full", "halves"))
        assert_alike(full, halves, exactly=True)
    train_here(tmp_path / "one" / "seed_5", *further, tiny=[])
    assert_alike(leaves(tmp_path / "full" / "seed_5", 4), leaves(tmp_path / "one" / "seed_5", 4), exactly=False)
    before = (tmp_path / "one" / "seed_3" / "config.yaml").read_text()
    for more, says in (
        ((), "differ in total_steps (was 128, now 256); resume each alone"),
        ((f"total_steps={6 * TINY_CALL}",), "error: the seeds are at different steps (128, 256); resume"),
    ):
        assert command_here("train", f"run_dir={tmp_path / 'one'}", "resume=true", SEEDS, *more) == 2
        assert says in capsys.readouterr().err
    assert (tmp_path / "one" / "seed_3" / "config.yaml").read_text() == before


class Saved:
    """A run with checkpoints at some steps, in place of their folder."""

    def __init__(self, steps, seeds_together):
        self.steps, self.metadata = steps, {"seeds_together": seeds_together}

    def restore(self, like, processes, at_most=10**9):
        return like, self.metadata | {"env_steps": max((step for step in self.steps if step <= at_most), default=0)}


def restored_steps(*runs):
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(restoring, "restore_newest", Saved.restore)
        return [metadata["env_steps"] for _, metadata in restore_together(runs, None, Processes())]


def test_seeds_that_a_kill_has_parted_go_back_to_the_step_of_all():
    with pytest.warns(UserWarning, match="not all seeds were saved at step 128; all resume from step 64"):
        assert restored_steps(Saved([64, 128], 2), Saved([64], 2)) == [64, 64]
    for ahead in (Saved([64, 128], 1), Saved([128], 2)):  # it went on alone; it has not kept that step
        with pytest.raises(UserError, match=r"the seeds are at different steps \(64, 128\); resume each alone"):
            restored_steps(ahead, Saved([64], 2))


@pytest.mark.parametrize(("steps", "metadata", "is_refused"), [([64], 2, False), ([64], 1, True), ([64, 128], 2, True)])
def test_seeds_that_a_kill_has_parted_at_their_first_save_begin_again(tmp_path, steps, metadata, is_refused):
    folders = [RunFolder(tmp_path / f"seed_{seed}") for seed in (0, 1)]
    for step in steps:
        path = checkpoint.step_path(folders[1].checkpoints, step)
        path.parent.mkdir(parents=True, exist_ok=True)
        checkpoint.save(path, {"a": 1.0}, {"env_steps": step, "seeds_together": metadata}, as_numpy=True)
    if not is_refused:
        assert not have_saved(folders)
        return
    with pytest.raises(UserError, match=rf"the seeds are at different steps \(0, {steps[-1]}\); resume each alone"):
        have_saved(folders)


def test_seeds_of_which_one_cannot_be_read_now_neither_begin_again_nor_part(tmp_path, monkeypatch):
    def fail(path):
        raise UnreadableError(f"cannot read {path}")

    (tmp_path / "1" / "checkpoints" / f"{10:013d}").mkdir(parents=True)
    monkeypatch.setattr(checkpoint, "read_meta", fail)
    with pytest.raises(UnreadableError, match="cannot read"):
        have_saved([RunFolder(tmp_path / name) for name in ("1", "2")])


def test_nothing_is_begun_where_one_seed_cannot_be(tmp_path, monkeypatch):
    """A folder that is there already; runs of other settings."""
    monkeypatch.chdir(tmp_path)
    save(tmp_path / "x" / "seed_5", "seed=5", "run_dir=x/seed_5")
    with pytest.raises(UserError, match=r"run_dir=x/seed_5 holds a run already; add resume=true"):
        train_command.main([*TINY, SEEDS, "run_dir=x"])
    assert not (tmp_path / "x" / "seed_3").exists()
    save(tmp_path / "x" / "seed_3", "seed=3", "run_dir=x/seed_3", "algo.discount=0.5")
    with pytest.raises(UserError, match=r"differ in algo.discount \(was 0.5, now 0.99\); resume each alone"):
        train_command.main(["resume=true", "run_dir=x", SEEDS])


def save(run_dir, *overrides):
    """A run folder with nothing but its configuration."""
    run_dir.mkdir(parents=True)
    save_config(load_config([*TINY, "physics=c", *overrides]), run_dir / "config.yaml")
