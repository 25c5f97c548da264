"""Measures how fast every world is, beside the bare physics of the same model and beside other environments.

python scripts/benchmark.py [--json FILE] [--figure FILE] [--peers PYTHON]      about five minutes on two cores
python scripts/benchmark.py --quick                                             a smoke test; its numbers mean little

Run it with nothing else running. Every row is timed for a short slot in each of several rounds, so that a machine that
drifts hits all rows alike. A ratio is taken within each round; its median and its range over the rounds are printed.

What is timed: random actions drawn beforehand, with observation, reward, info and autoreset. "bare physics" is
`mujoco.batch.Batch.step` on all cores with the same model, the same substeps and wheel speeds from the same actions;
its robots are put where the environment's robots were, outside of the timed part, so that as many stand at walls.
GridWorld, Unicycle and all single environments run on one core, DiffDrive's physics on all. An environment step is
0.2 s of driving for the robots and 0.01 s in PointMaze: the worlds are not equally much work.

PointMaze and MiniGrid are no dependencies of gridnav. They run in an environment of their own:

    python -m venv .peers
    .peers/bin/pip install gymnasium-robotics minigrid "gymnasium[toy-text]"
    python scripts/benchmark.py --peers .peers/bin/python

(tried with gymnasium-robotics 1.4.2, minigrid 3.2.0, gymnasium 1.4.0 and mujoco 4.0.0).
"""

from __future__ import annotations

import argparse
import gc
import importlib.metadata
import itertools
import json
import math
import multiprocessing
import os
import platform
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

# gridnav, mujoco, matplotlib and stable-baselines3 are imported where they are used: the peers' interpreter, which has
# none of them, runs this file too, and worker processes should not load what they do not need.
import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space

WORLDS = ("Unicycle", "DiffDrive", "GridWorld")
BARE, SCAN, HANDOUT, PEER = "bare physics", "lidar scan", "GridWorld's arrays alone", "peer"
SIZES, QUICK_SIZES = (1, 16, 64, 256, 1024, 4096), (1, 16, 64)
SCAN_SIZES = (64, 256, 1024)
FROZEN_LAKE = "FrozenLake-v1"
OTHERS = {"MiniGrid-FourRooms-v0": "minigrid", "PointMaze_UMaze-v3": "gymnasium_robotics"}
"""What the peers' interpreter runs, and the module that registers it."""

SEED = 0
ACTION_POOL, ACTION_ORDER = 64, 10_000
BARE_CALLS = 25
"""Control periods after which bare robots are put back among the environment's: 5 s of driving."""
MIN_CALLS = 3
"""Calls in a slot at least, however long they take."""
PACKAGES = ("gridnav", "mujoco", "numpy", "gymnasium", "numba", "stable-baselines3", "torch")
PEER_PACKAGES = ("gymnasium", "gymnasium-robotics", "minigrid", "mujoco", "numpy")


@dataclass(frozen=True)
class Row:
    """One thing that is timed."""

    name: str
    world: str
    """A world's name, ``BARE``, ``SCAN``, ``HANDOUT`` or ``PEER``."""
    num_envs: int
    """Environment steps in one call."""
    run: Callable[[int], float]
    """Makes so many calls and returns the seconds that they took."""
    most_calls: int | None = None
    """Calls of one run at most."""


@dataclass(frozen=True)
class Claim:
    """A number that users read, with what it should be."""

    name: str
    unit: str
    samples: list[float]
    target: float | None = None
    at_least: bool = True
    """Whether the target bounds the median from below."""
    rows: tuple[str, ...] = ()
    """Of a ratio: the rows above and below the line."""

    @property
    def is_met(self) -> bool | None:
        """Whether the median keeps to the target; None without one."""
        if self.target is None:
            return None
        middle = median(self.samples)
        return middle >= self.target if self.at_least else middle <= self.target


@dataclass(frozen=True)
class Ratio:
    """The rate of one row over that of another."""

    name: str
    over: str
    under: str
    target: float | None = None
    at_least: bool = True


