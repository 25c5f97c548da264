"""Kill trainings again and again and compare what comes out with a training that nobody disturbed.

    python scripts/kill_test.py                               every agent, 100 kills each
    python scripts/kill_test.py ppo --kills 5 --seed 3        one agent, a few kills

For each agent a reference is trained without a break. Then the same command is started, killed with SIGKILL at a
random moment and started again with ``--resume``, until it was killed ``--kills`` times, after which it may finish.
Every other kill is aimed inside a save: the killer watches for the folder that a checkpoint is written in and strikes
within a few milliseconds. Both run with ``--checkpoint-s 0``, a checkpoint at every opportunity.

After each kill the newest checkpoint must load. At the end the SHA-256 of every part of the final checkpoint (weights
and visits), of the last checkpoint before it (optimizer, replay buffer, environments and random streams too), of the
metrics and of the evaluation must be those of the reference. Printed is one Markdown row per agent. What checkpoints
cost is measured apart, in a third run of at most ``--cost-s`` seconds, with default settings but for a full budget.

A kill needs a process of its own, which takes seconds to start: 100 kills take about ten minutes per agent on a quiet
machine. Trainings are sized by ``--pieces``: what is left of a training is at least that many checkpoints per kill, and
a process is killed among the first of them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from gridnav.experiment import checkpoint
from gridnav.problem.types import InputError

LAYOUT = "S...\n.#..\n...G"
HEAD = "| agent | kills | inside a save | unreadable | steps lost | files compared | different | time in checkpoints |"
BAR = "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"


def words(agent: str, pieces: int, seed: int) -> list[str]:
    """The command of an agent whose training has about so many checkpoints, on few and small things."""
    quick = 5  # a quick run takes a fifth of the planned steps of a network
    changes = {
        "q-learning": ["num_envs=16", f"visits={max(1, pieces * 16 // 48 + 1)}"],  # a table of 48 entries
        "dqn": ["num_envs=16", f"steps={pieces * 16 * quick}", "hidden=[32]", "batch_size=32", "warm_up=100"],
        "ppo": [
            "num_envs=8",
            f"steps={pieces * 64 * quick}",
            "hidden=[32]",
            "n_steps=8",
            "batch_size=32",
            f"n_validations={6 * quick}",
            "validation_episodes=4",
        ],
    }[agent]
    problem = ["--agent", agent, "--layout", LAYOUT, "--budget", "quick", "--seed", str(seed)]
    return ["train", *problem, "--set", *changes]


def start(arguments: list[str]) -> subprocess.Popen[bytes]:
    """A ``gridnav`` process on one thread."""
    command = [sys.executable, "-m", "gridnav.cli", *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment)


def finish(arguments: list[str]) -> None:
    process = start(arguments)
    errors = process.communicate()[1].decode()
    if process.returncode:
        sys.exit(f"{' '.join(arguments)} ended with {process.returncode}: {errors}")


def newest(run: Path) -> str:
    """Name of the newest checkpoint, empty without one."""
    return max((path.name for path in (run / "checkpoints").glob("step-*")), default="")


def wait(process: subprocess.Popen[bytes], seen: Callable[[], object]) -> bool:
    """Whether it was seen before the process ended."""
    while not seen():
        if process.poll() is not None:
            return False
        time.sleep(0.0002)
    return True


def kill_once(arguments: list[str], run: Path, dice: random.Random, *, aimed: bool) -> bool:
    """Start the command, let it make one to six checkpoints, kill it; whether the kill hit inside a save.

    Without one a process that is killed early would take the training nowhere.
    """
    saves = run / "checkpoints"
    left, seen = set(saves.glob(".tmp-*")), {newest(run)}
    enough = 1 + dice.randint(1, 6)

    def has_enough() -> bool:
        seen.add(newest(run))
        return len(seen) >= enough

    process = start(arguments)
    if not wait(process, has_enough):
        sys.exit(f"the training ended before its last kill: {process.communicate()[1].decode()} (more --pieces?)")
    time.sleep(dice.uniform(0.0, 0.02))
    if aimed and wait(process, lambda: set(saves.glob(".tmp-*")) - left):
        time.sleep(dice.uniform(0.0, 0.01))
    process.send_signal(signal.SIGKILL)
    process.communicate()
    return bool(set(saves.glob(".tmp-*")) - left)


def piece(run: Path, name: str) -> int:
    """Steps of the newest whole checkpoint; raises where there is none."""
    found = checkpoint.load_checkpoint(run / "checkpoints", name)
    if found is None:
        raise InputError("there is none")
    return found.standing.steps


def hashes(run: Path) -> dict[str, str]:
    """SHA-256 of what must be equal; wall-clock times left out."""
    evaluation = json.loads((run / "evaluation.json").read_text())
    for row in evaluation["results"].values():
        row.pop("training_seconds")
    contents = {
        str(part.relative_to(run)): part.read_bytes()
        for part in (run / "checkpoints").glob("step-*/*")
        if part.name != checkpoint.MANIFEST
    }
    contents |= {name: (run / name).read_bytes() for name in ("metrics.jsonl", "config.json")}
    contents["evaluation.json"] = json.dumps(evaluation).encode()
    return {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}


COST = """
import sys, time
start = time.perf_counter()
from gridnav import cli
from gridnav.experiment import checkpoint
from gridnav.experiment.training import Workshop

