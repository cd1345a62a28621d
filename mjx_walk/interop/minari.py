"""Datasets of a policy's episodes for Minari, Gymnasium's library of offline datasets."""

import contextlib
import copy
import dataclasses
import errno
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

import gymnasium
import minari
import numpy as np
from gymnasium.envs.registration import EnvSpec
from minari import EpisodeMetadataCallback
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from minari.namespace import NAMESPACE_METADATA_FILENAME

from mjx_walk import zoo
from mjx_walk.envs import Task, require_model
from mjx_walk.envs.model_files import is_asset
from mjx_walk.evaluation.recorded_episodes import RecordedEpisode, record_episodes
from mjx_walk.evaluation.saved_policies import SavedPolicy, deterministic_policy
from mjx_walk.evaluation.simulated_episodes import simulate_episodes
from mjx_walk.machine.signals import as_by_ctrl_c
from mjx_walk.storage.files import write_text
from mjx_walk.storage.folders import replacing_folder
from mjx_walk.storage.scores import Scores
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.versions import git_commit, package_versions
from mjx_walk.viewing.episode import make_gymnasium

__all__ = ["check_absent", "check_task", "dataset_id", "write_dataset"]

_NAMESPACE = "mjx_walk"
_RESERVE = 16 * 2**20
"""Bytes of the disk that stay free. HDF5 crashes on a full disk, instead of raising an error."""
_REQUIREMENTS = ("mujoco", "gymnasium")
"""Packages whose versions the episodes depend on. Minari warns if another version is installed."""


def dataset_id(saved: SavedPolicy, backend: str, quality: str | None = None) -> str:
    """Minari's id of a policy's dataset, such as `mjx_walk/walker2d/csac-v0` from the zoo.

    A run gives `mjx_walk/walker2d/csac-best-v0` or `…/csac-final-v0`. With the backend `sim`, it is `…/csac-sim-v0`.

    Args:
        saved: the policy.
        backend: as for `write_dataset`.
        quality: a name for the policy, such as `expert`, which gives `…/csac-expert-v0`.
    """
    task, is_shipped = saved.config.env.name, zoo.holds(saved.path)
    name = saved.path.name.removeprefix(f"{task}-") if is_shipped else saved.config.algo.name
    named = quality or ("" if is_shipped else saved.policy_name)
    parts = (name, named, "sim" if backend == "sim" else "", "v0")
    return f"{_NAMESPACE}/{task}/{'-'.join(filter(None, parts))}"


def check_absent(path: Path) -> None:
    """Check that there is no such dataset yet, which is never overwritten.

    Raises:
        UserError: the dataset exists.
    """
    if path.exists():
        raise UserError(f"{path} exists already; choose another out=, or remove it")


def check_task(task: Task) -> None:
    """Check that Gymnasium makes the same environment anywhere, so that it can repeat the episodes.

    Raises:
        UserError: Gymnasium does not have the task, or only with another floor or model.
    """
    missing = _missing_in_gymnasium(task)
    if missing:
        raise UserError(f"format=minari plays in Gymnasium, {missing}; add backend=sim")


def _missing_in_gymnasium(task: Task) -> str:
    """What Gymnasium lacks of a task; empty if it has everything."""
    xml_file = task.options.xml_file
    if not task.is_in_gymnasium:
        return f"which has no {task.gymnasium_id}"
    if task.ground.is_on:
        return "whose floor has no hills"
    return f"without your model {xml_file}" if xml_file and not is_asset(xml_file) else ""


def write_dataset(
    root: Path, saved: SavedPolicy, num_episodes: int, seed: int, backend: str, quality: str | None = None
) -> Scores:
    """Play a policy, and write its episodes as a dataset of Minari.

    The dataset appears below `root` when it is complete. The policy acts without noise.

    Args:
        root: folder of datasets, as in `MINARI_DATASETS_PATH`.
        saved: the policy. For the backend `gymnasium`, `check_task` allows its task.
        num_episodes: N.
        seed: in Gymnasium, episode i is reset with `seed + i`. In the engine, all starts are drawn from it.
        backend: `gymnasium`, the real environment, or `sim`, the task's own engine.
        quality: as for `dataset_id`.

    Returns:
        The returns and lengths of the episodes.

    Raises:
        UserError: the dataset exists already.
        OSError: the disk is full, or cannot be written.
    """
    dataset = dataset_id(saved, backend, quality)
    path = root.absolute() / dataset  # Minari measures the size of absolute paths only
    check_absent(path)
    namespaces = (path.parent, path.parent.parent)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with as_by_ctrl_c(), replacing_folder(path) as folder:
            scores = _write(folder / "data", dataset, saved, num_episodes, seed, backend)
        for namespace in namespaces:
            if not (namespace / NAMESPACE_METADATA_FILENAME).exists():
                write_text(namespace / NAMESPACE_METADATA_FILENAME, "{}")
    finally:
        for namespace in namespaces:
            with contextlib.suppress(OSError):
                namespace.rmdir()  # if it is empty
    return scores