# ------------------------------------------------------------------------------------------ what is timed


def env_id(world: str) -> str:
    """The id with which Gymnasium imports gridnav by itself, in worker processes too."""
    return f"gridnav:gridnav/{world}-v0"


def timed(step: Callable[[], object], calls: int) -> float:
    """Seconds that so many calls take."""
    began = time.perf_counter()
    for _ in range(calls):
        step()
    return time.perf_counter() - began


def random_actions(space: gym.Space[Any], convert: Callable[[Any], Any] = lambda action: action) -> Iterator[Any]:
    """Uniform actions, drawn and converted now; their order has no short period in which robots could get caught."""
    space.seed(SEED)
    pool = [convert(space.sample()) for _ in range(ACTION_POOL)]
    order = np.random.default_rng(SEED).integers(ACTION_POOL, size=ACTION_ORDER)
    return itertools.cycle([pool[i] for i in order])


class VectorWorld:
    """A vector environment of ours; remembers where its robots were."""

    def __init__(self, world: str, num_envs: int) -> None:
        self.envs: Any = gym.make_vec(env_id(world), num_envs=num_envs)
        self._actions = random_actions(self.envs.action_space)
        self._info = self.envs.reset(seed=SEED)[1]
        self.poses: deque[Any] = deque([self._info["pose"]], maxlen=8)

    def step(self) -> None:
        """Step every environment once."""
        self._info = self.envs.step(next(self._actions))[4]

    def run(self, calls: int) -> float:
        """See ``Row.run``."""
        seconds = timed(self.step, calls)
        self.poses.append(self._info["pose"])
        return seconds


class Handout:
    """Only makes fresh copies of all that a step of a vector environment returned, an autoreset included.

    Whatever a world does, a step cannot be cheaper than its arrays.
    """

    def __init__(self, worlds: VectorWorld) -> None:
        worlds.envs.reset(seed=SEED)
        while True:
            *arrays, info = worlds.envs.step(worlds.envs.action_space.sample())
            if "final_info" in info:
                break
        self._arrays = [*arrays, *arrays_in(info)]

    def run(self, calls: int) -> float:
        """See ``Row.run``."""
        return timed(lambda: [array.copy() for array in self._arrays], calls)


def arrays_in(info: dict[str, Any]) -> list[Any]:
    """The arrays of an info and of the infos in it."""
    nested = [arrays_in(value) if isinstance(value, dict) else [value] for value in info.values()]
    return list(itertools.chain.from_iterable(nested))


class SingleWorld:
    """An environment that is stepped one by one, reset where an episode ends."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.env: Any = env
        self._actions = random_actions(env.action_space)
        self.info = self.env.reset(seed=SEED)[1]

    def step(self) -> None:
        """Step once."""
        _, _, terminated, truncated, self.info = self.env.step(next(self._actions))
        if terminated or truncated:
            _, self.info = self.env.reset()

    def run(self, calls: int) -> float:
        """See ``Row.run``."""
        return timed(self.step, calls)


class BareBatch:
    """The physics of a vector environment and nothing else."""

    def __init__(self, worlds: VectorWorld) -> None:
        from mujoco.batch import Batch

        envs = worlds.envs
        self._worlds = worlds
        self._batch = Batch(envs.model, envs.num_envs)  # on all cores, as the environment
        self._controls = wheel_speeds(envs)
        self._substeps = round(envs.control_period_s / envs.model.opt.timestep)

    def step(self) -> None:
        """Drive every robot for one control period."""
        self._batch.ctrl[:] = next(self._controls)
        self._batch.step(nstep=self._substeps)

    def run(self, calls: int) -> float:
        """See ``Row.run``; begins where the environment's robots were at some time."""
        self._worlds.poses.rotate()
        self._batch.reset()
        stand(self._batch.qpos, self._worlds.poses[0])
        self.step()  # contacts settle
        return timed(self.step, calls)


