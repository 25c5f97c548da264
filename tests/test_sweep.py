"""A sweep does each trial exactly once, however often it is killed, and says what went wrong in one line."""

from __future__ import annotations

import csv
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import run_cli
from joblib.externals.loky import get_reusable_executor

from gridnav.experiment.run_directory import RunDirectory, RunInUseError
from gridnav.experiment.sweeps.design import settings_of
from gridnav.experiment.sweeps.trials import trial
from gridnav.experiment.workers import WATCH_S, _end_with
from gridnav.problem.types import InputError

LAYOUT = "......\n.####.\n......\n.####.\n......"
SHORT = ("sweep", *["--agent", "q-learning", "--budget", "quick", "--set", "visits=1", "--layout"], LAYOUT)
ALONE = ("--jobs", "1", "--checkpoint-s", "0")
"""In this process, with a checkpoint at every opportunity."""
FEW = ("--grid", "seed=0,1,2", "set.visits=1,2")
"""Six trials; after a visit or two of each entry a table is not good yet, so that seeds differ."""
needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that are made by fork")


@pytest.fixture(autouse=True)
def _without_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that dies loses nothing it has written; only a power cut would."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "results.csv").open(encoding="utf-8", newline="") as file:
        return [*csv.DictReader(file)]


# ---- The design --------------------------------------------------------------------------------


def test_a_grid_is_every_combination_and_its_last_field_changes_fastest() -> None:
    settings = settings_of(["seed=0,1", "layout=classic,open"])

    # By hand: 2 x 2, the layout changing first.
    pairs = [("0", "classic"), ("0", "open"), ("1", "classic"), ("1", "open")]
    assert settings == [{"seed": seed, "layout": layout} for seed, layout in pairs]


def test_commas_inside_brackets_belong_to_a_value() -> None:
    assert settings_of(["set.hidden=[64,64],[128]"]) == [{"set.hidden": "[64,64]"}, {"set.hidden": "[128]"}]


def test_every_draw_meets_every_combination_of_the_grid() -> None:
    settings = settings_of(["seed=0,1,2"], ["set.gamma=uniform:0.5:1"], n_draws=4)

    # By hand: 4 draws x 3 seeds, the seeds of one draw together.
    assert [one["seed"] for one in settings] == ["0", "1", "2"] * 4
    gammas = [one["set.gamma"] for one in settings]
    assert gammas == [gamma for gamma in gammas[::3] for _ in range(3)]
    assert len(set(gammas)) == 4


def test_draws_follow_their_laws() -> None:
    laws = ["a=log:1e-4:1e-2", "b=uniform:-1:3", "c=int:2:4", "d=x,y"]

    settings = settings_of([], laws, n_draws=2000, seed=1)

    a, b, c = (np.array([float(one[name]) for one in settings]) for name in "abc")
    # By hand: half of the draws below the middle, which is 1e-3 for log and 1 for uniform; a third and a half of the
    # draws are a value of c and d. Four standard deviations of a share of 2000 are below 0.045.
    assert 1e-4 <= a.min() <= a.max() <= 1e-2
    assert abs(np.mean(a < 1e-3) - 0.5) < 0.045
    assert -1 <= b.min() <= b.max() <= 3
    assert abs(np.mean(b < 1) - 0.5) < 0.045
    assert {*c} == {2.0, 3.0, 4.0}
    assert abs(np.mean(c == 2) - 1 / 3) < 0.045
    assert abs(np.mean([one["d"] == "x" for one in settings]) - 0.5) < 0.045


def test_one_more_field_leaves_the_draws_of_the_others_as_they_were() -> None:
    alone = settings_of([], ["a=uniform:0:1"], n_draws=5, seed=3)
    both = settings_of([], ["a=uniform:0:1", "b=uniform:0:1"], n_draws=5, seed=3)

    assert [one["a"] for one in both] == [one["a"] for one in alone]
    assert all(one["a"] != one["b"] for one in both)
    assert settings_of([], ["a=uniform:0:1"], n_draws=5, seed=4) != alone


