"""`python tests/golden/gate.py [--full] [CASE…]`: whether this tree trains bit for bit as the reference commit does.

Both trees train the same small cases in the same environment, with the same flags and threads. Every leaf of the
TrainState and every logged metric is compared, NaN equal to NaN, through the tables of renamed leaves. The reference's
run folders are kept below the user's cache folder. `--planted` breaks the present tree first, and must find that.
"""

import argparse
import hashlib
import importlib.metadata
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from pathlib import Path

import ml_dtypes
import numpy as np
import orbax.checkpoint as ocp

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from cases import NUM_ITERATIONS, ON_POLICY, Case, fast_cases, further_cases
from xla_flags import SAFE_REDUCTIONS, quick_compile

REFERENCE = "c69909b"
"""Rebased by a commit that changes bits on purpose, and says which operation."""
TREE = Path(__file__).resolve().parents[2]
_NOT_COMPARED = ("wall_seconds", "speed/")
_OF_FIRST_EVALUATION = ("eval/", "evaluation.best_policy_params.", "evaluation.best_return")
"""Metrics and leaves. On several devices, the first evaluation of the reference scores another key's policy."""


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", nargs="*")
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--planted", choices=("keys", "layout"), default="")
    asked = parser.parse_args()
    cases = fast_cases() + (further_cases() if asked.full else [])
    cases = [case for case in cases if not asked.cases or any(part in case.name for part in asked.cases)]
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "mjx_walk_golden" / _environment()
    started = time.monotonic()
    worktree = cache / "tree"
    if not worktree.exists():
        cache.mkdir(parents=True, exist_ok=True)
        subprocess.run(["git", "worktree", "prune"], cwd=TREE, check=True)
        command = ["git", "worktree", "add", "--force", "--detach", str(worktree), REFERENCE]
        subprocess.run(command, cwd=TREE, check=True, capture_output=True)
    missing = [case for case in cases if not (cache / case.name / "done").exists()]
    train(worktree, missing, cache)
    out = cache / f"present_{os.getpid()}"
    train(TREE, cases, out, asked.planted)
    wrong = [case.name for case in cases if not agree(case, cache / case.name, out / case.name)]
    shutil.rmtree(out)
    verdict = f"{len(wrong)} of {len(cases)} cases differ from {REFERENCE}: {', '.join(wrong)}"
    print(verdict if wrong else f"{len(cases)} cases equal {REFERENCE} bit for bit", end="")
    print(f", {time.monotonic() - started:.0f} s")
    return bool(wrong)


def _environment() -> str:
    """What the bits of the reference depend on, besides the cases."""
    names = ("jax", "jaxlib", "brax", "mujoco", "mujoco-mjx", "warp-lang", "optax", "flax", "numpy", "gymnasium")
    parts = [REFERENCE, platform.processor(), str(os.cpu_count()), Path(__file__).with_name("cases.py").read_text()]
    versions = [importlib.metadata.version(name) for name in names]
    return hashlib.sha256("\n".join(parts + versions).encode()).hexdigest()[:12]


