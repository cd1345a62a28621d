"""`python tests/surroundings.py [TEXT …]`: commands in unusual surroundings, as root on Linux.

With texts, only the cases whose names contain one of them are run. A case passes if it ends with the code that it
should, prints no traceback, and prints one line if it fails. Other users must be able to read the interpreter.
"""

import dataclasses
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from xla_flags import quick_compile

CLONE = Path(__file__).parent.parent
TRAIN = (
    "python -m mjx_walk.train env=inverted_pendulum num_envs=8 total_steps=128 iterations_per_call=1 "
    "algo.unroll_length=8 algo.num_minibatches=2 algo.num_epochs=1 algo.num_unrolls=1 evaluation.num_envs=2 "
    "algo.normalizer_warmup_steps_per_env=8 evaluation.gymnasium_episodes=1 "
    "algo.policy_hidden_layer_sizes=[8] algo.value_hidden_layer_sizes=[8]"
)
BOTH = f"{TRAIN} run_dir=run"
REWARD = 'def size(step):\n    return {"reward_größe": 0.1 * step.reward}\n\n\ngröße = size\n'
STRANGER = "setpriv --reuid=12345 --regid=12345 --clear-groups"
C = "export LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0"


@dataclasses.dataclass
class Case:
    """Surroundings, and what should happen in them."""

    before: str = ":"
    """Shell commands that make the surroundings."""
    command: str = BOTH
    runner: str = ""
    """Command that starts the shell in which `command` runs."""
    redirect: str = ""
    code: int = 0


