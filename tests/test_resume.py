"""A run that was stopped, killed or broken off anywhere goes on as if nothing had happened, bit for bit."""

from __future__ import annotations

import contextlib
import hashlib
import io
import itertools
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import run_cli
from safetensors.numpy import load_file

from gridnav.agents import Planner, Progress
from gridnav.experiment.checkpoint import Standing, clear_leftovers, last_standing, load_checkpoint, save_agent
from gridnav.experiment.course import CHECKPOINT_SHARE, Clock
from gridnav.experiment.results import evaluation, open_log
from gridnav.experiment.run_directory import RunDirectory, RunInUseError
from gridnav.experiment.training import AgentKind, Budget, Choice, Job, Workshop
from gridnav.experiment.worlds import Problem
from gridnav.problem.types import InputError

LAYOUT = "S...\n.#..\n...G"
QUICK = 0.2
"""Share of the planned steps that ``--budget quick`` takes."""
KINDS: tuple[AgentKind, ...] = ("q-learning", "dqn", "ppo")
WORLDS = {"q-learning": "GridWorld", "dqn": "GridWorld", "ppo": "DiffDrive"}
EPISODES = {"q-learning": 50, "dqn": 4, "ppo": 2}
CHANGES = {
    # By hand: 12 cells x 1 goal x 4 moves x 50 visits = 2,400 steps in 150 batches, a report after every third.
    "q-learning": {"num_envs": "16", "visits": "50"},
    # 1,600 steps in 100 batches; the replay buffer has 31 rows and is written round three times.
    "dqn": {
        "num_envs": "16", "steps": "8000", "hidden": "[16]", "batch_size": "32", "replay_size": "500", "warm_up": "100",
    },
    # 1,280 steps in 20 rollouts; four policies are judged, after rollouts 17, 18, 19 and 20.
    "ppo": {
        "num_envs": "8", "steps": "6400", "hidden": "[16]", "n_steps": "8", "batch_size": "32", "n_validations": "20",
        "stack_size": "2",
        "validation_episodes": "4",
    },
}  # fmt: skip

CRASHES = {"q-learning": (3, 1, 7), "dqn": (3, 1, 7), "ppo": (2,) * 19}
"""Reports in which a training breaks off, one after the other; for ppo it is after every rollout."""


@pytest.fixture(autouse=True)
def _without_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that dies loses nothing it has written; only a power cut would, and hundreds of saves take time."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


class Crash(BaseException):
    """What ends a training without a chance to say goodbye."""


def train(run: RunDirectory, kind: AgentKind, *, crash_at: int = 0, checkpoint_s: float = 0.0) -> dict[str, Any]:
    """Train and evaluate in fresh objects, from the run's files if there are any; rows of the evaluation.

    Args:
        run: Where the files are.
        kind: Who learns.
        crash_at: Report of progress in which training breaks off; never by default.
        checkpoint_s: Seconds between checkpoints.
    """
    reports = itertools.count(1)

    def on_progress(progress: Progress) -> None:
        if next(reports) == crash_at:
            raise Crash

    def on_stage(name: str) -> Callable[[Progress], None]:
        return on_progress if name.startswith("training") else lambda progress: None

    problem, budget = Problem.load(LAYOUT, "default", "default"), Budget(QUICK, EPISODES[kind])
    with open_log(run) as log:
        workshop = Workshop(Job(problem, budget, 0, run, on_stage, checkpoint_s=checkpoint_s), log)
        trained = workshop.train(kind, kind, WORLDS[kind], choice=Choice(changes=CHANGES[kind]))
        return rows_of(evaluation([workshop.evaluate(kind, trained, WORLDS[kind], kind)]))


def rows_of(results: dict[str, Any]) -> dict[str, Any]:
    """An evaluation without its wall-clock time."""
    ((_, row),) = json.loads(json.dumps(results)).items()
    return {key: value for key, value in row.items() if key != "training_seconds"}


