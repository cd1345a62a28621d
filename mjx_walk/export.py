"""`python -m mjx_walk.export run=RUN_DIR`: export a policy for other programs, its episodes, or a folder to share."""

import dataclasses
import importlib.util
import json
import shlex
from pathlib import Path

import mujoco

from mjx_walk import __version__, zoo
from mjx_walk.api import Run, load_run
from mjx_walk.cli import parsing
from mjx_walk.envs import require_model
from mjx_walk.envs.motors import joint_of
from mjx_walk.evaluation.saved_policies import choose_policy, kept_policies
from mjx_walk.interop import hub_folder
from mjx_walk.settings.own_tasks import take_task
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.files import replacing, user_path
from mjx_walk.storage.folders import replacing_folder
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST, MILESTONES, POLICIES
from mjx_walk.training.messages import choice_line
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import MAX_SEED, refuse_ineffective, setting
from mjx_walk.viewing.episode import record_episode
from mjx_walk.viewing.rendering import choose_opengl, write_film

__all__ = ["USAGE", "Arguments", "main"]

USAGE = """
usage: python -m mjx_walk.export run=RUN_DIR|zoo:NAME [policy=NAME] [format=onnx] [dtype=float64|float32]
                                 [out=FILE.onnx]
       python -m mjx_walk.export run=RUN_DIR|zoo:NAME [policy=NAME | policies=NAME,NAME,…] format=minari
                                 [episodes=1000] [backend=gymnasium|sim] [seed=0] [out=FOLDER]
       python -m mjx_walk.export run=RUN_DIR|zoo:NAME [policy=NAME] format=torch [out=FOLDER]
       python -m mjx_walk.export run=RUN_DIR|zoo:NAME [policy=NAME] format=hub [out=FOLDER]

  policy=best     the policy with the highest evaluation during training, the default
  policy=final    the newest policy, which eval scores by default
  policy=medium   about two thirds of the way from the first evaluation to the best one; policy=simple is at one third.
                  A training with checkpoint.milestones=true keeps them.
  env.task=FILE.py:CLASS   the task of the run, if it is your own and you have not named its file before

format=onnx, the policy:
  out=FILE.onnx   by default RUN_DIR/policy.onnx, or NAME.onnx in the current folder for a policy of the zoo. The model
                  maps `observation`, [N, observation_size], to `action`, [N, action_size] f32, both in Gymnasium's
                  units. It normalizes observations itself. Its metadata name the task, the policy and the motors.
  dtype=float64   of `observation`: Gymnasium's observations are float64

format=minari, a dataset of the policy's episodes, without noise:
  policies=expert,medium,simple   a dataset for each of these policies; expert is the best one
  episodes=1000   complete episodes; those of Humanoid take about 3 MB each
  backend=gymnasium   the real environment, on the CPU
  backend=sim     the run's own engine, on the GPU if there is one; for every task, also your own
  seed=N          in Gymnasium, episode i is reset with N + i; with backend=sim, all starts are drawn from N
  out=FOLDER      of datasets, by default Minari's own: $MINARI_DATASETS_PATH or ~/.minari/datasets. The dataset has a
                  folder of its own below it. An existing dataset is not overwritten.

format=torch, the policy for PyTorch:
  out=FOLDER      of two files, by default RUN_DIR/policy.torch, or NAME.torch in the current folder for a policy of the
                  zoo. policy.safetensors holds the arrays. policy.py builds the network.

format=hub, a folder to share, as on the Hugging Face Hub:
  out=FOLDER      by default RUN_DIR/policy.hub, or NAME.hub in the current folder for a policy of the zoo. It holds a
                  model card, the policy, its score, its ONNX file, and a film where this machine can render. Commands
                  take it as run=FOLDER. An existing folder is not overwritten.
"""


@dataclasses.dataclass
class Arguments:
    run: str | None = None
    policy: str | None = setting(None, choices=POLICIES)
    format: str = setting("onnx", choices=("onnx", "minari", "torch", "hub"))
    policies: str | None = setting(None, only_if={"format": "minari"})
    dtype: str = setting("float64", choices=("float64", "float32"), only_if={"format": "onnx"})
    episodes: int = setting(1000, at_least=1, only_if={"format": "minari"})
    backend: str = setting("gymnasium", choices=("gymnasium", "sim"), only_if={"format": "minari"})
    seed: int = setting(0, at_least=0, at_most=MAX_SEED, only_if={"format": "minari"})
    out: str | None = None


