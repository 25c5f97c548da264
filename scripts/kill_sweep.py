"""Kill a sweep again and again and compare its table with that of a sweep that nobody disturbed.

    python scripts/kill_sweep.py                           40 short trials, 5 kills
    python scripts/kill_sweep.py --trials 8 --kills 2      fewer

Each trial is Q-learning that ends so early that every seed gives other numbers. A reference is made without a break.
Then the same sweep is started, killed with SIGKILL at a random moment, its workers left alone, and started again with
``--resume``, until it was killed ``--kills`` times, after which it may finish. The kills are spread over the trials:
each strikes within half a second after a random number of trials was done.

After each kill the table must be whole, with no trial twice, and five seconds later no worker may be alive. At the end
``results.csv`` must be that of the reference, byte for byte. Printed is one line.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LAYOUT = "......\n.####.\n......\n.####.\n......"
ORPHANS_S = 5.0


def start(trials: int, folder: Path) -> subprocess.Popen[bytes]:
    """The sweep, in a process group of its own, from its beginning or from where it was killed."""
    seeds = ",".join(str(seed) for seed in range(trials))
    flags = [
        "--agent",
        "q-learning",
        "--layout",
        "four-rooms",
        "--set",
        "visits=1",
        "--budget",
        "quick",
        "--grid",
        f"seed={seeds}",
    ]
    where = ["--run-dir", str(folder), "--checkpoint-s", "0", "--resume", "--jobs", "2"]
    command = [sys.executable, "-m", "gridnav.cli", "sweep", *flags, *where]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True)


def finish(trials: int, folder: Path) -> bytes:
    """The table of a sweep that may finish."""
    process = start(trials, folder)
    errors = process.communicate()[1].decode()
    if process.returncode:
        sys.exit(f"the sweep ended with {process.returncode}: {errors}")
    return (folder / "results.csv").read_bytes()


def kill_after(done: int, trials: int, folder: Path, dice: random.Random) -> None:
    """Start the sweep, wait until so many trials are done and a little longer, and kill it."""
    process = start(trials, folder)
    while len([*folder.glob("trials/*/result.json")]) < done:
        if process.poll() is not None:
            sys.exit(f"the sweep ended before its kill: {process.communicate()[1].decode()}")
        time.sleep(0.001)
    time.sleep(dice.uniform(0.0, 0.5))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert process.returncode == -signal.SIGKILL, "the sweep ended before its kill: more --trials?"
    end = time.monotonic() + ORPHANS_S
    while is_alive(process.pid):
        assert time.monotonic() < end, f"workers are alive {ORPHANS_S} s after their sweep was killed"
        time.sleep(0.05)


def is_alive(group: int) -> bool:
    """Whether a process of the group is left."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def check_table(folder: Path) -> int:
    """Rows of a table that must be whole."""
    with (folder / "results.csv").open(encoding="utf-8", newline="") as file:
        rows = [*csv.DictReader(file)]
    numbers = [int(row["trial"]) for row in rows]
    assert numbers == sorted(set(numbers)), f"a trial is there twice, or out of order: {numbers}"
    assert not any(row["error"] for row in rows), "a trial failed"
    return len(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills")
    options = parser.parse_args()
    dice = random.Random(options.seed)  # noqa: S311
    with tempfile.TemporaryDirectory(prefix="gridnav-kill-sweep-") as name:
        folder = Path(name)
        began = time.perf_counter()
        expected = finish(options.trials, folder / "reference")
        undisturbed_s = time.perf_counter() - began
        moments = sorted(dice.sample(range(options.trials - 4), options.kills))
        seen = []
        for done in moments:
            kill_after(done, options.trials, folder / "killed", dice)
            seen.append(check_table(folder / "killed"))
            print(f"killed with {seen[-1]} trials in the table", file=sys.stderr)
        own = finish(options.trials, folder / "killed")
    same = "the same table, byte for byte" if own == expected else "ANOTHER TABLE"
    rows = expected.count(b"\n") - 1
    print(
        f"{options.trials} trials, killed {options.kills} times with {', '.join(map(str, seen))} of them in the table: "
        f"{same} ({rows} rows, {len(expected)} bytes); undisturbed {undisturbed_s:.0f} s"
    )
    sys.exit(own != expected)


if __name__ == "__main__":
    main()