def new_run(path: Path) -> RunDirectory:
    with RunDirectory.create(path, "train", {}) as run:
        return run


def fingerprint(run: RunDirectory) -> dict[str, str]:
    """SHA-256 of the metrics and of every part of every checkpoint: weights, optimizer, replay, worlds, streams."""
    parts = [run.path / "metrics.jsonl", *run.checkpoints.glob("step-*/*.json"), *run.checkpoints.glob("*/*.safetens*")]
    return {
        str(part.relative_to(run.path)): hashlib.sha256(part.read_bytes()).hexdigest()
        for part in parts
        if part.name != "manifest.json"  # it tells seconds
    }


_REFERENCES: dict[str, tuple[dict[str, str], dict[str, Any]]] = {}


@pytest.fixture
def reference(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    """Fingerprint and evaluation of an uninterrupted run of a kind of agent, made once."""

    def find(kind: AgentKind) -> tuple[dict[str, str], dict[str, Any]]:
        if kind not in _REFERENCES:
            run = new_run(tmp_path_factory.mktemp(kind) / "reference")
            rows = train(run, kind)
            _REFERENCES[kind] = fingerprint(run), rows
        return _REFERENCES[kind]

    return find


# ---- In one process ----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_training_that_breaks_off_goes_on_bit_for_bit(kind: AgentKind, tmp_path: Path, reference: Any) -> None:
    """What is compared holds agent, optimizer, replay buffer, environments, every random stream, visits and metrics."""
    run = new_run(tmp_path / "run")
    touching = 0
    for crash_at in CRASHES[kind]:
        with pytest.raises(Crash):
            train(run, kind, crash_at=crash_at)
        if kind == "ppo":
            worlds = load_file(max(run.checkpoints.glob("step-*")) / "worlds.safetensors")
            touching += int((worlds["contact"] != 0.0).any(axis=1).sum())

    rows = train(run, kind)

    expected, expected_rows = reference(kind)
    assert fingerprint(run) == expected
    # By hand: two checkpoints are kept, the finished agent and the last cut before it.
    parts = {name.split("/")[2] for name in expected if name.startswith("checkpoints/")}
    wanted = ["agent", "training", "worlds", "visits", *(["validation"] if kind == "ppo" else [])]
    assert parts == {f"{part}.{end}" for part in wanted for end in ("json", "safetensors")}
    assert len({name.split("/")[1] for name in expected if name.startswith("checkpoints/")}) == 2
    assert rows == expected_rows
    # Without robots at walls when it broke off, little would be proven about the engine's state.
    assert touching or kind != "ppo"


def test_rare_checkpoints_make_no_other_run(tmp_path: Path, reference: Any) -> None:
    """Work after the last checkpoint is done again, and its rows are written again."""
    run = new_run(tmp_path / "run")
    with pytest.raises(Crash):
        train(run, "q-learning", crash_at=20, checkpoint_s=3600.0)
    assert last_standing(run.checkpoints).steps == 0

    rows = train(run, "q-learning", checkpoint_s=3600.0)

    expected, expected_rows = reference("q-learning")
    own = fingerprint(run)
    final = [name for name in expected if "training" not in name and name in own]
    assert {f"checkpoints/step-000000002400/{part}" for part in ("agent.safetensors", "visits.safetensors")} < {*final}
    assert {name: own[name] for name in final} == {name: expected[name] for name in final}
    assert rows == expected_rows


def test_a_finished_training_is_not_done_again(tmp_path: Path) -> None:
    run = new_run(tmp_path / "run")
    rows, files = train(run, "q-learning"), fingerprint(run)
    before = {path: path.stat().st_mtime_ns for path in run.checkpoints.rglob("*")}

    assert train(run, "q-learning", crash_at=1) == rows  # no report of progress, or it would crash

    assert fingerprint(run) == files
    assert {path: path.stat().st_mtime_ns for path in run.checkpoints.rglob("*")} == before


def test_an_interrupt_in_the_last_moment_of_a_training_is_not_lost(tmp_path: Path, reference: Any) -> None:
    run = new_run(tmp_path / "run")

    def on_progress(progress: Progress) -> None:
        if progress.steps == progress.total_steps:
            signal.raise_signal(signal.SIGINT)

    problem, budget = Problem.load(LAYOUT, "default", "default"), Budget(QUICK, 50)
    with open_log(run) as log, pytest.raises(KeyboardInterrupt):
        Workshop(Job(problem, budget, 0, run, lambda name: on_progress, checkpoint_s=0.0), log).train(
            "q-learning", "q-learning", "GridWorld", choice=Choice(changes=CHANGES["q-learning"])
        )

    assert last_standing(run.checkpoints).is_finished
    assert train(run, "q-learning") == reference("q-learning")[1]


def test_many_checkpoints_between_two_reports_all_count_as_newer(tmp_path: Path) -> None:
    """Their step number is that of the last report; a lower one that pruning freed must not be taken."""
    run = new_run(tmp_path / "run")
    states: list[str] = []

    def on_progress(progress: Progress) -> None:
        # By hand: a report every 6 batches, so the newest checkpoint is that of the batch which reports.
        batch = json.loads((max(run.checkpoints.glob("step-*")) / "training.json").read_text())["batch"]
        states.append(f"{progress.steps} {batch}")

    problem, budget = Problem.load(LAYOUT, "default", "default"), Budget(QUICK, 4)
    with open_log(run) as log:
        Workshop(Job(problem, budget, 0, run, lambda name: on_progress, checkpoint_s=0.0), log).train(
            "q-learning", "q-learning", "GridWorld", choice=Choice(changes={"num_envs": "16", "visits": "100"})
        )

    assert states == [f"{16 * 6 * (i + 1)} {6 * (i + 1) - 1}" for i in range(50)]


def test_a_second_agent_of_a_run_goes_on_after_the_first(tmp_path: Path) -> None:
    """As rungs of the ladder do: the metrics of the first stay, and its checkpoints are not in the way."""

    def train_both(run: RunDirectory, crash_at: int = 0) -> None:
        reports = itertools.count(1)

        def on_progress(progress: Progress) -> None:
            if next(reports) == crash_at:
                raise Crash

        problem, choice = Problem.load(LAYOUT, "default", "default"), Choice(changes=CHANGES["q-learning"])
        with open_log(run) as log:
            workshop = Workshop(Job(problem, Budget(QUICK, 2), 0, run, lambda name: on_progress, checkpoint_s=0.0), log)
            workshop.train("plan", "plan", "GridWorld")
            workshop.train("first", "q-learning", "GridWorld", choice=choice)
            workshop.train("second", "q-learning", "GridWorld", choice=choice)

    whole, cut = new_run(tmp_path / "whole"), new_run(tmp_path / "cut")
    train_both(whole)

    for crash_at in (10, 60, 20):  # in the first; in the second; in the second, of whose reports 30 are left
        with pytest.raises(Crash):
            train_both(cut, crash_at)
    train_both(cut)

    assert fingerprint(cut) == fingerprint(whole)
    # By hand: 2,400 steps each, on one count of the run.
    assert last_standing(cut.checkpoints) == Standing(
        2400, last_standing(cut.checkpoints).seconds, 4800, (cut.path / "metrics.jsonl").stat().st_size, True
    )


def test_checkpoints_wait_longer_where_they_take_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)

    def due_after(clock: Clock, took_s: float) -> float:
        nonlocal now
        assert clock.is_due
        with clock:
            now += took_s
        began = now
        while not clock.is_due:
            now += 0.25
        return now - began

    assert CHECKPOINT_SHARE == 0.01
    clock = Clock(10.0)
    assert due_after(clock, 0.0625) == 10.0  # by hand: 0.0625 s are 1 % of 6.25 s, less than the period
    assert due_after(clock, 0.5) == 50.0  # and 0.5 s are 1 % of 50 s
    assert due_after(Clock(0.0), 3.0) == 0.0  # at every opportunity


