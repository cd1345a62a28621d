"""Train golden cases in one tree: `python worker.py OUT CASE.json…`, with the tree first on PYTHONPATH.

It uses nothing of the tree but its training command, so that it runs in any of them. A planted fault shows that the
gate can fail.
"""

import json
import os
import sys
import traceback
from pathlib import Path

import jax
import matplotlib.figure


def plant(fault: str) -> None:
    """Break the tree that is imported in this process, but not in the processes of several devices, which it starts."""
    if fault == "keys":
        split = jax.random.split

        def swapped(key, num=2):
            keys = split(key, num)
            return keys[::-1] if num == 2 else keys

        jax.random.split = swapped
    elif fault == "layout":
        from brax.training.acme import running_statistics

        update = running_statistics.update
        running_statistics.update = lambda state, batch, **further: update(state, batch.swapaxes(0, 1), **further)
    elif fault:
        raise ValueError(fault)


def train(out: Path, name: str, parts: list[list[str]]) -> None:
    """Train a case in its parts, the later ones resumed, into `OUT/NAME`; `done` appears in it at the end."""
    from mjx_walk.train import main

    for part, arguments in enumerate(parts):
        resume = ["resume=true"] if part else []
        code = main([*arguments, f"run_dir={out / name}", *resume])
        if code:
            raise RuntimeError(f"{name}: exit code {code}")
    (out / name / "done").touch()


def run() -> int:
    out = Path(sys.argv[1])
    matplotlib.figure.Figure.savefig = lambda *args, **kwargs: None  # type: ignore[method-assign]  # nobody looks
    import mjx_walk  # noqa: F401

    plant(os.environ.get("GOLDEN_FAULT", ""))
    failed = 0
    for case in map(json.loads, sys.argv[2:]):
        try:
            train(out, case["name"], case["parts"])
        except Exception:
            traceback.print_exc()
            failed = 1
    return failed


if __name__ == "__main__":
    sys.exit(run())