# ---- Bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], "--grid"),
        (["--grid", "sed=0,1"], "did you mean seed?"),
        (["--grid", "set.learning_rat=0.1"], "did you mean learning_rate?"),
        (["--grid", "sets.gamma=0.1"], "did you mean set.NAME?"),
        (["--grid", "run_dir=a,b"], "run_dir"),
        (["--grid", "seed"], "FIELD=VALUES"),
        (["--grid", "seed=1,,2"], "empty value"),
        (["--grid", "seed=1,1"], "twice"),
        (["--grid", "seed=0,1", "seed=2"], "twice"),
        (["--grid", "seed=0,one"], "one"),
        (["--grid", "seed=0,-1"], "-1"),
        (["--grid", "layout=classic,no-such-maze"], "no-such-maze"),
        (["--grid", "set.learning_rate=0.1,-0.1"], "learning_rate -0.1"),
        (["--grid", "agent=q-learning,ppo", "env=gridnav/GridWorld-v0"], "gridnav/GridWorld-v0"),
        (["--grid", "seed=" + ",".join(map(str, range(10_001)))], "10001"),
        (["--random", "set.gamma=log:0:1"], "above 0"),
        (["--random", "set.gamma=uniform:1:0"], "LOW below HIGH"),
        (["--random", "set.gamma=uniform:1"], "uniform:LOW:HIGH"),
        (["--random", "set.num_envs=int:1.5:3"], "whole numbers"),
        (["--random", "set.gamma=uniform:0:nan"], "uniform:LOW:HIGH"),
        (["--random", "set.gamma=uniform:0:1", "--n-trials", "0"], "--n-trials 0"),
        (["--grid", "seed=0,1", "--design-seed", "-1"], "--design-seed -1"),
        (["--grid", "seed=0,1", "--jobs", "0"], "--jobs 0"),
        (["--grid", "seed=0,1", "--backend", "ray"], "--backend ray"),
        (["--grid", "seed=0,1", "--backend", "slurm"], "slurm"),
        (["--grid", "seed=0,1", "--agnt", "ppo"], "--agnt"),
        (["--grid", "seed=0,1", "--live"], "--live"),
        (["--grid", "seed=0,1", "--trial", "ladder", "--layout", "random"], "one maze"),
        (["--grid", "seed=0,1", "--resume"], "--run-dir"),
    ],
)
def test_bad_input_gets_one_line_that_names_it_and_writes_nothing(
    words: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_cli("sweep", *words) == 2

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("gridnav: ")
    assert named in line
    assert len(line) < 300
    assert list(Path.cwd().iterdir()) == []


def files_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != ".owner"}


