"""Run folders of trainings that never ran."""

import json

from mjx_walk.settings.config import load_config
from mjx_walk.settings.saved_config import save_config


def fake_run(folder, overrides, returns, score=None):
    """A run folder whose return rises along `returns`, one row a million steps and ten seconds."""
    folder.mkdir(parents=True)
    config = load_config([*overrides, f"run_dir='{folder}'"])
    save_config(config, folder / "config.yaml")
    rows = [
        {"env_steps": 1e6 * i, "wall_seconds": 10.0 * i, "episode/return": value, "episode/length": 10 * value}
        for i, value in enumerate(returns, start=1)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if score is not None:
        blocks = {"final": {"mean": score, "std": 1.0}, "best": {"mean": score + 10.0, "std": 2.0}}
        (folder / "eval_gymnasium.json").write_text(json.dumps({"env": "Walker2d-v5", **blocks}))
