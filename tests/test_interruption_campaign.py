"""Signals, full disks, vanished folders and second commands print at most one line, and the run loses nothing."""

import shutil
import signal
import subprocess
import time

import pytest
from faults import Tally, arguments_of, differences, resumed, trained, wait_for_new_rows

pytestmark = pytest.mark.campaign

NAME = "sac"
SIGNALS = (
    *([number] for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)),
    *([signal.SIGINT] * 2, [signal.SIGINT] * 3, [signal.SIGHUP, signal.SIGTERM]),
)


@pytest.fixture(scope="module")
def reference(server, tmp_path_factory):
    """A run that nothing has disturbed."""
    return trained(server, NAME, tmp_path_factory.mktemp("reference") / "run")


def errors_of(command):
    return [line for line in command.printed.splitlines() if line.startswith("error: ")]


def finish(tally, server, run_dir, reference):
    """Resume to the end, and compare."""
    process = server.start(*resumed(NAME, run_dir))
    if tally.check(process, process.wait(), (0,)):
        tally.bad["silent differences"] += differences(run_dir, reference)


def test_signals(server, reference, tmp_path, rng, num_faults):
    tally, run_dir = Tally("signals"), tmp_path / "run"
    for _ in range(max(1, num_faults // 8)):
        numbers = rng.choice(SIGNALS)
        process = server.start(*resumed(NAME, run_dir))
        wait_for_new_rows(process, run_dir, rng.choice([1, 1, 2, 3]))
        for number in numbers:
            time.sleep(rng.uniform(0.0, 0.3))
            process.kill(number)
        tally.tried += 1
        tally.check(process, process.wait(), (0, *(128 + number for number in numbers)))
        if "Finished in" in process.printed:
            tally.bad["silent differences"] += differences(run_dir, reference)
            shutil.rmtree(run_dir)
    finish(tally, server, run_dir, reference)
    tally.report()


def mounted(folder, size):
    folder.mkdir(exist_ok=True)
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], capture_output=True)
    if done.returncode:
        pytest.skip("needs the right to mount a file system")


def remount(folder, options):
    subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)


def test_full_disks(server, reference, tmp_path, rng, num_faults):
    """A file system of a random size, which then grows; and one that is read-only when the run resumes."""
    tally, disk = Tally("full disks"), tmp_path / "disk"
    size = sum(path.stat().st_size for path in reference.rglob("*") if path.is_file())
    for _ in range(max(1, num_faults // 20)):
        mounted(disk, round(rng.uniform(0.02, 1.3) * size))
        try:
            process = server.start(*arguments_of(NAME, disk / "run"))
            tally.tried += 1
            code = process.wait()
            if tally.check(process, code, (0, 2)) and (code == 2) != (len(errors_of(process)) == 1):
                tally.bad["tracebacks"].append(process.printed)
            remount(disk, "ro,size=64m")
            if code == 2 and (disk / "run" / "config.yaml").exists():
                process = server.start(*resumed(NAME, disk / "run"))
                if tally.check(process, process.wait(), (2,)) and len(errors_of(process)) != 1:
                    tally.bad["tracebacks"].append(process.printed)
            remount(disk, "rw")
            finish(tally, server, disk / "run", reference)
        finally:
            subprocess.run(["umount", "--lazy", str(disk)], check=True)
    tally.report()


def test_folders_that_vanish(server, reference, tmp_path, rng, num_faults):
    """A run whose folder is moved stops. It resumes from the new place."""
    tally = Tally("vanished folders")
    for i in range(max(1, num_faults // 20)):
        run_dir, moved = tmp_path / f"run_{i}", tmp_path / f"moved_{i}"
        process = server.start(*arguments_of(NAME, run_dir))
        wait_for_new_rows(process, run_dir, rng.choice([1, 2, 3]))
        time.sleep(rng.uniform(0.0, 0.3))
        run_dir.rename(moved)
        tally.tried += 1
        fine = tally.check(process, process.wait(), (2,))
        if fine and (len(errors_of(process)) != 1 or "has vanished" not in process.printed):
            tally.bad["tracebacks"].append(process.printed)
        if run_dir.exists():
            tally.bad["silent differences"].append(f"{run_dir} was made again")
        finish(tally, server, moved, reference)
    tally.report()


def test_second_commands(server, reference, tmp_path, rng, num_faults):
    tally = Tally("second commands")
    for i in range(max(1, num_faults // 20)):
        run_dir = tmp_path / f"run_{i}"
        first = server.start(*arguments_of(NAME, run_dir))
        wait_for_new_rows(first, run_dir, rng.choice([1, 2]))
        second = server.start(*resumed(NAME, run_dir))
        tally.tried += 1
        if tally.check(second, second.wait(), (2,)) and "in use by another training" not in errors_of(second)[0]:
            tally.bad["tracebacks"].append(second.printed)
        if tally.check(first, first.wait(), (0,)):
            tally.bad["silent differences"] += differences(run_dir, reference)
    tally.report()
