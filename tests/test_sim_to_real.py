"""What policies keep of their success in held-out worlds: the numbers, the command, the log of the sealed one."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import run_cli
from test_studies import summary

from gridnav.agents import Planner, Progress
from gridnav.experiment import sim_to_real
from gridnav.experiment.checkpoint import save_agent
from gridnav.experiment.rollouts import load_rollouts, names
from gridnav.experiment.run_directory import RunDirectory, write_json
from gridnav.experiment.sim_to_real import SEALED_LOG, Gap, conclusion, correlation, measure, measure_once
from gridnav.experiment.training import unseen
from gridnav.experiment.worlds import Problem

CORRIDOR = "S..G\n"


def plan_run(path: Path, corridor: str = CORRIDOR) -> Path:
    """A run whose one agent is a plan that drives the robot."""
    problem = Problem.load(corridor, "default", "default")
    plan = Planner.solve(problem.layout, problem.task, problem.reward)
    config = {"command": "train", "layout": corridor, "task": "default", "reward": "default", "seed": 0}
    row = {"world": "DiffDrive", "agent": "plan", "carried": "", "checkpoint": "plan", "observation": "cell_goal"}
    with RunDirectory.create(path, "plan", config) as run:
        save_agent(plan, run.checkpoints, 0, name="plan")
        write_json(run.evaluation, {"results": {"plan": row | {"training_steps": 0, "training_seconds": 0.0}}})
    return path


def test_correlation_of_success_by_hand() -> None:
    # By hand: deviations from the means 0.5 and 0.6 are (-0.5, 0, 0.5) and (-0.4, 0.2, 0.2), so the correlation is
    # (0.2 + 0.1) / sqrt(0.5 * 0.24) = 0.866; of the ranks (1, 2, 3) and (1, 2.5, 2.5) 1.5 / sqrt(2 * 1.5) = 0.866.
    found = correlation(np.array([[0.0, 0.2], [0.5, 0.8], [1.0, 0.8]]))

    assert found.n_policies == 3
    assert found.pearson == pytest.approx(0.3 / np.sqrt(0.12))
    assert found.spearman == pytest.approx(1.5 / np.sqrt(3.0))
    assert found.pearson_interval[0] <= found.pearson <= found.pearson_interval[1] + 1e-9


def test_policies_that_are_equal_at_home_foretell_nothing() -> None:
    found = correlation(np.array([[1.0, 0.2], [1.0, 0.8], [1.0, 0.5]]))

    assert np.isnan(found.pearson)
    assert np.isnan(found.pearson_interval).all()


def test_the_conclusion_says_so_instead_of_a_number_that_is_none() -> None:
    gaps = [Gap(name, summary(1.0), {"mars": summary(there)}) for name, there in (("one", 0.25), ("other", 0.5))]

    assert conclusion(gaps).endswith("all 2 policies do equally well at one of the places, so nothing correlates.")


def test_what_was_kept_has_an_interval_where_everything_arrived() -> None:
    share, low, high = Gap("one", summary(1.0), {"mars": summary(1.0)}).retention("mars")

    # By hand: after 200 of 200, Jeffreys' posterior of the success lies above 0.9876 with 97.5 %.
    assert share == 1.0
    assert 0.97 < low < 0.99 < 1.0 < high < 1.03


def test_nobody_looks_at_the_sealed_reality_before_all_runs_are_known_to_be_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, half = plan_run(tmp_path / "whole"), plan_run(tmp_path / "half")
    (half / "evaluation.json").unlink()

    assert run_cli("evaluate", str(whole), str(half), "--reality", "test", "--episodes", "2") == 2

    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (whole / SEALED_LOG).exists()


def test_two_runs_of_one_name_would_be_one_policy_and_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other").mkdir()
    runs = [str(plan_run(folder / "plan")) for folder in (tmp_path, tmp_path / "other")]

    assert run_cli("evaluate", *runs, "--reality", "structural", "--episodes", "2") == 2

    assert "two of the runs are called 'plan'" in capsys.readouterr().err


def test_evaluate_writes_nothing_where_one_of_its_files_is_not_possible(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("evaluate", str(plan_run(tmp_path / "plan")), "--episodes", "2")
    out, figure = tmp_path / "out.json", tmp_path / "curves.png"

    assert run_cli(*asked, "--output", str(out), "--figure", str(figure)) == 2  # a plan has no curve
    assert run_cli(*asked, "--output", str(tmp_path)) == 2
    assert run_cli(*asked, "--output", ".") == 2

    assert len(capsys.readouterr().err.strip().splitlines()) >= 3
    assert [path.name for path in tmp_path.iterdir()] == ["plan"]


def test_evaluate_reality_measures_reports_keeps_and_counts(tmp_path: Path) -> None:
    run, page, kept = plan_run(tmp_path / "plan"), tmp_path / "gap.html", tmp_path / "kept"
    asked = ("evaluate", str(run), "--reality", "structural", "test", "--episodes", "4")

    code = run_cli(*asked, "--output", str(tmp_path / "gap.json"), "--report", str(page), "--keep", str(kept))

    assert code == 0
    found = json.loads((tmp_path / "gap.json").read_text())["policies"]["plan"]
    assert found["home"]["success_rate"] == 1.0
    assert set(found) == {"home", "structural", "test", "retention"}
    assert found["retention"]["structural"][0] == found["structural"]["success_rate"]
    assert "All realities are simulations" in page.read_text()
    # The sealed one is logged, and its episodes are nowhere.
    assert names(kept / "rollouts") == ["plan-structural"]
    assert len(load_rollouts(kept / "rollouts", "plan-structural").episodes) == 4
    assert len((run / SEALED_LOG).read_text().splitlines()) == 1
    assert run_cli("view", str(kept), "--save", str(tmp_path / "kept.rrd")) == 0


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--keep", "kept"), "--report and --keep go with --reality"),
        (("--reality", "structural", "--seed", "3"), "do not go with --reality"),
        (("--reality", "moon"), "moon"),
        (("--reality", "test", "--keep", "kept"), "no episode of the test reality is shown"),
    ],
)
def test_what_does_not_go_together_is_one_line(
    flags: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = plan_run(tmp_path / "plan")

    assert run_cli("evaluate", str(run), *flags) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_episodes_of_two_mazes_cannot_be_kept_together_and_nothing_is_measured_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = plan_run(tmp_path / "one"), plan_run(tmp_path / "other", "G..S\n")
    monkeypatch.setattr(sim_to_real, "measure", lambda *_, **__: pytest.fail("it was measured"))

    assert run_cli("evaluate", *map(str, runs), "--reality", "structural", "--keep", str(tmp_path / "kept")) == 2
    assert "--keep takes runs of one maze" in capsys.readouterr().err
    assert not (tmp_path / "kept").exists()


def test_runs_measured_in_workers_have_the_numbers_they_have_alone_and_are_measured_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = {name: RunDirectory.open(plan_run(tmp_path / name)) for name in ("one", "other")}
    told = []

    def on_stage(name: str) -> Callable[[Progress], None]:
        return lambda progress: told.append(progress.steps)

    found = measure_once(runs, ["parametric"], 2, on_stage, jobs=2)

    (alone,) = measure([runs["one"]], ["parametric"], 2, unseen)
    for name, gap in found.items():
        assert (gap.policy, gap.at_home, gap.away) == (name, alone.at_home, alone.away)
    assert told == [1, 2]
    monkeypatch.setattr(sim_to_real, "in_workers", lambda *_: pytest.fail("it was measured again") if _[1] else ())
    assert measure_once(runs, ["parametric"], 2, on_stage, jobs=2).keys() == runs.keys()