class BareRobot:
    """``mj_step`` on the model of a single environment and nothing else."""

    def __init__(self, world: SingleWorld) -> None:
        import mujoco

        env = world.env.unwrapped
        self._world, self._mujoco = world, mujoco
        self._model, self._data = env.model, mujoco.MjData(env.model)
        self._controls = wheel_speeds(env)
        self._substeps = round(env.control_period_s / env.model.opt.timestep)

    def step(self) -> None:
        """Drive the robot for one control period."""
        self._data.ctrl[:] = next(self._controls)
        self._mujoco.mj_step(self._model, self._data, self._substeps)

    def run(self, calls: int) -> float:
        """See ``Row.run``; begins where the environment's robot is."""
        self._mujoco.mj_resetData(self._model, self._data)
        stand(self._data.qpos, self._world.info["pose"])
        self.step()  # contacts settle
        return timed(self.step, calls)


def wheel_speeds(env: Any) -> Iterator[Any]:
    """Controls of the Burger, rad/s, for the same random actions as the environment's."""
    from gridnav.problem.robot import BURGER

    def controls(actions: Any) -> Any:
        fractions = BURGER.wheel_fractions(actions.astype(np.float64).reshape(-1, 2))
        return (fractions * BURGER.max_wheel_speed_rad_s).reshape(actions.shape)

    return random_actions(env.action_space, controls)


def stand(qpos: Any, pose: Any) -> None:
    """Put free joints at x, y and heading, shape ``(..., 3)``, metres and radians."""
    qpos[..., :2] = pose[..., :2]
    qpos[..., 3], qpos[..., 6] = np.cos(pose[..., 2] / 2), np.sin(pose[..., 2] / 2)


# ------------------------------------------------------------------------------------------ rows


def all_rows(
    given: argparse.Namespace, peers: PeerProcess | None, stack: ExitStack, left_out: dict[str, str]
) -> list[Row]:
    """What is timed, in this order in every round: the two sides of a ratio stand close together."""
    sizes = QUICK_SIZES if given.quick else SIZES
    rows = single_rows(stack)
    for num_envs in sizes:
        rows += rows_of_size(num_envs, stack)
        if num_envs == min(256, sizes[-1]):
            rows += worker_rows(given.workers, given.quick, stack, left_out)
    rows.append(single_row(FROZEN_LAKE, PEER, gym.make(FROZEN_LAKE, is_slippery=False), stack)[0])
    return rows + other_rows(peers, left_out)


def single_rows(stack: ExitStack) -> list[Row]:
    """Each world as ``gym.make`` gives it, DiffDrive without Gymnasium's wrappers, and its bare physics."""
    rows = [single_row(f"{world} single", world, gym.make(env_id(world)), stack)[0] for world in WORLDS]
    robot = gym.make(env_id("DiffDrive")).unwrapped
    row, world = single_row("DiffDrive single, unwrapped", "DiffDrive", robot, stack)
    return [*rows, row, Row("mj_step", BARE, 1, BareRobot(world).run, most_calls=BARE_CALLS)]


def single_row(name: str, world: str, env: gym.Env[Any, Any], stack: ExitStack) -> tuple[Row, SingleWorld]:
    """An environment that is stepped one by one."""
    stack.callback(env.close)
    single = SingleWorld(env)
    return Row(name, world, 1, single.run), single


def rows_of_size(num_envs: int, stack: ExitStack) -> list[Row]:
    """Every world's vector form, and after DiffDrive the bare physics and the lidar of as many robots."""
    rows = []
    for world in WORLDS:
        worlds = VectorWorld(world, num_envs)
        stack.callback(worlds.envs.close)
        rows.append(Row(f"{world} N={num_envs}", world, num_envs, worlds.run))
        if world == "GridWorld":
            rows.append(Row(f"{HANDOUT} N={num_envs}", HANDOUT, num_envs, Handout(worlds).run))
        if world == "DiffDrive":
            bare = BareBatch(worlds)
            rows.append(Row(f"{BARE} N={num_envs}", BARE, num_envs, bare.run, most_calls=BARE_CALLS))
            if num_envs in SCAN_SIZES:
                rows.append(Row(f"{SCAN} N={num_envs}", SCAN, num_envs, partial(scan_robots, worlds)))
    return rows


