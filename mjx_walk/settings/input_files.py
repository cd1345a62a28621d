"""The files that a run reads, and whether they are still those of its training."""

import dataclasses
import hashlib
import json
import shlex
import warnings
from pathlib import Path

from mjx_walk.envs import TASKS, BaseTask, TaskOptions
from mjx_walk.envs.model_files import changed_names, model_path, source_hashes
from mjx_walk.envs.registry import task_hashes
from mjx_walk.envs.user_files import source_path
from mjx_walk.settings.trust import are_hashes
from mjx_walk.storage.checksums import read_json, take_checksum, with_checksum
from mjx_walk.storage.files import read_bytes, write_text
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.utils.errors import UserError

__all__ = [
    "Inputs",
    "changed_input",
    "check_inputs",
    "check_model",
    "read_inputs",
    "save_inputs",
    "warn_of_changed_inputs",
]

_MODEL, _REWARD, _TASK = "env.xml_file", "env.reward_function", "env.task"
_MAX_BYTES = 10_000_000

Inputs = dict[str, dict[str, str]]
"""For each setting that names a file, the SHA-256 of that file and those that it reads, by path relative to its folder.
Gymnasium's own model counts for `env.xml_file`."""


def read_inputs(task: BaseTask) -> Inputs:
    """The files that a task has read."""
    options = task.options
    inputs = {_MODEL: task.model_sources}
    for key, source, hashes in (
        (_REWARD, options.reward_function, task.reward_hashes),
        (_TASK, options.task, task_hashes(options.name)),
    ):
        if source and hashes:
            inputs[key] = {_relative(path, source_path(source).parent): value for path, value in hashes.items()}
    return inputs


def save_inputs(inputs: Inputs, path: Path) -> None:
    """Write the record of a run folder."""
    write_text(path, json.dumps(with_checksum({"sha256": inputs}), indent=1))


def _relative(path: str, folder: Path) -> str:
    return str(Path(path).relative_to(folder)) if Path(path).is_relative_to(folder) else path


def check_inputs(folder: RunFolder, saved: TaskOptions, given: TaskOptions) -> None:
    """Check before a resume that the files of a run are those of its training, unless the user names them again.

    Args:
        folder: of the run; without a record nothing is checked.
        saved: env options of the run.
        given: env options of the command line, without what the run has saved.

    Raises:
        UserError: a file has changed or is gone; the message says what to add.
    """
    if saved.xml_file and not given.xml_file and not model_path(saved.xml_file).is_file():
        raise UserError(
            f"model file not found: {saved.xml_file}; restore it, or add env.xml_file=PATH with the path to which it "
            "has moved"
        )
    named = {name: getattr(given, name) for name in ("xml_file", "reward_function", "task") if getattr(given, name)}
    for key, path in _changes(folder, dataclasses.replace(saved, **named)):
        name = key.removeprefix("env.")
        source = getattr(saved, name)
        if name in named:
            warnings.warn(f"{path} has changed since {folder.path} was trained; it continues with it", stacklevel=2)
            continue
        again = f"add {shlex.quote(f'{key}={source}')}" if source else f"remove {folder.inputs}"
        raise UserError(
            f"{path} has changed since {folder.path} was trained; to continue with it as it is now, {again}"
        )


def check_model(folder: RunFolder, options: TaskOptions) -> None:
    """Check that the model file of a run is there.

    Raises:
        UserError: it is gone; the message says what to do.
    """
    if options.xml_file and not model_path(options.xml_file).is_file():
        raise UserError(
            f"model file not found: {options.xml_file}; restore it, or correct env.xml_file in {folder.config}"
        )


def warn_of_changed_inputs(folder: RunFolder, options: TaskOptions) -> None:
    """Warn if the model or the task of a run is not that of its training. The reward function is not read."""
    for key, path in _changes(folder, options):
        if key != _REWARD:
            warnings.warn(f"{path} has changed since {folder.path} was trained; it is used as it is now", stacklevel=3)


def changed_input(folder: RunFolder, options: TaskOptions) -> Path | None:
    """The first file of a run that is not that of its training. None also without a record."""
    return next((path for _, path in _changes(folder, options)), None)


def _changes(folder: RunFolder, options: TaskOptions) -> list[tuple[str, Path]]:
    """The settings whose files have changed, and the first such file of each."""
    changes = []
    for key, recorded in _read(folder).items():
        root, present = _present(key, recorded, options)
        changed = changed_names(recorded, present)
        if root and changed:
            changes.append((key, root / changed[0]))
    return changes


def _present(key: str, recorded: dict[str, str], options: TaskOptions) -> tuple[Path | None, dict[str, str]]:
    """The folder of a setting's file, if there is one, and the present hashes of the files that it reads."""
    if key == _MODEL:
        model = options.xml_file or TASKS[options.name][0].XML_FILES.get(options.version)
        path = model_path(model) if model else None
        if path is None or path.name not in recorded:  # another model: the settings differ, too
            return None, {}
        try:
            return path.parent, source_hashes(str(model)) if path.is_file() else {}
        except OSError:
            return None, {}  # loading the model reports it
    source = {_REWARD: options.reward_function, _TASK: options.task}.get(key)
    if not source:
        return None, {}
    root = source_path(source).parent
    return root, {name: found for name in recorded if (found := _hash(root / name))}


def _hash(path: Path) -> str | None:
    try:
        return hashlib.sha256(read_bytes(path, _MAX_BYTES)).hexdigest()
    except (OSError, ValueError):
        return None


def _read(folder: RunFolder) -> Inputs:
    """The record of a run folder; empty without one, and with a warning for one that is damaged."""
    try:
        content = read_json(folder.inputs, _MAX_BYTES)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError):
        content = None
    if isinstance(content, dict) and take_checksum(content):
        inputs = content.get("sha256")
        if are_hashes(inputs) and all(name.isprintable() for hashes in inputs.values() for name in hashes):
            return inputs
    warnings.warn(f"{folder.inputs} is damaged: whether the files of the run have changed is not known", stacklevel=4)
    return {}
