"""Evaluation, training and the ladder on the real worlds, small."""

import json
from pathlib import Path

import numpy as np
import pytest

from gridnav.agents import Planner
from gridnav.experiment.evaluation import evaluate, policy_for
from gridnav.experiment.ladder import climb
from gridnav.experiment.robot_lint import lint_robot
from gridnav.experiment.run_directory import MetricsLog, RunDirectory
from gridnav.experiment.training import Budget, Job, unseen
from gridnav.experiment.worlds import Problem, make_worlds
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import summarise
from gridnav.problem.reward import Reward, Transition
from gridnav.problem.task import Task
from gridnav.problem.types import FloatArray, InputError

PROBLEM = Problem.load("classic", "default", "default")


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner.solve(PROBLEM.layout, PROBLEM.task, PROBLEM.reward)


@pytest.mark.parametrize("world", ["GridWorld", "Unicycle", "DiffDrive"])
def test_a_plan_of_the_grid_reaches_every_goal_in_every_world_without_a_collision(world: str, planner: Planner) -> None:
    worlds = make_worlds(world, 50)

    summary = summarise(evaluate(policy_for(planner, worlds), worlds))

    assert summary.success_rate == 1.0
    assert summary.collision_rate == 0.0


def test_the_worlds_are_asked_the_same_episodes(planner: Planner) -> None:
    asked = []
    for world in ("GridWorld", "Unicycle", "DiffDrive"):
        worlds = make_worlds(world, 10, max_episode_steps=1)
        asked.append([(e.start, e.goal) for e in evaluate(policy_for(planner, worlds), worlds)])

    assert asked[0] == asked[1] == asked[2]


def test_a_record_says_what_its_trace_shows(planner: Planner) -> None:
    worlds = make_worlds("DiffDrive", 3)
    for episode in evaluate(policy_for(planner, worlds), worlds):
        trace = episode.trace
        assert trace is not None
        assert len(trace.poses) == len(trace.scans_m) == len(trace.time_s) == episode.steps + 1
        assert len(trace.actions) == len(trace.hits) == episode.steps
        assert trace.time_s[-1] == pytest.approx(episode.elapsed_s)
        assert np.hypot(*np.diff(trace.poses[:, :2], axis=0).T).sum() == pytest.approx(episode.path_length_m, rel=0.01)
        assert sum(terms.sum() for terms in trace.reward_terms.values()) == pytest.approx(episode.episode_return)
        # The last state is the arrival, not the start of the next episode.
        goal = worlds.layout.to_metres(np.array(episode.goal))
        assert np.hypot(*(trace.poses[-1, :2] - goal)) <= worlds.task.goal_radius_m
        assert episode.path_length_m >= episode.shortest_path_m - worlds.task.goal_radius_m


def test_an_evaluation_is_the_same_every_time(planner: Planner) -> None:
    worlds = make_worlds("DiffDrive", 4)
    first, second = (evaluate(policy_for(planner, worlds), worlds) for _ in range(2))

    assert first == second


def test_scripted_robots_earn_less_than_arriving_under_the_default_reward() -> None:
    assert all(finding.is_sane for finding in lint_robot(Reward(), Layout.load("classic"), Task()))


class _PaidForTurning(Reward):
    """Rotation mistaken for progress: the step in place of what moves nothing earns a little."""

    def terms(self, step: Transition) -> dict[str, FloatArray]:
        terms = super().terms(step)
        return terms | {"time": np.where(step.travelled < 0.01, 0.5, -0.2) * step.duration}


def test_a_reward_that_pays_for_spinning_is_found_out() -> None:
    findings = lint_robot(_PaidForTurning(), Layout.load("classic"), Task())

    assert {f.behaviour for f in findings if not f.is_sane} >= {"spinning in place", "standing still"}