OWN = f"{TRAIN} run_dir=run env.reward_function=reward.py:größe && python -m mjx_walk.plots run=run"
DELETE = "mkdir d; cd d; (until [ -s {}/metrics.jsonl ]; do sleep 0.1; done; rm -r ../d) >/dev/null 2>&1 &"
SECOND = f"({TRAIN} & p=$!; {TRAIN}; a=$?; wait $p; exit $(( $? + a )))"
CASES = {
    "plain": Case(),
    "C locale": Case(C),
    "ASCII output": Case("export PYTHONIOENCODING=ascii"),
    "ö in a reward term": Case(command=OWN),
    "ö in a reward term, C locale": Case(C, OWN.replace(":größe", ":size")),
    "ö in the name of a reward function, C locale": Case(C, OWN, code=2),
    "ö in run_dir": Case(command=BOTH.replace("=run", "=größe")),
    "ö in run_dir, C locale": Case(C, BOTH.replace("=run", "=größe"), code=2),
    "ö in the working folder, C locale": Case(f"{C}; mkdir größe; cd größe", code=2),
    "blank in run_dir": Case(command=BOTH.replace("=run", "='my run'")),
    "line break in run_dir": Case(command=TRAIN + " run_dir=$'my\\nrun'", code=2),
    "LANG unset": Case("unset LANG LC_ALL LC_CTYPE"),
    "LANG unknown": Case("export LANG=xx_YY.UTF-9 LC_ALL=xx_YY.UTF-9"),
    "TERM unset": Case("unset TERM"),
    "no HOME": Case("unset HOME"),
    "HOME empty": Case("export HOME="),
    "no HOME, no passwd entry": Case("unset HOME; chmod 777 .", runner=STRANGER),
    "no HOME, no passwd entry, ~ in run_dir": Case(
        "unset HOME; chmod 777 .", f"{TRAIN} run_dir='~/run'", runner=STRANGER, code=2
    ),
    "no HOME, no passwd entry, own reward": Case(
        "unset HOME; chmod 777 .",
        f"{OWN} && {TRAIN} run_dir=run resume=true env.reward_function=reward.py:größe",
        runner=STRANGER,
    ),
    "HOME of somebody else": Case("chmod 777 .; export HOME=/root", runner=STRANGER),
    "HOME a file": Case("touch home; export HOME=$PWD/home"),
    "HOME read-only": Case("chmod 777 .; mkdir -m 555 home; export HOME=$PWD/home", runner=STRANGER),
    "XDG_CACHE_HOME read-only": Case(
        "chmod 777 .; mkdir -m 555 c; unset JAX_COMPILATION_CACHE_DIR; export XDG_CACHE_HOME=$PWD/c", runner=STRANGER
    ),
    "XDG_CACHE_HOME a file": Case("touch c; unset JAX_COMPILATION_CACHE_DIR; export XDG_CACHE_HOME=$PWD/c"),
    "XDG_CACHE_HOME empty": Case("unset JAX_COMPILATION_CACHE_DIR; export XDG_CACHE_HOME="),
    "XDG_CACHE_HOME relative": Case("unset JAX_COMPILATION_CACHE_DIR; export XDG_CACHE_HOME=c"),
    "XDG_CONFIG_HOME a file": Case("touch c; export XDG_CONFIG_HOME=$PWD/c", OWN),
    "MPLCONFIGDIR read-only": Case("chmod 777 .; mkdir -m 555 c; export MPLCONFIGDIR=$PWD/c", runner=STRANGER),
    "JAX_COMPILATION_CACHE_DIR a file": Case("touch c; export JAX_COMPILATION_CACHE_DIR=$PWD/c"),
    "stderr closed": Case(redirect="2>&-"),
    "stdout closed": Case(redirect=">&-"),
    "stdin closed": Case(redirect="<&-"),
    "all closed": Case(redirect="<&- >&- 2>&-"),
    "stderr closed, a mistake": Case(command=f"{TRAIN} env=snake", redirect="2>&-", code=2),
    "stdout closed, help": Case(command="python -m mjx_walk.train --help", redirect=">&-"),
    "stderr full": Case(redirect="2>/dev/full"),
    "stdout full": Case(redirect=">/dev/full"),
    "stdout and stderr closed, seeds": Case(command=f"{TRAIN} seeds=2 run_dir=run", redirect=">&- 2>&-"),
    "stderr closed, play": Case(command="python -m mjx_walk.play run=zoo:walker2d-td3 gait=gait.png", redirect="2>&-"),
    "list of commands, all closed": Case(command="python -m mjx_walk", redirect="<&- >&- 2>&-"),
    "working folder deleted, train": Case("mkdir d; cd d; rmdir ../d", TRAIN, code=2),
    "working folder deleted, absolute run_dir": Case(
        "W=$PWD; export W; mkdir d; cd d; rmdir ../d", BOTH.replace("=run", "=$W/run"), code=2
    ),
    "working folder deleted, a mistake": Case("mkdir d; cd d; rmdir ../d", f"{TRAIN} env=snake", code=2),
    "working folder deleted, help": Case("mkdir d; cd d; rmdir ../d", "python -m mjx_walk.train --help", code=2),
    "working folder deleted, commands": Case("mkdir d; cd d; rmdir ../d", "python -m mjx_walk"),
    "working folder deleted, eval": Case("mkdir d; cd d; rmdir ../d", "python -m mjx_walk.eval run=run", code=2),
    "working folder deleted, eval of the zoo": Case(
        "mkdir d; cd d; rmdir ../d", "python -m mjx_walk.eval run=zoo:inverted_pendulum-ppo episodes=2", code=2
    ),
    "working folder deleted, sweep": Case("mkdir d; cd d; rmdir ../d", f"{TRAIN} -m seed=1,2", code=2),
    "working folder deleted, zoo": Case("mkdir d; cd d; rmdir ../d", "python -m mjx_walk.zoo", code=2),
    "working folder deleted, compare": Case(
        "mkdir d; cd d; rmdir ../d", "python -m mjx_walk.compare envs=[walker2d] seeds=1", code=2
    ),
    "working folder deleted, bench": Case(
        "mkdir d; cd d; rmdir ../d", "python -m mjx_walk.bench seconds=0.1 first_calls=true", code=2
    ),
    "working folder deleted, parity": Case(
        "mkdir d; cd d; rmdir ../d",
        "python -m mjx_walk.parity env=inverted_pendulum physics=jax trajectories=1 steps=5",
        code=2,
    ),
    "working folder deleted, play": Case(
        "mkdir d; cd d; rmdir ../d", "python -m mjx_walk.play run=zoo:walker2d-td3", code=2
    ),
    "working folder deleted, export": Case(
        "mkdir d; cd d; rmdir ../d", "python -m mjx_walk.export run=zoo:walker2d-td3 out=x.onnx", code=2
    ),
    "working folder deleted during a training": Case(
        DELETE.format("../d/runs/*/*"), TRAIN.replace("=128", "=1000000"), code=2
    ),
    "working folder deleted during a training elsewhere": Case(
        f"export W=$PWD; {DELETE.format('../run')}", TRAIN.replace("=128", "=2000") + " run_dir=$W/run"
    ),
    "working folder read-only": Case("chmod 555 .", TRAIN, runner=STRANGER, code=2),
    "working folder /": Case("cd /", TRAIN, runner=STRANGER, code=2),
    "working folder / with a run elsewhere": Case(
        "chmod 777 .; export W=$PWD; cd /", BOTH.replace("=run", "=$W/run"), runner=STRANGER
    ),
    "working folder unreadable": Case("mkdir -m 700 d; cd d", TRAIN, runner=STRANGER, code=2),
    "two in the same second": Case(command=SECOND),
    "umask 077": Case("umask 077"),
    "umask 777": Case("chmod 777 .; umask 777", TRAIN, runner=STRANGER, code=2),
    "TMPDIR missing": Case("export TMPDIR=/nowhere/at/all"),
    "TMPDIR empty": Case("export TMPDIR="),
    "TMPDIR full": Case("mkdir t; mount -t tmpfs -o size=4k none t; export TMPDIR=$PWD/t; head -c 9999 /dev/zero >t/f"),
    "no temporary folder": Case(
        "chmod 777 .", runner="unshare -m bash -c 'mount -t tmpfs -o ro none /tmp; exec \"$@\"' -"
    ),
    "python -O": Case("export PYTHONOPTIMIZE=1"),
    "python -OO": Case("export PYTHONOPTIMIZE=2"),
    "python -W error": Case("export PYTHONWARNINGS=error"),
    "python -X dev": Case("export PYTHONDEVMODE=1"),
    "PYTHONDONTWRITEBYTECODE": Case("export PYTHONDONTWRITEBYTECODE=1"),
    "PYTHONUNBUFFERED": Case("export PYTHONUNBUFFERED=1"),
    "PYTHONHASHSEED": Case("export PYTHONHASHSEED=0"),
    "PYTHONSAFEPATH": Case("export PYTHONSAFEPATH=1"),
    "COLUMNS of 1": Case("export COLUMNS=1 LINES=1"),
    "PATH empty": Case("export PATH=$(dirname $(command -v python))"),
}


