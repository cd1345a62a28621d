"""The folder of a study: which trials a process takes, what it writes, and what a full disk or a kill leaves."""

import threading
import time

import pytest
import yaml

from mjx_walk.envs.model_files import ASSETS
from mjx_walk.experiments.search_space import read_space
from mjx_walk.experiments.study import StudyFolder, facts_of
from mjx_walk.experiments.tuning_report import summary, write_tables

pytestmark = pytest.mark.slow  # Optuna is installed for campaigns only


def ended(study, taken, value):
    """A taken trial ends as complete."""
    study.tell(taken.trial, value)
    taken.release.close()


def new_study(path, *overrides):
    space = read_space(["env=walker2d", "algo=ppo", *overrides], "cpu")
    return space, StudyFolder(path), StudyFolder(path).create_or_open(facts_of(space, [0]))


def test_a_trial_that_ends_while_another_process_looks_is_not_taken_again(tmp_path, monkeypatch, optuna):
    """The other process ends it between the first look and the lock."""
    space, folder, study = new_study(tmp_path, "algo.discount=0.9,0.99")
    first = folder.take_trial(study, space, 1, "tpe", "none", 0)
    lock = StudyFolder._lock_trial

    def end_first(self, number):
        if first.trial.number == number and not study.trials[0].state.is_finished():
            ended(study, first, 1.0)
        return lock(self, number)

    monkeypatch.setattr(StudyFolder, "_lock_trial", end_first)
    other = folder.create_or_open(facts_of(space, [0]))
    assert folder.take_trial(other, space, 1, "tpe", "none", 0) is None
    assert other.trials[0].state.name == "COMPLETE"


def test_a_line_that_a_full_disk_cut_off_is_removed(tmp_path, optuna):
    space, folder, study = new_study(tmp_path, "algo.discount=0.9,0.99")
    ended(study, folder.take_trial(study, space, 3, "tpe", "none", 0), 1.0)
    ended(study, folder.take_trial(study, space, 3, "tpe", "none", 0), 2.0)
    folder.storage.write_bytes(folder.storage.read_bytes()[:-7])
    study = folder.create_or_open(facts_of(space, [0]))
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "RUNNING"]
    ended(study, folder.take_trial(study, space, 2, "tpe", "none", 0), 3.0)
    assert [trial.value for trial in folder.open().trials] == [1.0, 3.0]


def test_a_wait_for_the_lock_of_a_killed_process_is_logged(tmp_path, monkeypatch, caplog, optuna):
    """Once, with the file to delete."""
    monkeypatch.setattr("mjx_walk.experiments.study._SILENT_SECONDS", 0.1)
    space, folder, _ = new_study(tmp_path, "algo.discount=0.9,0.99")
    stale = tmp_path / "study.log.lock"
    stale.touch()

    def notices():
        return [record.getMessage() for record in caplog.records if record.name.startswith("mjx_walk")]

    def delete_the_file_when_told():
        while not notices():
            time.sleep(0.01)
        stale.unlink()

    threading.Thread(target=delete_the_file_when_told, daemon=True).start()
    folder.create_or_open(facts_of(space, [0]))
    (line,) = notices()
    assert line.startswith(f"waiting up to 30 s for the process that holds {stale}; ") and "delete that file" in line


def test_a_trial_that_was_killed_between_two_values_gets_all(tmp_path, optuna):
    space, folder, study = new_study(tmp_path, "algo.discount=0.9,0.99", "algo.num_epochs=interval(2,9)")
    ended(study, folder.take_trial(study, space, 2, "tpe", "none", 0), 1.0)
    study.ask({"algo.discount": optuna.distributions.CategoricalDistribution((0.9, 0.99))})
    taken = folder.take_trial(study, space, 2, "tpe", "none", 0)
    assert taken.trial.number == 1 and taken.trial.params.keys() == {"algo.discount", "algo.num_epochs"}


def test_recipes_are_distinct_and_keep_texts(tmp_path, optuna):
    model = tmp_path / "my #1 robots" / "w.xml"
    model.parent.mkdir()
    model.write_text((ASSETS / "walker2d.xml").read_text())
    texts = (f"env.xml_file={model}", "wandb_project='on'")
    space, folder, study = new_study(tmp_path / "out", *texts, "algo.discount=0.9,0.99")
    while taken := folder.take_trial(study, space, 6, "random", "none", 0):
        ended(study, taken, taken.trial.params.get("algo.discount", 0.0))
    write_tables(folder, study)
    found = [yaml.safe_load(path.read_text()) for path in sorted((tmp_path / "out").glob("best*.yaml"))]
    assert sorted(recipe["algo"]["discount"] for recipe in found) == [0.9, 0.99]
    assert all(r["env"]["xml_file"] == str(model) and r["wandb_project"] == "on" for r in found)


def test_a_recipe_that_nothing_beats_is_kept(tmp_path, optuna):
    space, folder, study = new_study(tmp_path, "algo.discount=0.9,0.99")
    while taken := folder.take_trial(study, space, 3, "random", "none", 0):
        ended(study, taken, -float(taken.trial.number))
    text = summary(folder, study)
    assert "No trial beats it: keep it." in text and "mjx_walk.compare" not in text