def train(tree: Path, cases: list[Case], out: Path, fault: str = "") -> None:
    """Train cases in a tree, in two processes."""
    flags = f"{quick_compile(1)} {SAFE_REDUCTIONS}"
    env = os.environ | {"PYTHONPATH": str(tree), "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags, "GOLDEN_FAULT": fault}
    workers = []
    for part in (cases[::2], cases[1::2]):
        for case in part:
            shutil.rmtree(out / case.name, ignore_errors=True)
        texts = [
            json.dumps({"name": c.name, "parts": [c.arguments(NUM_ITERATIONS // 2), c.arguments(NUM_ITERATIONS)]})
            for c in part
        ]
        if part:
            out.mkdir(parents=True, exist_ok=True)
            command = [sys.executable, str(Path(__file__).with_name("worker.py")), str(out), *texts]
            log = (out / f"log_{len(workers)}.txt").open("w")
            workers.append((subprocess.Popen(command, env=env, cwd=tree, stdout=log, stderr=log), log.name))
    for worker, log in workers:
        if worker.wait():
            print(Path(log).read_text()[-4000:], file=sys.stderr)


def agree(case: Case, reference: Path, present: Path) -> bool:
    """Whether a case gave the same bits, and what it is there for did occur; prints what is wrong."""
    problems = differences(case, reference, present) or missing_events(case, present)
    print(f"{case.name:<18} {'ok' if not problems else '; '.join(problems[:6])}", flush=True)
    return not problems


def differences(case: Case, reference: Path, present: Path) -> list[str]:
    """Leaves and metrics that differ, in all checkpoints and logs of a run."""
    if not (present / "done").exists():
        return ["the present tree did not finish it"]
    found = []
    for path in sorted(reference.rglob("meta.json")):
        place = path.parent.relative_to(reference)
        if place.name == "best":
            continue  # the reference keeps one policy: the better of the last and the best in Gymnasium
        if not (present / place).exists():
            found.append(f"{place} is missing")
            continue
        expected = _renamed(read_arrays(reference / place))
        arrays = read_arrays(present / place)
        if expected.keys() != arrays.keys():
            odd = sorted(expected.keys() ^ arrays.keys())
            found.append(f"{place} has other leaves: {', '.join(odd[:4])}")
        shared = sorted(expected.keys() & arrays.keys())
        if case.num_devices > 1 and expected["evaluation.best_iteration"] == 0:
            shared = [name for name in shared if not name.startswith(_OF_FIRST_EVALUATION)]
        unequal = [name for name in shared if not _same_bits(expected[name], arrays[name])]
        if unequal:
            found.append(f"{place}: {len(unequal)} of {len(shared)} leaves differ, first {unequal[0]}")
    for path in sorted(reference.rglob("metrics.jsonl")):
        place = path.relative_to(reference)
        omitted = (*_NOT_COMPARED, *(_OF_FIRST_EVALUATION if case.num_devices > 1 else ()))
        theirs, mine = _rows(path, omitted), _rows(present / place, omitted)
        # Metrics that the reference does not log are new.
        shared = [{name: row.get(name) for name in old} for row, old in zip(mine, theirs, strict=False)]
        if len(mine) != len(theirs) or shared != theirs:
            found.append(f"{place} differs")
    # The reference scores policies in the precision of the training, and this tree in float32.
    is_float32 = not any("bfloat16" in override for override in case.overrides)
    for path in sorted(reference.rglob("eval_gymnasium.json")) if is_float32 else ():
        mine, theirs = (json.loads((run / path.relative_to(reference)).read_text()) for run in (present, reference))
        scored = [policy for policy in ("final", "best") if policy in theirs]
        if any(theirs[policy]["returns"] != mine[policy]["returns"] for policy in scored):
            found.append("scores in Gymnasium differ")
    return found


def missing_events(case: Case, run: Path) -> list[str]:
    """Of what a case must contain: learning in four iterations, moved parameters, and the rarer branches."""
    rows = [json.loads(line) for line in next(run.rglob("metrics.jsonl")).read_text().splitlines()]
    folders = sorted(path.parent for path in run.rglob("meta.json") if path.parent.name.isdecimal())
    first, last = (read_arrays(folder) for folder in (folders[0], folders[-1]))
    learned = "train/loss" if any(algo in case.name for algo in ON_POLICY) else "train/critic_loss"
    truncated = any(row.get("episode/length", 0) > 2.0 for row in rows)
    best = [array for name, array in last.items() if name.endswith(("best_update", "best_iteration"))]
    moved = [name for name in last if "params" in name or ".policy" in name]
    events = {
        "four iterations that learn": sum(row.get(learned) is not None for row in rows) * _iterations(rows) >= 4,
        "parameters that move": any(not _same_bits(first[name], last[name]) for name in moved),
        "truncated episodes": truncated,
        "reused resets": any(row["resets/reuse_rate"] > 0 for row in rows),
        "a finished evaluation": any("eval/return" in row for row in rows),
        "a new best policy": any(array.max() > 0 for array in best),
    }
    return [f"no {event}" for event, occurred in events.items() if not occurred]


def _iterations(rows: list[dict]) -> int:
    """Iterations of a row."""
    return NUM_ITERATIONS // len(rows)


def read_arrays(folder: Path) -> dict[str, np.ndarray]:
    """Every leaf of a checkpoint, by its path in the TrainState."""
    arrays: dict[str, np.ndarray] = {}
    for part in ("arrays", "replay"):
        path = folder / part
        if (path / "arrays.npz").exists():
            with np.load(path / "arrays.npz") as file:
                arrays |= {name: x.view(ml_dtypes.bfloat16) if x.dtype == "V2" else x for name, x in file.items()}
        elif path.exists():
            with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as checkpointer:
                arrays |= checkpointer.restore(path.absolute())
    return arrays


def _renamed(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Leaves of the reference under their present names."""
    sys.path.insert(0, str(TREE))
    from mjx_walk.storage.checkpoint import present_name

    return {present_name(name): array for name, array in arrays.items()}


def _same_bits(one: np.ndarray, other: np.ndarray) -> bool:
    if one.shape != other.shape or one.dtype != other.dtype:
        return False
    if one.tobytes() == other.tobytes():
        return True
    if one.dtype.kind not in "fV":
        return False
    return bool(np.array_equal(np.float32(one), np.float32(other), equal_nan=True))


def _rows(path: Path, omitted: tuple[str, ...]) -> list[dict]:
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return [{k: v for k, v in row.items() if not k.startswith(omitted)} for row in rows]


if __name__ == "__main__":
    sys.exit(main())