def _write(folder: Path, dataset: str, saved: SavedPolicy, num_episodes: int, seed: int, backend: str) -> Scores:
    """Write the files of a dataset."""
    task = require_model(saved.task)
    storage = _new_storage(folder, task)
    if backend == "sim":
        seeds, name = [seed], f"{task.gymnasium_id} on {task.engine.name}"
        recording = simulate_episodes(
            task, deterministic_policy(saved.algorithm, saved.policy_params), num_episodes, seed
        )
    else:
        seeds, name = [seed + i for i in range(num_episodes)], task.gymnasium_id
        recording = record_episodes(task, saved.act, seeds)
    rewards: list[np.ndarray] = []
    with contextlib.closing(recording) as episodes:
        storage.update_episodes(_buffers(episodes, rewards, folder))
    storage.update_episode_metadata(map(EpisodeMetadataCallback(), ({"rewards": own} for own in rewards)))
    returns, lengths = np.array([own.sum() for own in rewards]), np.array([len(own) for own in rewards])
    scores = Scores(returns, lengths, seeds, name)
    storage.update_metadata(_metadata(dataset, saved, scores, backend))
    return scores


def _new_storage(folder: Path, task: Task) -> MinariStorage:
    """An empty dataset, which names the environment where Gymnasium has it."""
    if not _missing_in_gymnasium(task):
        with contextlib.closing(make_gymnasium(task)) as env:
            return MinariStorage.new(folder, env.observation_space, env.action_space, _portable_spec(env, task))
    observations = gymnasium.spaces.Box(-np.inf, np.inf, (task.observation_size,), np.float64)
    return MinariStorage.new(
        folder, observations, gymnasium.spaces.Box(np.asarray(task.action_low), np.asarray(task.action_high))
    )


def _portable_spec(env: gymnasium.Env, task: Task) -> EnvSpec:
    """The environment's specification, with the name of one of Gymnasium's models in place of its path."""
    spec = copy.deepcopy(env.spec)
    assert spec
    if task.options.xml_file:
        spec.kwargs["xml_file"] = task.options.xml_file
    return spec


def _buffers(episodes: Iterable[RecordedEpisode], rewards: list[np.ndarray], folder: Path) -> Iterator[EpisodeBuffer]:
    """Episodes as Minari takes them, while the disk has space for them. Their rewards are appended to a list."""
    for episode in episodes:
        if shutil.disk_usage(folder).free < 2 * episode.num_bytes + _RESERVE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder.parents[1]))
        rewards.append(episode.rewards)
        yield EpisodeBuffer(**{field.name: getattr(episode, field.name) for field in dataclasses.fields(episode)})


def _metadata(dataset: str, saved: SavedPolicy, scores: Scores, backend: str) -> dict[str, object]:
    """Facts about the dataset: Minari's own, and those that Minari has no name for under `mjx_walk`."""
    policy, metadata = saved.policy_name, saved.policy_metadata
    source = f"{zoo.PREFIX if zoo.holds(saved.path) else ''}{saved.path.name}"  # the path may name the user
    versions, commit = package_versions(), git_commit()
    return {
        "dataset_id": dataset,
        "minari_version": minari.__version__,
        "algorithm_name": saved.config.algo.name,
        "description": f"Episodes of the {policy} policy of {source} in {scores.env}, without noise.",
        "requirements": [f"{name}=={versions[name]}" for name in _REQUIREMENTS],
        "mjx_walk": {
            "run": source,
            "policy": policy,
            "env_steps": metadata["env_steps"],
            **({"fraction": metadata["fraction"]} if "fraction" in metadata else {}),
            "backend": backend,
            "physics": saved.task.engine.name if backend == "sim" else "c",
            "action_noise": "none",
            "seed": scores.seeds[0],
            "mean_return": scores.mean,
            "std_return": scores.std,
            "versions": versions,
            **({"commit": commit} if commit else {}),
        },
    }
