"""Killed runs lose nothing: each continues bit for bit like an undisturbed one.

`pytest -m campaign -n 0 -s` tries 200 kills and 200 damages; `--faults N` and `--fault-seed N` choose others.
"""

import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
from faults import RUNS, Tally, arguments_of, differences, num_rows, resumed, trained, wait_for_new_rows
from helpers import command

SHARES = {"ppo": 0.25, "sac": 0.2, "csac": 0.2, "td3": 0.15, "seeds": 0.15, "devices": 0.05}
"""Parts of the kills."""


def kill_again_and_again(server, name, tmp_path, rng, count):
    """Kill a run at random moments, resume it each time, and compare what it has become with an undisturbed one."""
    reference, run_dir, tally = trained(server, name, tmp_path / "reference"), tmp_path / "run", Tally(f"kills, {name}")
    log = run_dir / "seed_0" if name == "seeds" else run_dir
    is_finished = False
    while tally.tried < count or not is_finished:
        process = server.start(*resumed(name, run_dir))
        if tally.tried < count:
            wait_for_new_rows(process, log, rng.choice([0, 1, 1, 2, 3]))
            time.sleep(rng.uniform(0.0, 0.4))
        if tally.tried < count and process.is_running:
            tally.tried += 1
            process.kill()
            tally.check(process, process.wait(), (-signal.SIGKILL,))
            continue
        is_finished = tally.check(process, process.wait(), (0,))
        if not is_finished:
            break
        tally.bad["silent differences"] += differences(run_dir, reference)
        if tally.tried < count:
            shutil.rmtree(run_dir)
    tally.report()
    assert tally.tried == count


@pytest.mark.campaign
@pytest.mark.parametrize("name", [name for name in RUNS if name != "devices"])
def test_kills(server, tmp_path, rng, num_faults, name):
    kill_again_and_again(server, name, tmp_path, rng, max(1, round(SHARES[name] * num_faults)))


@pytest.mark.slow
def test_five_kills(server, tmp_path, rng):
    kill_again_and_again(server, "ppo", tmp_path, rng, 5)


@pytest.mark.campaign
def test_kills_of_two_processes(tmp_path, rng, num_faults):
    """Of one of them, or of the command that started them."""
    tally = Tally("kills, two processes")
    reference, run_dir = tmp_path / "reference", tmp_path / "run"
    assert command("train", *arguments_of("devices", reference)).returncode == 0
    count = max(1, round(SHARES["devices"] * num_faults))
    while tally.tried < count:
        with (tmp_path / "output.txt").open("w") as output:
            parent = subprocess.Popen(
                [sys.executable, "-m", "mjx_walk.train", *resumed("devices", run_dir)],
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
        before = num_rows(run_dir)
        while parent.poll() is None and num_rows(run_dir) in (0, before):
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.5))
        children = subprocess.run(["pgrep", "-P", str(parent.pid)], capture_output=True, text=True).stdout.split()
        if parent.poll() is None:
            tally.tried += 1
            if rng.random() < 0.3:
                parent.kill()
            for child in rng.sample(children, 1) if rng.random() < 0.7 else children:
                os.kill(int(child), signal.SIGKILL)
        try:
            parent.wait(120)
        except subprocess.TimeoutExpired:
            tally.bad["hangs"].append((tmp_path / "output.txt").read_text())
        for child in children:  # they outlive a parent that was killed
            subprocess.run(["kill", "-9", child], stderr=subprocess.DEVNULL)
        if parent.returncode == 0:
            tally.bad["silent differences"] += differences(run_dir, reference)
            shutil.rmtree(run_dir)
    done = command("train", *resumed("devices", run_dir))
    if done.returncode:
        tally.bad["lost"].append(done.stdout + done.stderr)
    else:
        tally.bad["silent differences"] += differences(run_dir, reference)
    tally.report()
