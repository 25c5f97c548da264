"""Measures what looking costs; run it with nothing else running.

python scripts/measure_display.py
python scripts/measure_display.py live [STEPS]

The first: times and size of a recording of 500 steps with 24 rays, a screenshot, films of 30 s, and how long a page
takes to come. The second: what ``--live`` costs a training of PPO on DiffDrive, with and without it in turn.
"""

import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gridnav.agents import Agent, Planner
from gridnav.display.recording import screenshot, write_recording
from gridnav.display.viewer import address_of, free_port, is_open, wait_until
from gridnav.experiment.evaluation import evaluate, policy_for
from gridnav.experiment.live import SHARE, Spectator, Watch
from gridnav.experiment.policy_maps import policy_maps
from gridnav.experiment.results import open_log
from gridnav.experiment.run_directory import RunDirectory
from gridnav.experiment.training import BUDGETS, Choice, Job, Workshop
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
    print(f"watching a training: see `live`; between two episodes at least {1 / SHARE:.0f} times what one took")


def live(steps: int) -> None:
    """What a training takes while it is watched over what it takes alone, by the clock and by the processor.

    The processor's share counts the episode before the first step too. The clock's means nothing on a busy machine: the
    share of the training's seconds in which it was looked at does. Episodes go to a server that draws nothing: what a
    viewer costs depends on the graphics card.
    """
    port, ratios = free_port(), []
    rerun = Path(sys.executable).with_name("rerun")
    server = subprocess.Popen(
        [rerun, "--serve-grpc", "--bind", "127.0.0.1", "--port", str(port)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        wait_until(lambda: is_open(port), "start")
        trained(10_000, 0, port)  # compiles and loads what both need
        for seed in range(ROUNDS):
            took = {is_watched: trained(steps, seed, port if is_watched else 0) for is_watched in order(seed)}
            ratios.append([took[True][i] / took[False][i] for i in range(2)])
            looked = took[True][2] / took[True][0]
            words = f"{took[True][0]:.1f} s and {took[False][0]:.1f} s, {looked:.1%} of the first looking"
            print(f"  {words}: {ratios[-1][0]:.3f} by the clock, {ratios[-1][1]:.3f} by the processor", flush=True)
    finally:
        os.killpg(server.pid, signal.SIGKILL)
    for name, column in zip(("clock", "processor"), zip(*ratios, strict=True), strict=True):
        middle, low, high = statistics.median(column), min(column), max(column)
        print(f"--live, {steps} steps of PPO on DiffDrive, by the {name}: {middle:.3f} ({low:.3f} to {high:.3f})")


def order(number: int) -> tuple[bool, bool]:
    """With and without, in turn first."""
    return (True, False) if number % 2 else (False, True)


class Timed(Spectator):
    """Adds up what its looks took since the first step."""

    looked_s = 0.0

    def watch(self, name: str, world: str, observation: str) -> Watch:
        """The same, timed."""
        look = super().watch(name, world, observation)

        def timed(agent: Agent, steps: int) -> None:
            began = time.perf_counter()
            look(agent, steps)
            self.looked_s += (time.perf_counter() - began) * (steps > 0)

        return timed


def trained(steps: int, seed: int, port: int) -> tuple[float, float, float]:
    """Seconds of a training by the clock, by the processor and looking, watched at a port if it is not 0."""
    spectator = Timed(PROBLEM, address_of(port), 20.0) if port else None
    choice = Choice(changes={"steps": str(steps), "n_validations": "0"})
    with (
        tempfile.TemporaryDirectory() as folder,
        RunDirectory.create(Path(folder) / "run", "train", {}) as run,
        open_log(run) as log,
    ):
        budget, quiet = BUDGETS["default"], lambda _: lambda _: None
        workshop = Workshop(Job(PROBLEM, budget, seed, run, quiet, spectator=spectator), log)
        began = time.process_time()
        seconds = workshop.train("ppo", "ppo", "DiffDrive", choice=choice).seconds
        return seconds, time.process_time() - began, spectator.looked_s if spectator else 0.0


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
    if sys.argv[1:2] == ["live"]:
        live(int(sys.argv[2]) if sys.argv[2:] else 96_000)
    else:
        main()