def run(case: Case) -> tuple[int, str, str, float]:
    """Run a case. Returns its code, both outputs and seconds."""
    with tempfile.TemporaryDirectory(prefix="surroundings_", dir="/var/tmp") as folder:  # one case hides /tmp
        os.chmod(folder, 0o755)
        Path(folder, "reward.py").write_text(REWARD, encoding="utf-8")
        command = f"{case.runner} {shutil.which('bash')} -c 'trap : TERM; eval \"$COMMAND\" {case.redirect}'"
        paths = os.pathsep.join([str(CLONE), *filter(None, [os.environ.get("PYTHONPATH")])])
        env = os.environ | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu", "COMMAND": case.command}
        env["XLA_FLAGS"] = quick_compile(0)
        env["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), env["PATH"]])
        started = time.monotonic()
        script = f"{case.before}\n{command}"
        try:
            done = subprocess.run(
                ["bash", "-c", script],
                cwd=folder,
                env=env,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=900,
                check=False,
            )
            result = done.returncode, done.stdout, done.stderr
        except subprocess.TimeoutExpired as error:
            result = -1, str(error.stdout), str(error.stderr)
        subprocess.run(["umount", f"{folder}/t"], capture_output=True, check=False)
        return *result, time.monotonic() - started


def main(texts: list[str]) -> int:
    """Run the cases whose names contain one of the texts, or all. Returns the exit code."""
    num_failed = 0
    for name, case in CASES.items():
        if texts and not any(text in name for text in texts):
            continue
        code, out, err, seconds = run(case)
        errors = [line for line in err.splitlines() if line.startswith("error: ")]
        is_said = not code or len(errors) == 1 or "2>" in case.redirect
        is_good = code == case.code and "Traceback" not in out + err and is_said
        num_failed += not is_good
        print(f"{'ok  ' if is_good else 'FAIL'} {name:55} code {code} ({case.code}) {seconds:5.1f} s", flush=True)
        for line in err.splitlines()[-14:]:
            print(f"       | {line[:230]}", flush=True)
    print(f"{num_failed} failed")
    return int(num_failed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
