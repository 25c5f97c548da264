"""Measures what looking costs; run it with nothing else running.

python scripts/measure_display.py

Times and size of a recording of 500 steps with 24 rays, a screenshot, films of 30 s, and how long a page takes to come.
"""

import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gridnav.agents import Planner
from gridnav.display.recording import screenshot, write_recording
from gridnav.experiment.evaluation import evaluate, policy_for
from gridnav.experiment.live import SHARE
from gridnav.experiment.policy_maps import policy_maps
from gridnav.experiment.video import write_video
from gridnav.experiment.worlds import Problem
from gridnav.problem.metrics import Episode

PROBLEM = Problem.load("classic", "default", "default")
ROUNDS = 7


def main() -> None:
    """One line per figure."""
    plan = Planner.solve(PROBLEM.layout, PROBLEM.task, PROBLEM.reward)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        wanderer = drive(500)
        maps = {"robot": policy_maps(PROBLEM, plan, "GridWorld", [wanderer.goal])[wanderer.goal]}
        path = place / "long.rrd"
        report("500 steps, 24 rays", lambda: write_recording(path, PROBLEM.layout, {"robot": wanderer}, maps=maps))
        print(f"  {path.stat().st_size / 1e6:.2f} MB")
        report("screenshot", lambda: screenshot(path, place / "long.png"), rounds=3)

        worlds = PROBLEM.worlds("DiffDrive", 16)
        driven = evaluate(policy_for(plan, worlds), worlds)
        episode = min(driven, key=lambda one: abs(one.elapsed_s - 30.0))
        for camera in ("above", "chase"):
            film = place / f"{camera}.mp4"
            report(
                f"film of {episode.elapsed_s:.0f} s, 640 x 480, {camera}",
                lambda camera=camera, film=film: write_video(film, PROBLEM.layout, episode, "plan", camera=camera),
                rounds=1,
            )
        run = place / "run"
        gridnav = [sys.executable, "-m", "gridnav.cli"]
        quiet = {"check": True, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        subprocess.run([*gridnav, "train", "--agent", "plan", "--run-dir", str(run)], **quiet)
        report("gridnav view --screenshot", lambda: subprocess.run(
            [*gridnav, "view", str(run), "--screenshot", str(place / "run.png")], **quiet
        ), rounds=3)  # fmt: skip
        report("gridnav view --web to a served page", lambda: to_page([*gridnav, "view", str(run), "--web"]), rounds=3)
    print(f"watching a training takes at most {SHARE:.0%} of its time: the next episode waits until that holds")


def drive(steps: int) -> Episode:
    """A drive of the kinematic robot at random, for as long as is asked."""
    rng = np.random.default_rng(0)
    worlds = PROBLEM.worlds("Unicycle", 1)
    worlds.max_episode_steps = steps
    for seed in range(100):
        (episode,) = evaluate(lambda _: rng.uniform(-1, 1, (1, 2)), worlds, seed=seed)
        if episode.steps == steps:
            return episode
    raise RuntimeError("every drive at random arrived")


def to_page(command: list[str]) -> None:
    """Start the command, and end it once the page that it names can be read."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=None)
    try:
        assert process.stdout is not None
        address = process.stdout.readline().split()[0]
        urllib.request.urlopen(address).read()  # noqa: S310, our own server
    finally:
        process.terminate()
        process.wait()


def report(what: str, measured: Callable[[], object], rounds: int = ROUNDS) -> None:
    """Median and range."""
    seconds = []
    for _ in range(rounds):
        began = time.perf_counter()
        measured()
        seconds.append(time.perf_counter() - began)
    print(f"{what}: {statistics.median(seconds):.3f} s ({min(seconds):.3f} to {max(seconds):.3f})", flush=True)


if __name__ == "__main__":
    main()