def main(command_line: list[str]) -> None:
    """Write the file or the dataset."""
    own = take_task(command_line)
    arguments = parsing.parse(Arguments, own, USAGE)
    refuse_ineffective(arguments, [argument.partition("=")[0] for argument in own])
    if arguments.backend == "gymnasium":
        parsing.stay_on_cpu()
    folder = zoo.open_run(arguments.run)
    run = _EXPORTS[arguments.format](arguments, folder)
    if arguments.policy is arguments.policies is None and len(kept_policies(folder)) > 1:
        print(choice_line(run.policy_name))


def _export_onnx(arguments: Arguments, folder: RunFolder) -> Run:
    """Write the policy as ONNX, and say where it is."""
    _require_onnx(arguments.format)
    path = user_path(arguments.out) if arguments.out else zoo.output_path(folder, "policy.onnx")
    parsing.check_suffix(path, ".onnx")
    parsing.check_writable(path)
    run = load_run(folder.path, "c", arguments.policy or BEST)
    _write_onnx(path, run, arguments.dtype)
    print(f"{path}: observation [N, {run.task.observation_size}] → action [N, {run.task.action_size}]")
    print(f"It holds the {run.policy_name} policy (step {run.policy_metadata['env_steps']:,}).")
    return run


def _require_onnx(file_format: str) -> None:
    if importlib.util.find_spec("onnx") is None:
        raise UserError(f"format={file_format} needs ONNX: pip install onnx")


def _write_onnx(path: Path, run: Run, dtype: str) -> None:
    import onnx

    from mjx_walk.interop.onnx import translate

    name = f"{run.config.env.name}_{run.config.algo.name}"
    model = translate(run.act, run.task.observation_size, name, dtype)
    onnx.helper.set_model_props(model, _metadata(run))
    with replacing(path) as new:
        onnx.save(model, str(new))


def _export_minari(arguments: Arguments, folder: RunFolder) -> Run:
    """Write a dataset of the policy's episodes, and say how to load it."""
    try:
        import h5py  # noqa: F401  # Minari imports it late
        from minari.storage import get_dataset_path

        from mjx_walk.interop.minari import check_absent, check_task, dataset_id, write_dataset
    except ImportError as error:
        raise UserError("format=minari needs Minari: pip install 'minari[hdf5]'") from error
    root = get_dataset_path() if arguments.out is None else user_path(arguments.out)
    is_simulated = arguments.backend == "sim"
    runs = {
        quality: load_run(folder.path, None if is_simulated else "c", policy)
        for quality, policy in _qualities(arguments, folder).items()
    }
    for quality, run in runs.items():
        if not is_simulated:
            check_task(require_model(run.task))
        path = root / dataset_id(run, arguments.backend, quality)
        check_absent(path)
        parsing.check_writable(path)
    for quality, run in runs.items():
        scores = write_dataset(root, run, arguments.episodes, arguments.seed, arguments.backend, quality)
        path = root / dataset_id(run, arguments.backend, quality)
        print(f"{path}: episodes of the {run.policy_name} policy ({_place(run.policy_metadata)})", scores, sep="\n")
    print("Load it in a shell and in Python:" if len(runs) == 1 else "Load them in a shell and in Python:")
    print(f"  export MINARI_DATASETS_PATH={shlex.quote(str(root.absolute()))}")
    for quality, run in runs.items():
        print(f'  {quality or "dataset"} = minari.load_dataset("{dataset_id(run, arguments.backend, quality)}")')
    return run


def _qualities(arguments: Arguments, folder: RunFolder) -> dict[str | None, str]:
    """The policies to play, by the names of their datasets; by None for a dataset with the name of the policy.

    Raises:
        UserError: unknown names, or the run has not kept one of the policies.
    """
    if arguments.policies is None:
        return {None: arguments.policy or BEST}
    if arguments.policy:
        raise UserError("give policy=NAME or policies=NAME,NAME, not both")
    names = arguments.policies.split(",")
    if len({*names}) < len(names) or not {*names} <= _QUALITIES.keys():
        raise UserError(f"policies={arguments.policies}: give some of: {','.join(_QUALITIES)}")
    for name in names:
        if choose_policy(folder, _QUALITIES[name]) != _QUALITIES[name]:
            raise UserError(f"{folder.path} has no {_QUALITIES[name]} policy yet; resume its training")
    return {name: _QUALITIES[name] for name in names}