def test_the_ladder_climbs_and_writes_everything(tmp_path: Path) -> None:
    # By hand: 4,096 of PPO's 800,000 steps, one rollout.
    budget = Budget(share=4_096 / 800_000, episodes=4)

    with RunDirectory.create(tmp_path / "run", "ladder", {"command": "ladder"}) as run:
        results = climb(Job(PROBLEM, budget, 0, run, unseen, {"seed": 0}, "gridnav ladder"))

    by_name = {result.name: result.summary.success_rate for result in results}
    assert list(by_name)[:4] == ["plan", "q-learning", "q-table-unicycle", "q-table-diffdrive"]
    assert by_name["q-table-diffdrive"] == 1.0
    stored = json.loads(run.evaluation.read_text())["results"]
    assert {name: row["success_rate"] for name, row in stored.items()} == by_name
    # Each trained agent has a checkpoint; what is carried over has none of its own.
    manifests = [json.loads(path.read_text()) for path in run.checkpoints.glob("step-*/manifest.json")]
    assert {m["name"] for m in manifests} == {"plan", "q-learning", "ppo-unicycle", "ppo-scratch", "ppo-warm"}
    page = run.report.read_text()
    assert "100.0 %" in page
    assert all(name in page for name in by_name)


def test_metrics_go_to_both_files_and_leave_out_what_is_not_a_number(tmp_path: Path) -> None:
    with RunDirectory.create(tmp_path / "run", "train", {}) as run, MetricsLog(run) as log:
        log.add("ppo", 10, {"success_rate": float("nan"), "episodes": 0.0, "loss": float("inf")})
        log.add("ppo", 20, {"success_rate": 0.5, "episodes": 2.0})
        assert log.curve("ppo", "success_rate") == ([20], [0.5])

    rows = [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]
    assert rows == [
        {"series": "ppo", "steps": 10, "episodes": 0.0},
        {"series": "ppo", "steps": 20, "success_rate": 0.5, "episodes": 2.0},
    ]
    (events,) = run.path.glob("events.out.tfevents.*")
    assert b"ppo/success_rate" in events.read_bytes()


def test_continued_metrics_are_cut_back_and_told_again_to_tensorboard(tmp_path: Path) -> None:
    with RunDirectory.create(tmp_path / "run", "train", {}) as run:
        with MetricsLog(run) as log:
            log.add("ppo", 10, {"success_rate": 0.25})
            kept = log.sync()
            log.add("ppo", 20, {"lost": 0.5})
        with MetricsLog(run, kept) as log:
            assert log.curve("ppo", "success_rate") == ([10], [0.25])
            log.add("ppo", 20, {"success_rate": 0.75})

    rows = [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]
    assert rows == [
        {"series": "ppo", "steps": 10, "success_rate": 0.25},
        {"series": "ppo", "steps": 20, "success_rate": 0.75},
    ]
    (events,) = run.path.glob("events.out.tfevents.*")
    assert events.read_bytes().count(b"ppo/success_rate") == 2
    assert b"ppo/lost" not in events.read_bytes()


@pytest.mark.parametrize("content", [b"", b'{"series": "a", "steps": 1}', b"[1]\n" * 9, b"x" * 36, b"[" * 36])
def test_metrics_that_do_not_fit_the_checkpoint_are_refused_and_left_as_they_are(
    tmp_path: Path, content: bytes
) -> None:
    with RunDirectory.create(tmp_path / "run", "train", {}) as run:
        (run.path / "metrics.jsonl").write_bytes(content + b"more than that")
        with pytest.raises(InputError, match=r"metrics\.jsonl"):
            MetricsLog(run, 36 if len(content) == 36 else 60)

    assert (run.path / "metrics.jsonl").read_bytes() == content + b"more than that"


def test_robots_whose_episode_is_over_are_parked_and_no_number_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    worlds = PROBLEM.worlds("DiffDrive", 4)
    plan = Planner.solve(PROBLEM.layout, PROBLEM.task, PROBLEM.reward)
    parked: list[list[bool]] = []
    park = worlds.park
    monkeypatch.setattr(worlds, "park", lambda who: (parked.append(who.tolist()), park(who)))

    sparing = [episode.row() for episode in evaluate(policy_for(plan, worlds), worlds)]

    assert [sum(who) for who in parked] == [1, 2, 3, 4, 0]  # one after the other, and all may go in the end
    monkeypatch.setattr(worlds, "park", lambda who: None)
    assert sparing == [episode.row() for episode in evaluate(policy_for(plan, worlds), worlds)]