def scan_robots(worlds: VectorWorld, calls: int) -> float:
    """Seconds of so many scans of all robots, where they were last."""
    from gridnav.envs import scan

    poses, layout, robot = worlds.poses[-1], worlds.envs.layout, worlds.envs.robot
    return timed(lambda: scan(poses, layout, robot), calls)


def worker_rows(workers: int, only_sync: bool, stack: ExitStack, left_out: dict[str, str]) -> list[Row]:
    """DiffDrive's single environment in the vector environments of Gymnasium and stable-baselines3."""
    makers: dict[str, Callable[[int], Any]] = {"SyncVectorEnv": sync_envs}
    if not only_sync:
        makers |= {"AsyncVectorEnv": async_envs, "SubprocVecEnv": subproc_envs}
    single = gym.make(env_id("DiffDrive"))
    stack.callback(single.close)
    actions = random_actions(batch_space(single.action_space, workers))
    rows = []
    for name, make in makers.items():
        try:
            with one_thread_each():
                envs = make(workers)
            stack.callback(close_quietly, envs)
            envs.reset()
        except Exception as error:  # a peer that does not start leaves the others their turn
            left_out[name] = reason(error)
            continue
        rows.append(Row(f"{name} x{workers}", PEER, workers, partial(timed, stepper(envs, actions))))
    return rows


def stepper(envs: Any, actions: Iterator[Any]) -> Callable[[], object]:
    """A call that steps environments with the next actions."""
    return lambda: envs.step(next(actions))


def sync_envs(workers: int) -> Any:
    """One after the other, in this process."""
    return gym.make_vec(env_id("DiffDrive"), num_envs=workers, vectorization_mode="sync")


def async_envs(workers: int) -> Any:
    """A process each; spawned, because a fork of a process with threads may hang."""
    vector = {"context": "spawn"}
    return gym.make_vec(env_id("DiffDrive"), num_envs=workers, vectorization_mode="async", vector_kwargs=vector)


def subproc_envs(workers: int) -> Any:
    """A process each; every one of them imports torch."""
    from stable_baselines3.common.vec_env import SubprocVecEnv

    return SubprocVecEnv([partial(gym.make, env_id("DiffDrive"))] * workers, start_method="spawn")


def close_quietly(envs: Any) -> None:
    """Close what may have lost its workers."""
    with suppress(Exception):
        envs.close()


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Worker processes that start now get one thread each for linear algebra, which they hardly use."""
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def reason(error: Exception) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {error}".splitlines()[0]


# ------------------------------------------------------------------------------------------ the peers' interpreter


class PeerProcess:
    """This file run by another interpreter; it answers every line on its stdin by a line of JSON on its stdout."""

    def __init__(self, python: Path) -> None:
        self._process = subprocess.Popen(
            [python, "-I", __file__, "--peer-process"],  # -I: no setting of this shell reaches into it
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, name: str, calls: int) -> Any:
        """The answer of ``answer_as_peer``.

        Raises:
            RuntimeError: When the other side failed.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with suppress(BrokenPipeError):  # then there is no answer either
            print(name, calls, file=self._process.stdin, flush=True)
        line = self._process.stdout.readline()
        answer = json.loads(line) if line else {"error": "the peers' interpreter ended, its message is above"}
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer[name]

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


def answer_as_peer() -> None:
    """The peers' side of ``PeerProcess``: its packages' versions, or the seconds of calls of an environment."""
    answers, sys.stdout = sys.stdout, sys.stderr  # what packages print when they are imported is no answer
    worlds: dict[str, SingleWorld] = {}
    for line in sys.stdin:
        name, calls = line.split()
        try:
            if name == "versions":
                answer: dict[str, Any] = {name: versions(PEER_PACKAGES)}
            else:
                if name not in worlds:
                    worlds[name] = SingleWorld(gym.make(f"{OTHERS[name]}:{name}"))
                answer = {name: worlds[name].run(int(calls))}
        except Exception as error:  # told to the other side, which leaves this peer out
            answer = {"error": reason(error)}
        print(json.dumps(answer), file=answers, flush=True)