_QUALITIES = {"expert": BEST, **{name: name for name in MILESTONES}}
"""Policies by the names that Minari and D4RL have for their quality."""


def _place(metadata: Metadata) -> str:
    """Where in the training a policy is."""
    step = f"step {metadata['env_steps']:,}"
    return f"{step}, {metadata['fraction']:.0%} of the way to the best" if "fraction" in metadata else step


def _export_torch(arguments: Arguments, folder: RunFolder) -> Run:
    """Write the policy for PyTorch, and say how to load it."""
    try:
        from mjx_walk.interop.torch_policy import MODULE, WEIGHTS, write_policy
    except ImportError as error:
        raise UserError("format=torch needs safetensors: pip install safetensors") from error
    path = user_path(arguments.out) if arguments.out else zoo.output_path(folder, "policy.torch")
    if path.suffix in (".pt", ".pth", ".safetensors"):
        raise UserError(f"out={arguments.out}: format=torch writes a folder with {WEIGHTS} and {MODULE}; name a folder")
    for name in (WEIGHTS, MODULE):
        parsing.check_writable(path / name)
    run = load_run(folder.path, "c", arguments.policy or BEST)
    write_policy(path, run, _metadata(run))
    print(f"{path}: the {run.policy_name} policy (step {run.policy_metadata['env_steps']:,}). In this folder:")
    print(f'  from policy import Policy; policy = Policy("{WEIGHTS}")')
    return run


def _export_hub(arguments: Arguments, folder: RunFolder) -> Run:
    """Write a folder to share, and say how to use it."""
    _require_onnx(arguments.format)
    path = user_path(arguments.out) if arguments.out else zoo.output_path(folder, "policy.hub")
    if path.exists():
        raise UserError(f"{path} exists already; choose another out=, or remove it")
    parsing.check_writable(path)
    run = load_run(folder.path, "c", arguments.policy or BEST)
    hub_folder.check_shareable(run)
    scores, command = run.evaluate(), run.command
    with replacing_folder(path) as new:
        hub_folder.write_run(new, run, scores, command)
        _write_onnx(new / hub_folder.ONNX, run, "float64")
        has_film = _film(run, new / hub_folder.FILM)
        hub_folder.write_card(new / hub_folder.CARD, path.name, run, scores, command, has_film)
    print(f"{path}: {scores}")
    print(f"To share it: hf upload YOUR_NAME/{path.stem} {shlex.quote(str(path))}")
    return run


def _film(run: Run, path: Path) -> bool:
    """Write a film of an episode. Returns whether this machine can render one."""
    try:
        choose_opengl()
    except UserError as error:
        print(f"without a film: {error}")
        return False
    episode = record_episode(require_model(run.task), run.policy, 0, (640, 480))
    write_film(episode.frames, path, episode.frames_per_second)
    return True


_EXPORTS = {"minari": _export_minari, "onnx": _export_onnx, "torch": _export_torch, "hub": _export_hub}


def _metadata(run: Run) -> dict[str, str]:
    """Facts that a program needs to use the policy, as text; lists, numbers and groups of options are JSON."""
    task = require_model(run.task)
    model = task.model
    keywords = task.gymnasium_kwargs()
    if "xml_file" in keywords:  # the folder may name the user
        keywords["xml_file"] = Path(str(keywords["xml_file"])).name
    facts = {
        "keywords": keywords,
        "max_episode_steps": task.max_episode_steps,
        "seconds_per_step": task.dt,
        "motors": [_motor_name(model, i) for i in range(model.nu)],
        "action_low": task.action_low.tolist(),
        "action_high": task.action_high.tolist(),
        "observation": task.observation_blocks(),
        "env_steps": run.policy_metadata["env_steps"],
        **task.export_metadata(),
    }
    names = {"task": task.gymnasium_id, "algorithm": run.config.algo.name, "policy": run.policy_name}
    return (
        names
        | {"mjx_walk": __version__}
        | {name: json.dumps(fact, default=dataclasses.asdict) for name, fact in facts.items()}
    )


def _motor_name(model: mujoco.MjModel, index: int) -> str:
    """Name of a motor, or of the joint that it moves if it has none."""
    joint = joint_of(model, index)
    return model.actuator(index).name or ("" if joint is None else model.joint(joint).name)


if __name__ == "__main__":
    parsing.main(main)
