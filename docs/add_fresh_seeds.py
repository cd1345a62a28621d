"""`python docs/add_fresh_seeds.py FOLDER …`: add runs to measured/fresh_seeds.tar.xz, from which tables are generated.

A run replaces one of the same task, algorithm and seed. Afterwards, `python docs/generate.py` writes the tables.
"""

import argparse
import io
import re
import tarfile
from pathlib import Path

from generator.fresh_seeds import ARCHIVE

from mjx_walk.experiments.logged_runs import LoggedRun, read_runs
from mjx_walk.settings.saved_config import read_saved_config
from mjx_walk.storage.run_folder import open_existing
from mjx_walk.storage.scores import BEST, FINAL
from mjx_walk.utils.errors import UserError

NUM_EPISODES = 100
FIRST_SEED = 100
"""Recipes are tuned on lower seeds."""
FILES = ("config.yaml", "eval_gymnasium.json", "inputs.json", "metrics.jsonl")


def main() -> None:
    parser = argparse.ArgumentParser("python docs/add_fresh_seeds.py", description="Add finished runs to the archive.")
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="with the runs of one or several seeds")
    try:
        add(parser.parse_args().folders, ARCHIVE)
    except UserError as error:
        parser.error(str(error))


def add(folders: list[Path], path: Path) -> None:
    """Add all runs below some folders to an archive.

    Raises:
        UserError: a run has not ended, or lacks scores of 100 episodes of the final and the best policy.
    """
    files: dict[str, bytes] = {}
    if path.exists():
        with tarfile.open(path) as archive:
            files = {member.name: archive.extractfile(member).read() for member in archive if member.isfile()}
    for folder in folders:
        for run in read_runs(folder):
            _check(run)
        for config in sorted(folder.rglob("config.yaml")):
            files |= _files(config.parent)
    with tarfile.open(path, "w:xz") as archive:
        for name in sorted(files):
            entry = tarfile.TarInfo(name)
            entry.size = len(files[name])
            archive.addfile(entry, io.BytesIO(files[name]))


def _check(run: LoggedRun) -> None:
    name = f"{run.config.env.name} {run.config.algo.name} seed={run.config.seed}"
    if run.config.seed < FIRST_SEED:
        raise UserError(f"{name}: recipes are tuned on seeds below {FIRST_SEED}; train another seed")
    if run.rows[-1]["env_steps"] < run.config.total_steps:
        raise UserError(f"{name} has not ended; continue it with resume=true")
    for policy in (FINAL, BEST):
        if len(run.score(policy).get("returns", ())) != NUM_EPISODES:
            raise UserError(f"{name} has no score of {NUM_EPISODES} episodes; run mjx_walk.eval with policy={policy}")


def _files(folder: Path) -> dict[str, bytes]:
    """The files of a run by their names in the archive. The configuration names no folder."""
    config = read_saved_config(open_existing(folder))
    contents = {name: (folder / name).read_bytes() for name in FILES}
    contents["config.yaml"] = re.sub(rb"(?m)^run_dir: .*$", b"run_dir: null", contents["config.yaml"])
    return {f"{config.env.name}_{config.algo.name}/seed_{config.seed}/{name}": contents[name] for name in FILES}


if __name__ == "__main__":
    main()