def other_rows(peers: PeerProcess | None, left_out: dict[str, str]) -> list[Row]:
    """Environments of other packages, stepped one by one by the peers' interpreter."""
    rows = []
    for name in OTHERS:
        if peers is None:
            left_out[name] = "give --peers, see --help"
            continue
        try:
            peers.ask(name, 1)
        except RuntimeError as error:
            left_out[name] = str(error)
            continue
        rows.append(Row(name, PEER, 1, partial(peers.ask, name)))
    return rows


# ------------------------------------------------------------------------------------------ rounds


def measure(rows: Sequence[Row], rounds: int, slot_s: float, left_out: dict[str, str]) -> dict[str, list[float]]:
    """Time every row in every round.

    Args:
        rows: In the order in which they take their turns.
        rounds: How often each has its turn.
        slot_s: Least length of a turn, seconds.
        left_out: Gets the peers that fail, and why.

    Returns:
        Per row, its rate in each round, environment steps per second.
    """
    calls: dict[str, int] = {}
    rates: dict[str, list[float]] = {row.name: [] for row in rows}
    for turn in range(rounds + 1):
        print(f"round {turn} of {rounds}" if turn else "warming up", file=sys.stderr, flush=True)
        for row in rows:
            if row.name in left_out:
                continue
            try:
                if turn == 0:
                    calls[row.name] = warm_up(row, slot_s)
                else:
                    rates[row.name].append(rate(row, calls[row.name], slot_s))
            except Exception as error:
                if row.world != PEER:
                    raise
                left_out[row.name] = reason(error)
                del rates[row.name]
    return rates


def warm_up(row: Row, slot_s: float) -> int:
    """Compile, start threads and let episodes drift apart for one slot; returns the calls of a fifth of a slot."""
    calls, spent = 1, 0.0
    while True:
        seconds = row.run(calls)
        spent += seconds
        if spent >= slot_s:
            break
        calls = min(2 * calls, row.most_calls or 2 * calls)
    fifth = math.ceil(calls * 0.2 * slot_s / seconds)
    return min(fifth, row.most_calls or fifth)


def rate(row: Row, calls: int, slot_s: float) -> float:
    """Environment steps per second over one slot."""
    spent, made = 0.0, 0
    while spent < slot_s or made < MIN_CALLS:
        spent += row.run(calls)
        made += calls
    return made * row.num_envs / spent


# ------------------------------------------------------------------------------------------ memory


def fresh(function: Callable[..., float], *arguments: int) -> float:
    """A function's result from a process of its own, whose memory nothing else has touched."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def resident_bytes() -> int:
    """Memory of this process that is in RAM (Linux)."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def robot_kilobytes(few: int, many: int) -> float:
    """What each further robot of a DiffDrive vector environment takes, beyond what all of them share."""
    worlds = []
    after = []
    for num_envs in (few, many):
        worlds.append(VectorWorld("DiffDrive", num_envs))
        worlds[-1].run(5)
        after.append(resident_bytes())
    return (after[1] - after[0]) / many / 1000