# ---- Death at every step of a save -------------------------------------------------------------

PATHS = ("rename", "replace", "mkdir", "rmdir", "unlink", "remove", "fsync", "truncate")


def die_at(point: int) -> Callable[[], int]:
    """From now on this process dies before its ``point``-th change of the disk, or in the middle of it; how many were.

    Every write counts twice: once it is not begun and once half of it is done.
    """
    count = itertools.count()
    seen = 0

    def passes() -> None:
        nonlocal seen
        seen = next(count)
        if seen == point:
            os._exit(9)

    def mortal(act: Callable[..., Any]) -> Callable[..., Any]:
        def dying(*args: Any, **kwargs: Any) -> Any:
            passes()
            return act(*args, **kwargs)

        return dying

    def writing(path: Path, content: Any, *args: Any, **kwargs: Any) -> Any:
        data = content.encode() if isinstance(content, str) else content
        passes()
        with path.open("wb") as file:
            file.write(data[: len(data) // 2])
            file.flush()
            passes()
            file.write(data[len(data) // 2 :])

    for name in PATHS:
        if hasattr(os, name):
            setattr(os, name, mortal(getattr(os, name)))
    Path.write_bytes = Path.write_text = writing  # type: ignore[method-assign]
    return lambda: seen


def in_a_child(work: Callable[[], None]) -> int:
    """Exit code of a process that does this: 0 when it gets to the end, 1 when it fails."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    try:
        work()
    except BaseException:
        os._exit(1)
    os._exit(0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that are made by fork")
def test_whatever_write_sync_or_rename_a_run_dies_at_it_goes_on_bit_for_bit(tmp_path: Path, reference: Any) -> None:
    """Three checkpoints are made, of which the third is the first to prune; each cut point is a process that dies."""
    expected, expected_rows = reference("q-learning")

    def begin(run: RunDirectory, point: int) -> None:
        die_at(point)
        # By hand: the first report follows three cuts.
        with contextlib.suppress(Crash):
            train(run, "q-learning", crash_at=1)

    died = 0
    for point in itertools.count(0, 1):
        run = new_run(tmp_path / f"run-{point}")
        code = in_a_child(lambda run=run, point=point: begin(run, point))  # type: ignore[misc]
        assert code in (0, 9)
        whole = load_checkpoint(run.checkpoints, "q-learning")
        assert whole is not None or not list(run.checkpoints.glob("step-*"))
        if code == 0:
            break
        died += 1
        # Going on from each of them costs time: every eleventh, which falls on every kind of point in turn.
        if point % 11 == 0:
            assert train(run, "q-learning", checkpoint_s=3600.0) == expected_rows
            own = fingerprint(run)
            assert own["metrics.jsonl"] == expected["metrics.jsonl"]
            final = "checkpoints/step-000000002400/"
            assert {n: own[n] for n in own if n.startswith(final)} == {
                n: expected[n] for n in expected if n.startswith(final)
            }
        shutil.rmtree(run.path)

    # By hand: a checkpoint is mkdir, 9 writes counted twice, 10 syncs, rename, and syncs of the folder and of the
    # metrics: 32. Three are 96, the first makes the folder, and the last prunes by rename, 9 unlinks and rmdir.
    assert died >= 3 * 32 + 1 + 11


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that are made by fork")
def test_a_death_while_an_old_checkpoint_is_pruned_does_not_stop_the_next_agent(tmp_path: Path) -> None:
    """Half a checkpoint is not to be taken for a damaged one of the agent that comes next."""
    problem = Problem.load(LAYOUT, "default", "default")
    planner = Planner.solve(problem.layout, problem.task, problem.reward)

    def prune(directory: Path, point: int) -> None:
        die_at(point)
        save_agent(planner, directory, 3, name="first")

    for point in itertools.count():
        directory = tmp_path / str(point)
        for step in (1, 2):
            save_agent(planner, directory, step, name="first")
        code = in_a_child(lambda d=directory, p=point: prune(d, p))  # type: ignore[misc]

        assert load_checkpoint(directory, "first") is not None
        assert load_checkpoint(directory, "second") is None
        clear_leftovers(directory)
        assert all(path.name.startswith("step-") for path in directory.iterdir())
        if code == 0:
            break


# ---- Other processes ---------------------------------------------------------------------------


def words(kind: str, run_dir: Path) -> list[str]:
    changes = [f"{name}={value}" for name, value in CHANGES[kind].items()]
    shared = ["--layout", LAYOUT, "--budget", "quick", "--checkpoint-s", "0", "--run-dir", str(run_dir)]
    return ["train", "--agent", kind, *shared, "--set", *changes]


@contextlib.contextmanager
def command(arguments: list[str]) -> Iterator[subprocess.Popen[str]]:
    """A running ``gridnav``; killed at the end if it still runs."""
    process = subprocess.Popen(
        [sys.executable, "-m", "gridnav.cli", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_for(what: Callable[[], object], process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 120
    while not what():
        assert process.poll() is None, f"it ended by itself: {process.communicate()[1]}"
        assert time.monotonic() < deadline, "it never came so far"
        time.sleep(0.001)


def newest(run_dir: Path) -> str:
    return max((path.name for path in run_dir.glob("checkpoints/step-*")), default="")


@pytest.mark.parametrize(("kind", "n_kills"), [("q-learning", 2), ("dqn", 1), ("ppo", 1)])
def test_a_killed_command_goes_on_bit_for_bit(kind: AgentKind, n_kills: int, tmp_path: Path, reference: Any) -> None:
    run_dir, dice = tmp_path / "run", random.Random(1)
    for kill in range(n_kills):
        # --resume begins from the beginning where nothing is there.
        with command([*words(kind, run_dir), "--resume"]) as process:
            before = newest(run_dir)
            wait_for(lambda before=before: newest(run_dir) > before, process)
            time.sleep(dice.uniform(0.0, 0.1))
            if kill % 2 == 0:
                wait_for(lambda: list(run_dir.glob("checkpoints/.tmp-*")), process)
                time.sleep(dice.uniform(0.0, 0.003))
            process.kill()
            assert process.wait() == -signal.SIGKILL
        whole = load_checkpoint(run_dir / "checkpoints", kind)
        assert whole is not None
        assert not whole.standing.is_finished

    run = RunDirectory.open(run_dir)
    if kind == "q-learning":
        assert run_cli("train", "--resume", "--run-dir", str(run_dir), "--checkpoint-s", "0") == 0
        rows = rows_of(json.loads(run.evaluation.read_text())["results"])
        assert not list(run_dir.rglob(".tmp-*"))
    else:  # figures and reports take seconds, and are the same for all
        clear_leftovers(run.checkpoints)
        rows = train(run, kind)
    expected, expected_rows = reference(kind)
    assert fingerprint(run) == expected
    assert rows == expected_rows


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_leaves_a_checkpoint_and_one_line(number: signal.Signals, tmp_path: Path, reference: Any) -> None:
    run_dir = tmp_path / "run"
    rarely = [*words("q-learning", run_dir), "--checkpoint-s", "3600"]
    longer = [*rarely[: rarely.index("--set")], *rarely[-2:], "--set", "num_envs=16", "visits=100000"]
    with command(longer) as process:
        metrics = run_dir / "metrics.jsonl"
        wait_for(lambda: metrics.is_file() and metrics.stat().st_size, process)
        process.send_signal(number)
        errors = process.communicate(timeout=60)[1]

    assert process.returncode == 130
    told = [line for line in errors.splitlines() if not line.startswith("training")]  # the progress bar
    assert told == ["gridnav: interrupted; --resume goes on from the run's last checkpoint"]
    whole = load_checkpoint(run_dir / "checkpoints", "q-learning")
    assert whole is not None
    # By hand: the first checkpoint is that of the beginning, and an hour has not passed: this one is the interrupt's.
    assert whole.training is not None
    assert whole.training.values["batch"] > 0
    assert whole.standing.log_bytes == metrics.stat().st_size


def test_an_interrupted_training_goes_on_bit_for_bit(tmp_path: Path, reference: Any) -> None:
    run = new_run(tmp_path / "run")

    def on_progress(progress: Progress) -> None:
        if progress.steps == 16 * 3 * 9:
            signal.raise_signal(signal.SIGTERM)

    problem, budget = Problem.load(LAYOUT, "default", "default"), Budget(QUICK, 50)
    with open_log(run) as log, pytest.raises(KeyboardInterrupt):
        Workshop(Job(problem, budget, 0, run, lambda name: on_progress, checkpoint_s=3600.0), log).train(
            "q-learning", "q-learning", "GridWorld", choice=Choice(changes=CHANGES["q-learning"])
        )
    whole = load_checkpoint(run.checkpoints, "q-learning")
    assert whole is not None
    assert whole.training is not None
    assert whole.training.values["batch"] == 3 * 9  # the step in which it came was finished

    assert train(run, "q-learning") == reference("q-learning")[1]
    assert fingerprint(run) == reference("q-learning")[0]


# ---- Whose run it is ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole run of the command line."""
    run_dir = tmp_path_factory.mktemp("finished") / "run"
    with contextlib.redirect_stderr(io.StringIO()):
        assert run_cli(*words("q-learning", run_dir)) == 0
    return run_dir


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("gridnav: ")
    assert len(line) <= 300
    return line


@pytest.mark.parametrize("extra", [["--resume"], []])
def test_a_second_process_is_refused_at_once_and_told_who_owns_the_run(
    extra: list[str], finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with RunDirectory.open(finished).own():
        began = time.monotonic()
        assert run_cli("train", "--run-dir", str(finished), *extra) == 3
        assert time.monotonic() - began < 1.0

    line = one_line(capsys)
    assert f"process {os.getpid()} on {socket.gethostname()}" in line
    assert "in use" in line


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that are made by fork")
def test_a_run_is_free_again_when_its_owner_was_killed(tmp_path: Path) -> None:
    run = new_run(tmp_path / "run")
    owns, tells = os.pipe()

    def own_forever() -> None:
        with run.own():
            os.write(tells, b"!")
            time.sleep(600)

    child = os.fork()
    if not child:
        try:
            own_forever()
        finally:
            os._exit(1)
    os.read(owns, 1)
    with pytest.raises(RunInUseError, match=f"in use by process {child} on"), run.own():
        pass
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)

    with run.own():
        pass


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that are made by fork")
def test_of_eight_that_start_at_once_in_one_directory_exactly_one_runs(tmp_path: Path) -> None:
    for race in range(6):
        path = tmp_path / f"race-{race}"
        gate, start = os.pipe()
        children = []
        for _ in range(8):
            child = os.fork()
            if not child:
                code = 1
                try:
                    os.close(start)
                    os.read(gate, 1)  # the end of the file, for all at once
                    with RunDirectory.create(path, "train", {"owner": os.getpid()}):
                        time.sleep(0.05)
                    code = 0
                except RunInUseError:
                    code = 3
                except InputError:
                    code = 2
                finally:
                    os._exit(code)
            children.append(child)
        os.close(gate)
        os.close(start)

        codes = {child: os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children}

        (owner,) = (child for child, code in codes.items() if code == 0)
        assert set(codes.values()) <= {0, 2, 3}
        assert json.loads((path / "config.json").read_text()) == {"owner": owner}


# ---- What --resume takes -----------------------------------------------------------------------


def contents(directory: Path) -> dict[str, bytes]:
    """Every file, but for those that say who owns the run."""
    files = (path for path in directory.rglob("*") if path.is_file() and path.name not in (".lock", ".owner"))
    return {str(path.relative_to(directory)): path.read_bytes() for path in files}


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["--seed", "7"], "--seed"),
        (["--layout", "classic"], "--layout"),
        (["--agent", "plan"], "--agent"),
        (["--set", "num_envs=16", "visits=99"], "--set"),
        (["--budget", "full"], "--budget"),
    ],
)
def test_flags_that_the_run_was_not_begun_with_are_refused(
    flags: list[str], named: str, finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(finished)

    assert run_cli("train", "--resume", "--run-dir", str(finished), *flags) == 2

    line = one_line(capsys)
    assert line.startswith(f"gridnav: {named} ")
    assert "begun with" in line
    assert contents(finished) == before


def test_resuming_needs_to_know_which_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli("train", "--resume") == 2

    assert "--run-dir" in one_line(capsys)
    assert list(Path.cwd().iterdir()) == []


def test_resuming_a_finished_run_changes_nothing_that_it_found(finished: Path, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(finished, run_dir)
    before = contents(finished)
    # Times, and what is drawn from them, are written anew.
    same = [n for n in before if n.startswith("checkpoints/") or n in ("metrics.jsonl", "config.json")]

    assert run_cli("train", "--resume", "--run-dir", str(run_dir)) == 0

    after = contents(run_dir)
    assert after.keys() - {n for n in after if "tfevents" in n} == before.keys() - {
        n for n in before if "tfevents" in n
    }
    assert {name: after[name] for name in same} == {name: before[name] for name in same}
    assert json.loads(after["evaluation.json"]) == json.loads(before["evaluation.json"])


def test_resuming_where_nothing_is_says_so_and_begins(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["train", "--agent", "plan", "--layout", LAYOUT, "--budget", "quick"]

    assert run_cli(*arguments, "--resume", "--run-dir", str(tmp_path / "run")) == 0

    assert "starting from the beginning" in capsys.readouterr().err
    assert (tmp_path / "run" / "evaluation.json").is_file()


def test_metrics_that_are_longer_are_cut_back_and_those_that_are_shorter_refused(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(finished, run_dir)
    metrics = run_dir / "metrics.jsonl"
    whole = metrics.read_bytes()

    metrics.write_bytes(whole + b'{"series": "q-learning", "steps": 9999, "half a ro')
    assert run_cli("train", "--resume", "--run-dir", str(run_dir)) == 0
    assert metrics.read_bytes() == whole

    metrics.write_bytes(whole[:-1])
    before = contents(run_dir)
    capsys.readouterr()
    assert run_cli("train", "--resume", "--run-dir", str(run_dir)) == 2
    assert "metrics.jsonl" in one_line(capsys)
    assert contents(run_dir) == before


def test_a_damaged_checkpoint_costs_its_interval_and_no_more(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], reference: Any
) -> None:
    """Falls back to the one before, says so in one line, and ends where it would have ended."""
    run_dir = tmp_path / "run"
    shutil.copytree(finished, run_dir)
    (run_dir / "checkpoints" / newest(run_dir) / "agent.safetensors").write_bytes(b"")

    assert run_cli("train", "--resume", "--run-dir", str(run_dir)) == 0

    found = load_checkpoint(run_dir / "checkpoints", "q-learning")
    assert found is not None
    assert found.standing.is_finished
    name = f"checkpoints/{newest(run_dir)}/agent.safetensors"
    own, expected = fingerprint(RunDirectory.open(run_dir)), reference("q-learning")[0]
    assert own[name] == expected["checkpoints/step-000000002400/agent.safetensors"]
    assert own["metrics.jsonl"] == expected["metrics.jsonl"]
    assert capsys.readouterr().err.count("damaged") <= 1