spent, save, learn = 0.0, checkpoint.save_checkpoint, Workshop.train

def timed(*arguments):
    global spent
    began = time.perf_counter()
    try:
        return save(*arguments)
    finally:
        spent += time.perf_counter() - began

def tell():
    print("COST", spent, time.perf_counter() - start, flush=True)

def learnt(*arguments, **options):
    try:
        return learn(*arguments, **options)
    finally:  # an interrupt ends the process soon after
        tell()

for module in [*sys.modules.values()]:  # wherever it was imported to
    if getattr(module, "save_checkpoint", None) is save:
        module.save_checkpoint = timed
Workshop.train = learnt
try:
    cli.main(sys.argv[1:])
finally:
    tell()
"""


def cost(agent: str, folder: Path, seconds: float) -> str:
    """Share of a run's time that its checkpoints take, as a user trains: default agent, layout and period."""
    process = subprocess.Popen(
        [sys.executable, "-c", COST, "train", "--agent", agent, "--budget", "full", "--run-dir", str(folder / "cost")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    if not wait(process, lambda: newest(folder / "cost")):  # type: ignore[arg-type]
        sys.exit(f"training {agent} ended before its first checkpoint: {process.communicate()[1]}")
    # An interrupt ends the training; where it is over sooner, the run ends by itself.
    try:
        told = process.communicate(timeout=seconds)[0]
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        told = process.communicate()[0]
    spent, took = [float(word) for word in [line for line in told.splitlines() if "COST" in line][-1].split()[1:]]
    return f"{spent / took:.2%} of {took:.0f} s"


def measure(agent: str, options: argparse.Namespace, folder: Path) -> str:
    """One row of the table."""
    dice = random.Random(options.seed)  # noqa: S311
    arguments = [*words(agent, options.pieces * options.kills, options.seed), "--checkpoint-s", "0", "--run-dir"]
    finish([*arguments, str(folder / "reference")])
    run = folder / "killed"
    inside = unreadable = lost = reached = 0
    for number in range(options.kills):
        inside += kill_once([*arguments, str(run), "--resume"], run, dice, aimed=number % 2 == 0)
        try:
            there = piece(run, agent)
            lost, reached = max(lost, reached - there), max(there, reached)
        except InputError as error:
            unreadable += 1
            print(f"{agent}, kill {number + 1}: {error}", file=sys.stderr)
        print(f"{agent}: {number + 1} kills, at {newest(run)}", end="\r", file=sys.stderr)
    finish([*arguments, str(run), "--resume"])
    expected, own = hashes(folder / "reference"), hashes(run)
    different = sorted(name for name in expected.keys() | own.keys() if expected.get(name) != own.get(name))
    for name in different:
        print(f"{agent}: {name} differs", file=sys.stderr)
    leftovers = list(run.rglob(".tmp-*"))
    assert not leftovers, f"litter: {leftovers}"
    spent = cost(agent, folder, options.cost_s) if options.cost_s else "not measured"
    cells = agent, options.kills, inside, unreadable, lost, len(expected), len(different), spent
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("agents", nargs="*", default=["q-learning", "dqn", "ppo"], help="q-learning, dqn or ppo")
    parser.add_argument("--kills", type=int, default=100, help="of each agent")
    parser.add_argument("--pieces", type=int, default=16, help="checkpoints that a training has per kill")
    parser.add_argument("--seed", type=int, default=0, help="of the trainings and of the moments of the kills")
    parser.add_argument("--cost-s", type=float, default=60.0, help="seconds of the run that measures the cost; 0: none")
    parser.add_argument("--keep", type=Path, help="a folder to leave the runs in")
    options = parser.parse_args()
    print(HEAD, BAR, sep="\n", flush=True)
    for agent in options.agents:
        folder = Path(tempfile.mkdtemp(prefix=f"gridnav-kill-{agent}-", dir=options.keep))
        began = time.perf_counter()
        print(measure(agent, options, folder), flush=True)
        print(f"{agent}: {time.perf_counter() - began:.0f} s", file=sys.stderr)
        if options.keep is None:
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