def growth_megabytes(num_envs: int, steps: int) -> float:
    """By how much a running DiffDrive vector environment grows over so many environment steps."""
    worlds = VectorWorld("DiffDrive", num_envs)
    worlds.run(steps // num_envs // 10)  # what it takes once
    before = resident_bytes()
    worlds.run(steps // num_envs)
    return (resident_bytes() - before) / 1e6


# ------------------------------------------------------------------------------------------ what is said of it


def ratios(best: str, workers: int) -> list[Ratio]:
    """What users read, with what it should be; ``best`` is the fastest row of DiffDrive."""
    physics = {16: 0.80, 64: 0.87, 256: 0.90}
    robots = "DiffDrive N=256"
    return [
        *(
            Ratio(f"DiffDrive of bare physics, N={n}", f"DiffDrive N={n}", f"{BARE} N={n}", physics.get(n))
            for n in SIZES[1:]
        ),
        Ratio("DiffDrive single of mj_step", "DiffDrive single", "mj_step", 0.50),
        Ratio("DiffDrive single, unwrapped, of mj_step", "DiffDrive single, unwrapped", "mj_step", 0.50),
        *(
            Ratio(f"{robots} over {name} x{workers}", robots, f"{name} x{workers}", target)
            for name, target in (("SyncVectorEnv", None), ("AsyncVectorEnv", 6.0), ("SubprocVecEnv", 6.0))
        ),
        Ratio("DiffDrive N=4096 over N=256", "DiffDrive N=4096", robots, 0.85),
        Ratio("Unicycle over DiffDrive, N=1024", "Unicycle N=1024", "DiffDrive N=1024", 10.0),
        Ratio("Unicycle N=1024 over the best DiffDrive", "Unicycle N=1024", best, 10.0),
        Ratio("GridWorld N=4096 of handing out its arrays", "GridWorld N=4096", f"{HANDOUT} N=4096"),
        Ratio(f"GridWorld N=4096 over {FROZEN_LAKE}", "GridWorld N=4096", FROZEN_LAKE, 400.0),
        *(
            Ratio(f"lidar scan, share of bare physics, N={n}", f"{BARE} N={n}", f"{SCAN} N={n}", 0.1, False)
            for n in SCAN_SIZES
        ),
    ]


def ratio_claims(rates: dict[str, list[float]], workers: int) -> list[Claim]:
    """The ratios of each round, of those whose rows were timed."""
    best = max((name for name in rates if name.startswith("DiffDrive N=")), key=lambda name: median(rates[name]))
    claims = []
    for ratio in ratios(best, workers):
        if ratio.over in rates and ratio.under in rates:
            samples = [over / under for over, under in zip(rates[ratio.over], rates[ratio.under], strict=True)]
            rows = (ratio.over, ratio.under)
            claims.append(Claim(ratio.name, "", samples, ratio.target, ratio.at_least, rows))
    return claims


def other_claims(rates: dict[str, list[float]], quick: bool, left_out: dict[str, str]) -> list[Claim]:
    """What is no ratio: GridWorld's rate and the memory of DiffDrive."""
    claims = []
    if "GridWorld N=4096" in rates:
        millions = [sample / 1e6 for sample in rates["GridWorld N=4096"]]
        claims.append(Claim("GridWorld N=4096 on one core", "M steps/s", millions, 50.0))
    if not Path("/proc/self/statm").exists():
        left_out["memory"] = "this system has no /proc/self/statm"
        return claims
    many = 1024 if quick else 4096
    print("memory", file=sys.stderr, flush=True)
    claims.append(Claim("memory per DiffDrive robot", "kB", [fresh(robot_kilobytes, 16, many)], 100.0, False))
    if quick:
        left_out["growth of memory"] = "--quick"
    else:
        growth = fresh(growth_megabytes, 256, 1_000_000)
        claims.append(Claim("growth of memory over 10^6 DiffDrive steps", "MB", [growth]))
    return claims


def spread(samples: Sequence[float]) -> dict[str, float]:
    """Median and range."""
    return {"median": median(samples), "min": min(samples), "max": max(samples)}


def print_table(rows: Sequence[Row], rates: dict[str, list[float]]) -> None:
    """Rates of all rows."""
    print(f"{'environment steps per second':<30}{'median':>14}{'min':>14}{'max':>14}")
    for row in rows:
        print(f"{row.name:<30}" + "".join(f"{value:>14,.0f}" for value in spread(rates[row.name]).values()))


def print_claims(claims: Sequence[Claim]) -> None:
    """What users read, beside its target."""
    print(f"\n{'':<46}{'median':>10}{'min':>10}{'max':>10}   target")
    for claim in claims:
        values = "".join(f"{value:>10,.{3 if value < 10 else 1}f}" for value in spread(claim.samples).values())
        target = ""
        if claim.target is not None:
            target = f"{'>=' if claim.at_least else '<='} {claim.target:g}: {'met' if claim.is_met else 'missed'}"
        print(f"{claim.name + (f' ({claim.unit})' if claim.unit else ''):<46}{values}   {target}".rstrip(), flush=True)


def row_entry(row: Row, samples: Sequence[float]) -> dict[str, Any]:
    """A row for the JSON file, in environment steps per second."""
    return {"name": row.name, "world": row.world, "num_envs": row.num_envs, **spread(samples), "samples": samples}


def claim_entry(claim: Claim) -> dict[str, Any]:
    """A claim for the JSON file."""
    return {**asdict(claim), **spread(claim.samples), "is_met": claim.is_met}


def versions(packages: Sequence[str]) -> dict[str, str]:
    """Versions of Python and of the packages that are installed."""
    found = {"python": platform.python_version()}
    for package in packages:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def machine() -> dict[str, Any]:
    """Processor, cores and system."""
    processor = platform.processor()
    with suppress(OSError, StopIteration):  # Linux says more there
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return {"processor": processor, "cores": os.cpu_count(), "system": platform.system()}


def model_settings() -> dict[str, float]:
    """Times of DiffDrive's default model, seconds."""
    robot: Any = gym.make(env_id("DiffDrive")).unwrapped
    return {"timestep_s": robot.model.opt.timestep, "control_period_s": robot.control_period_s}


# ------------------------------------------------------------------------------------------ picture


def scaling_curve(rows: Sequence[Row], rates: dict[str, list[float]]) -> Any:
    """Rates against the size of the batch as a matplotlib figure; medians as lines, ranges as bands."""
    import matplotlib
    from matplotlib.figure import Figure

    from gridnav.display import palette
    from gridnav.display.figures import STYLE

    styles = {
        "GridWorld": (palette.GREEN, "-", "s"),
        "Unicycle": (palette.ORANGE, "-", "^"),
        "DiffDrive": (palette.BLUE, "-", "o"),
        BARE: (palette.INK, "--", ""),
    }
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 4.6), layout="constrained")
        axes = figure.add_subplot(xscale="log", yscale="log")
        for world, (colour, line, mark) in styles.items():
            samples = {r.num_envs: rates[r.name] for r in rows if r.name == f"{world} N={r.num_envs}"}
            lows, highs = ([end(s) for s in samples.values()] for end in (min, max))
            axes.plot(
                list(samples), [median(s) for s in samples.values()], line, color=colour, marker=mark, label=world
            )
            axes.fill_between(list(samples), lows, highs, color=colour, alpha=0.2, linewidth=0)
        sizes = sorted({row.num_envs for row in rows if row.world == BARE})
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.set(xlabel="environments in the batch, N", ylabel="environment steps per second")
        axes.minorticks_off()
        axes.grid(alpha=0.25)
        axes.legend(loc="upper left")
        mark_peers(axes, {row.name: median(rates[row.name]) for row in rows if row.world == PEER})
    return figure


