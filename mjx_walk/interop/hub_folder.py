"""A policy as a folder to share, such as on the Hugging Face Hub. It is a run folder, too, so that commands take it."""

import dataclasses
from pathlib import Path

import yaml

from mjx_walk.envs.model_files import is_asset
from mjx_walk.evaluation.saved_policies import SavedPolicy
from mjx_walk.settings.saved_config import save_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST, Scores, write_scores
from mjx_walk.utils.errors import UserError

__all__ = ["CARD", "FILM", "ONNX", "check_shareable", "write_card", "write_run"]

CARD, FILM, ONNX = "README.md", "replay.mp4", "policy.onnx"
"""Names that the Hub shows, and the policy for programs without this package."""

_CARD = """
# {algorithm} on {task}

A policy of mjx_walk, a trainer in JAX for Gymnasium's MuJoCo tasks.{film}

| Mean return | 95% interval from | to | Std over episodes | Episodes | Training steps |
| ---: | ---: | ---: | ---: | ---: | ---: |
| {mean:,.1f} | {low:,.1f} | {high:,.1f} | {std:,.1f} | {episodes} | {steps:,} |

The policy acts without noise in Gymnasium. The interval is that of the mean over episodes, for this one policy.

## Use

With mjx_walk, in the folder above this one:

```
python -m mjx_walk.eval run={name}
python -m mjx_walk.play run={name} out=walk.mp4
```

Without it, `{onnx}` maps observations to actions, both in Gymnasium's units. It needs onnxruntime only.

## Train

```
{command}
```
"""


def check_shareable(saved: SavedPolicy) -> None:
    """Check that others have the task of a policy.

    Raises:
        UserError: it needs a file of the user.
    """
    xml_file = saved.task.options.xml_file
    own = saved.config.env.task or (xml_file if xml_file and not is_asset(xml_file) else None)
    if own or not saved.task.is_in_gymnasium:
        what = own or saved.task.gymnasium_id
        raise UserError(f"format=hub shares policies of Gymnasium's tasks, and others lack {what}; choose format=onnx")


def write_run(path: Path, saved: SavedPolicy, scores: Scores, command: str) -> None:
    """Write configuration, policy and scores, so that `run=PATH` takes the folder.

    Paths of the user are left out.

    Args:
        path: of the folder.
        saved: the policy.
        scores: its episodes in Gymnasium.
        command: that trained it.
    """
    folder = RunFolder(path)
    config = dataclasses.replace(saved.config, physics="auto", run_dir=None, resume=False, wandb_project=None)
    config.init_from = config.init_from and Path(config.init_from).name
    save_config(config, folder.config)
    checkpoint.save(folder.policy(BEST), saved.policy_params, saved.policy_metadata, as_numpy=True)
    block = scores.block(**saved.policy_metadata)
    write_scores(folder.gymnasium_scores, scores.env, {BEST: block}, {"command": command})


def write_card(path: Path, name: str, saved: SavedPolicy, scores: Scores, command: str, has_film: bool) -> None:
    """Write the model card: facts for the Hub, and a page for people.

    Args:
        path: of the file.
        name: of the folder.
        saved: the policy.
        scores: its episodes in Gymnasium.
        command: that trained it.
        has_film: whether the folder holds a film.
    """
    algorithm, task = saved.config.algo.name, scores.env
    half = 1.96 * scores.std / len(scores.returns) ** 0.5
    score = {"type": "mean_reward", "value": f"{scores.mean:.2f} +/- {scores.std:.2f}", "name": "mean_reward"}
    result = {
        "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
        "dataset": {"name": task, "type": task},
        "metrics": [score | {"verified": False}],
    }
    facts = {
        "library_name": "mjx_walk",
        "tags": ["reinforcement-learning", "mujoco", "gymnasium", "jax", task, algorithm],
        "model-index": [{"name": Path(name).stem, "results": [result]}],
    }
    page = _CARD.format(
        algorithm=algorithm,
        task=task,
        film=f" `{FILM}` shows an episode." if has_film else "",
        mean=scores.mean,
        low=scores.mean - half,
        high=scores.mean + half,
        std=scores.std,
        episodes=len(scores.returns),
        steps=saved.policy_metadata["env_steps"],
        name=name,
        onnx=ONNX,
        command=command,
    )
    front = yaml.safe_dump(facts, sort_keys=False)
    path.write_text(f"---\n{front}---\n{page}", encoding="utf-8")