def test_a_sweep_of_another_config_is_refused_and_nothing_changes(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(*SHORT, *ALONE, "--grid", "seed=0,1", "--run-dir", "mine") == 0
    before = files_of(Path("mine"))
    capsys.readouterr()

    assert run_cli(*SHORT, *ALONE, "--grid", "seed=0,1,2", "--run-dir", "mine", "--resume") == 2
    assert run_cli(*SHORT, *ALONE, "--grid", "seed=0,1", "--set", "visits=2", "--run-dir", "mine", "--resume") == 2
    assert run_cli(*SHORT, *ALONE, "--grid", "seed=0,1", "--run-dir", "mine") == 2

    grid, hyper_parameters, again = capsys.readouterr().err.splitlines()
    assert "--grid" in grid
    assert "--set" in hyper_parameters
    assert "not empty" in again
    assert files_of(Path("mine")) == before


def test_a_trial_of_another_config_is_refused_and_nothing_changes(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(*SHORT, *ALONE, "--grid", "seed=0,1", "--run-dir", "mine") == 0
    config = Path("mine/trials/0001/config.json")
    config.write_text(json.dumps(json.loads(config.read_text()) | {"seed": 7}))
    before = files_of(Path("mine"))
    capsys.readouterr()

    assert run_cli("sweep", "--run-dir", "mine", "--resume", "--jobs", "1") == 2

    (line,) = capsys.readouterr().err.splitlines()
    assert "0001" in line
    assert files_of(Path("mine")) == before


# ---- Done exactly once -------------------------------------------------------------------------


def test_the_table_has_a_row_per_trial_in_the_order_of_the_design(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(*SHORT, *ALONE, *FEW, "--run-dir", "sweep") == 0

    rows = rows_of(Path("sweep"))
    assert [(row["trial"], row["seed"], row["set.visits"]) for row in rows] == [
        (str(number), str(number // 2), ("1", "2")[number % 2]) for number in range(6)
    ]
    assert {row["name"] for row in rows} == {"q-learning"}
    assert all(0 <= float(row["success_low"]) <= float(row["success"]) <= 1 for row in rows)
    assert "seconds" not in rows[0]
    assert "sweep/results.csv" in capsys.readouterr().out


def test_a_trial_is_the_run_that_its_command_makes_alone() -> None:
    alone = ["--agent", "q-learning", "--layout", LAYOUT, "--budget", "quick", "--seed", "1", "--set", "visits=3"]
    assert run_cli("train", *alone, "--run-dir", "alone") == 0

    assert run_cli(*SHORT, *ALONE, "--grid", "seed=1", "set.visits=3", "--run-dir", "sweep") == 0

    own, expected = (json.loads((Path(run) / "evaluation.json").read_text()) for run in ("sweep/trials/0000", "alone"))
    for evaluation in (own, expected):
        evaluation["results"]["q-learning"].pop("training_seconds")
    assert own == expected
    assert run_cli("evaluate", "sweep/trials/0000", "--episodes", "2") == 0
    assert run_cli("view", "sweep/trials/0000", "--save", "episode.rrd") == 0


def test_a_finished_sweep_is_not_done_again() -> None:
    assert run_cli(*SHORT, *ALONE, *FEW, "--run-dir", "sweep") == 0
    before = {path: path.stat().st_mtime_ns for path in Path("sweep/trials").rglob("*")}
    table = Path("sweep/results.csv").read_bytes()

    assert run_cli("sweep", "--resume", "--run-dir", "sweep", "--jobs", "1") == 0

    assert {path: path.stat().st_mtime_ns for path in Path("sweep/trials").rglob("*")} == before
    assert Path("sweep/results.csv").read_bytes() == table


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_a_trial_that_fails_is_a_row_with_its_error_and_the_sweep_goes_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(*SHORT, *ALONE, "--grid", "set.learning_rate=1e200,0.1", "set.visits=2", "--run-dir", "sweep") == 0

    failed, fine = rows_of(Path("sweep"))
    assert failed["error"].startswith("NonFiniteError: ")
    assert failed["success"] == ""
    assert fine["error"] == ""
    assert float(fine["success"]) > 0.9
    assert "1 of 2 trials failed, trial 0 of NonFiniteError" in capsys.readouterr().out


@needs_fork
def test_a_sweep_that_is_killed_again_and_again_fills_the_same_table() -> None:
    assert run_cli(*SHORT, *ALONE, *FEW, "--run-dir", "whole") == 0
    expected = Path("whole/results.csv").read_bytes()
    assert len({row["success"] for row in rows_of(Path("whole"))}) > 2  # or much could go wrong unseen
    killed = Path("killed")

    def newest() -> set[Path]:
        return {*killed.glob("trials/*/checkpoints/step-*")}

    # By hand: six trials; struck in the first checkpoints of trial 0, then of trial 2, then as trial 4 is done.
    moments: list[Callable[[], object]] = [
        newest,
        lambda: [path for path in newest() if "0002" in str(path)],
        lambda: (killed / "trials/0004/result.json").is_file(),
    ]
    for moment in moments:
        kill(lambda: run_cli(*SHORT, *ALONE, *FEW, "--run-dir", "killed", "--resume"), moment)
        if (killed / "results.csv").is_file():
            done = [row["trial"] for row in rows_of(killed)]
            assert done == [str(number) for number in range(len(done))]
            assert len(done) < 6

    assert run_cli(*SHORT, *ALONE, "--resume", "--run-dir", "killed") == 0
    assert (killed / "results.csv").read_bytes() == expected


def kill(work: Callable[[], object], moment: Callable[[], object]) -> None:
    """Do something in a process that is killed as soon as the moment has come."""
    child = os.fork()
    if not child:
        work()
        os._exit(0)
    deadline = time.monotonic() + 60
    while not moment():
        assert os.waitpid(child, os.WNOHANG) == (0, 0), "it ended before its kill"
        assert time.monotonic() < deadline
        time.sleep(0.0005)
    os.kill(child, signal.SIGKILL)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL, "it ended before its kill"


# ---- Workers -----------------------------------------------------------------------------------


def test_workers_fill_the_table_that_one_process_fills() -> None:
    shared = (*SHORT, *FEW)

    assert run_cli(*shared, "--jobs", "2", "--run-dir", "workers") == 0
    get_reusable_executor().shutdown()
    assert run_cli(*shared, "--jobs", "1", "--run-dir", "alone") == 0

    assert Path("workers/results.csv").read_bytes() == Path("alone/results.csv").read_bytes()


@needs_fork
def test_a_worker_ends_when_its_sweep_is_killed() -> None:
    def sweep() -> None:
        parent = os.getpid()
        worker = os.fork()
        if not worker:
            _end_with(parent)
            time.sleep(60)
            os._exit(0)
        Path(".worker").write_text(str(worker))
        Path(".worker").rename("worker")
        time.sleep(60)

    kill(sweep, Path("worker").is_file)

    worker = int(Path("worker").read_text())
    deadline = time.monotonic() + 20 * WATCH_S
    while is_running(worker):
        assert time.monotonic() < deadline, "the worker goes on alone"
        time.sleep(0.01)


def is_running(process: int) -> bool:
    """Whether it is there and no mere entry of the process table."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


@needs_fork
def test_a_trial_waits_for_the_worker_that_still_holds_its_folder(tmp_path: Path) -> None:
    config = {
        "command": "train", "agent": "q-learning", "layout": LAYOUT, "task": "default", "reward": "default",
        "budget": "quick", "seed": 0, "observation": "cell_goal", "preset": "", "set": ["visits=3"],
    }  # fmt: skip
    folder, ready = tmp_path / "trial", tmp_path / "ready"
    folder.mkdir()
    worker = os.fork()
    if not worker:
        with RunDirectory(folder).own():
            ready.touch()
            time.sleep(0.5)
        os._exit(0)
    while not ready.is_file():
        time.sleep(0.001)

    with pytest.raises(RunInUseError, match=f"process {worker}"), RunDirectory(folder).own():
        pass
    (row,) = trial(config, folder)

    assert os.waitpid(worker, 0)[1] == 0
    assert row["name"] == "q-learning"
    with pytest.raises(InputError, match="another config"):
        trial(config | {"seed": 1}, folder)