def mark_peers(axes: Any, peers: dict[str, float]) -> None:
    """A dotted line at each peer's rate and its name at the right, moved up where two would overlap."""
    from gridnav.display import palette

    for rate in peers.values():
        axes.axhline(rate, color=palette.WALL, linestyle=":", linewidth=1)
    low, high = (math.log10(limit) for limit in axes.get_ylim())
    axes.set_ylim(10**low, 10**high)  # what is added from here on moves nothing
    place = -1.0
    for name, rate in sorted(peers.items(), key=lambda peer: peer[1]):
        at = (math.log10(rate) - low) / (high - low)
        place = max(at, place + 0.05)
        axes.annotate(
            name,
            xy=(1.0, at),
            xytext=(1.04, place),
            xycoords="axes fraction",
            fontsize=8,
            va="center",
            arrowprops={"arrowstyle": "-", "color": palette.WALL, "linewidth": 0.6, "relpos": (0.0, 0.5)},
        )


# ------------------------------------------------------------------------------------------ command line


def parsed(words: Sequence[str]) -> argparse.Namespace:
    """The arguments, checked before anything is measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few sizes, short slots, no worker processes")
    parser.add_argument("--rounds", type=int, help="turns of every row (default 7, quick 2)")
    parser.add_argument("--slot", type=float, metavar="SECONDS", help="length of a turn (default 0.5, quick 0.02)")
    parser.add_argument("--workers", type=int, default=8, help="processes of AsyncVectorEnv and SubprocVecEnv")
    parser.add_argument("--peers", type=Path, metavar="PYTHON", help="interpreter that has PointMaze and MiniGrid")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything here")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw the scaling curve here (png, svg, pdf)")
    parser.add_argument("--peer-process", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(words)
    given.rounds = (2 if given.quick else 7) if given.rounds is None else given.rounds
    given.slot = (0.02 if given.quick else 0.5) if given.slot is None else given.slot
    if given.rounds < 1 or not 0 < given.slot < math.inf or not 1 <= given.workers <= 8:
        parser.error("--rounds must be at least 1, --slot a positive number and --workers 1 to 8")
    if given.peers and not (given.peers.is_file() and os.access(given.peers, os.X_OK)):
        parser.error(f"--peers {given.peers} is no program: make it as --help says")
    for file in (given.json, given.figure):
        if file and (file.is_dir() or not file.absolute().parent.is_dir()):
            parser.error(f"{file} is a folder, or in none")
    if given.figure and given.figure.suffix not in (".png", ".svg", ".pdf"):
        parser.error(f"--figure {given.figure} ends in none of .png, .svg and .pdf")
    return given


def measured(
    given: argparse.Namespace, left_out: dict[str, str]
) -> tuple[list[Row], dict[str, list[float]], dict[str, str]]:
    """Rows, their rates, and the versions of the peers' packages."""
    peers, peer_versions = None, {}
    with ExitStack() as stack:
        if given.peers:
            peers = PeerProcess(given.peers)
            stack.callback(peers.close)
            with suppress(RuntimeError):  # said when its first environment is asked for
                peer_versions = peers.ask("versions", 0)
        rows = all_rows(given, peers, stack, left_out)
        rates = measure(rows, given.rounds, given.slot, left_out)
    return [row for row in rows if row.name in rates], rates, peer_versions


def main(words: Sequence[str]) -> None:
    """Measure, print, write."""
    given = parsed(words)
    if given.peer_process:
        answer_as_peer()
        return
    left_out: dict[str, str] = {}
    rows, rates, peer_versions = measured(given, left_out)
    print_table(rows, rates)
    compared = ratio_claims(rates, given.workers)
    print_claims(compared)
    others = other_claims(rates, given.quick, left_out)
    print_claims(others)
    for name, why in left_out.items():
        print(f"left out: {name} ({why})")
    if given.json:
        report = {
            "date": datetime.now(UTC).date().isoformat(),
            "rounds": given.rounds,
            "slot_s": given.slot,
            "is_quick": given.quick,
            "machine": machine(),
            "versions": versions(PACKAGES),
            "peer_versions": peer_versions,
            "model": model_settings(),
            "rows": [row_entry(row, rates[row.name]) for row in rows],
            "ratios": [claim_entry(claim) for claim in compared],
            "quantities": [claim_entry(claim) for claim in others],
            "left_out": left_out,
        }
        given.json.write_text(json.dumps(report, indent=1) + "\n")
    if given.figure:
        scaling_curve(rows, rates).savefig(given.figure, dpi=150)


if __name__ == "__main__":
    main(sys.argv[1:])
