"""What transfer saved: numbers worked out by hand, and the report of runs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from gridnav.experiment.run_directory import RunDirectory
from gridnav.experiment.transfer import transfer_report, write_transfer, write_transfer_page
from gridnav.problem.transfer import Curve, Learnt, area, asymptote, jumpstart, steps_to, transfer
from gridnav.problem.types import InputError


def curve(*points: tuple[float, float]) -> Curve:
    steps, success = np.array(points, dtype=np.float64).T
    return steps, success


SLOW = curve((0, 0.0), (50, 0.5), (100, 1.0))
QUICK = curve((0, 0.8), (10, 1.0), (100, 1.0))


def learnt(one: Curve, *, source_steps: float = 0.0) -> Learnt:
    return Learnt(one, seconds_per_step=0.5, source_steps=source_steps, source_seconds=source_steps / 10)


def test_the_numbers_of_a_curve_are_those_of_a_sketch() -> None:
    assert jumpstart(QUICK) == 0.8
    # By hand: a straight line from 0 to 1 has area 1/2, and its last quarter is around 0.875.
    assert area(SLOW, 100) == pytest.approx(0.5)
    assert asymptote(SLOW, 100) == pytest.approx(0.875)
    # 10 steps around 0.9 and 90 of 1: (9 + 90) / 100.
    assert area(QUICK, 100) == pytest.approx(0.99)


def test_what_was_measured_last_holds_until_the_horizon() -> None:
    # By hand: 50 steps around 0.5 and 150 of 1: (25 + 150) / 200.
    assert area(curve((0, 0.0), (50, 1.0)), 200) == pytest.approx(0.875)
    # And what lies beyond it does not count: up to 50 the slow curve is around 0.25.
    assert area(SLOW, 50) == pytest.approx(0.25)


def test_a_threshold_is_reached_for_good_or_not_yet() -> None:
    lucky = curve((0, 0.0), (10, 0.96), (20, 0.3), (60, 0.97), (100, 0.96))
    # By hand: of the ten steps from 10 on the mean is (0.96 + 0.3) / 2; those from 60 on lie between 0.97 and 0.96.
    assert steps_to(lucky, 100) == 60
    assert steps_to(curve((0, 0.95), (100, 0.95)), 100) == 0
    assert steps_to(curve((0, 0.0), (90, 0.94), (100, 0.95)), 100) == 100
    assert steps_to(SLOW, 100, threshold=0.4) == 50
    assert steps_to(curve((0, 0.0), (100, 0.9)), 100) == math.inf


def test_an_arm_is_measured_against_scratch() -> None:
    saved = transfer([learnt(QUICK, source_steps=30)], [learnt(SLOW)], 100)

    assert (saved.n_seeds, saved.n_reached) == (1, 1)
    assert saved.jumpstart.value == pytest.approx(0.8)
    # By hand: 10 steps against 100; with the source 40; half a second each, and 3 s for the source.
    assert saved.steps.value == 10
    assert saved.steps_ratio is not None
    assert saved.steps_ratio.value == pytest.approx(0.1)
    assert saved.total_steps.value == 40
    assert (saved.seconds.value, saved.total_seconds.value) == (5.0, 8.0)
    # (0.99 - 0.5) / 0.5, and 1 against 0.875.
    assert saved.ratio is not None
    assert saved.ratio.value == pytest.approx(0.98)
    assert saved.gain.value == pytest.approx(0.125)
    assert saved.negative == ()


def test_one_seed_says_nothing_of_negative_transfer() -> None:
    """It has no interval that could lie on the wrong side."""
    assert transfer([learnt(SLOW)], [learnt(QUICK)] * 2, 100).negative == ()
    assert transfer([learnt(SLOW)] * 2, [learnt(QUICK)], 100).negative == ()


def test_negative_transfer_is_named() -> None:
    harmed = transfer([learnt(SLOW)] * 2, [learnt(QUICK)] * 2, 100)

    assert harmed.negative == ("an asymptote 12 points lower", "10.0 times the steps", "an area 49 % smaller")


def test_harm_that_the_seeds_do_not_show_is_not_named() -> None:
    """Three of six seeds are worse and three better: that may be chance."""
    mixed = [learnt(QUICK)] * 3 + [learnt(SLOW)] * 3
    other = [learnt(QUICK), learnt(SLOW)] * 3

    assert transfer(mixed, other, 100).negative == ()


def test_a_seed_that_never_gets_there_counts_with_all_its_steps_and_is_said() -> None:
    never = curve((0, 0.0), (100, 0.9))

    saved = transfer([learnt(QUICK), learnt(never)], [learnt(SLOW), learnt(SLOW)], 100)

    # By hand: (10 + 100) / 2, two seeds being too few to leave any out.
    assert saved.steps.value == 55
    assert (saved.n_reached, saved.n_seeds) == (1, 2)
    assert saved.steps.low < 55 < saved.steps.high


def test_there_is_no_ratio_to_nothing() -> None:
    at_once = curve((0, 1.0), (100, 1.0))
    assert transfer([learnt(at_once)], [learnt(at_once)], 100).steps_ratio is None
    hopeless = curve((0, 0.0), (100, 0.0))
    assert transfer([learnt(QUICK)], [learnt(hopeless)], 100).ratio is None


# ---- The report --------------------------------------------------------------------------------------


def finished_run(path: Path, seed: int, arms: dict[str, Curve], **config: str) -> RunDirectory:
    """A run of arms as ``gridnav ladder --arms`` leaves it, with curves that are made up."""
    with RunDirectory.create(path, "ladder", {"seed": seed, "layout": "classic", "task": "default", **config}) as run:
        pass
    rows = [
        {"series": name, "steps": step, "greedy_success_rate": success}
        for name, points in arms.items()
        for step, success in zip(*points, strict=True)
    ]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    cost = {"world": "DiffDrive", "steps": 100, "seconds": 50.0, "source_steps": 7, "source_seconds": 1.0}
    still = cost | {"steps": 0, "seconds": 0.0}
    costs = {name: still if name == "waypoint" else cost for name in arms}
    run.evaluation.write_text(json.dumps({"results": {}, "arms": costs}))
    return run


def test_the_report_of_several_seeds_says_what_the_curves_show(tmp_path: Path) -> None:
    arms = {"scratch": SLOW, "clone": QUICK, "waypoint": curve((0, 0.9))}
    runs = [finished_run(tmp_path / str(seed), seed, arms) for seed in (3, 5)]

    report = transfer_report(runs)

    assert report.seeds == (3, 5)
    assert report.best == "clone"
    assert list(report.arms) == ["scratch", "waypoint", "clone"]
    # What does not learn stays as it is, so its area is that of a constant.
    assert report.arms["waypoint"].asymptote.value == pytest.approx(0.9)
    assert "On DiffDrive, classic, 2 seeds" in report.sentence
    assert "clone, the quickest arm, 10 steps, 0.10 of them" in report.sentence
    assert [row[0] for row in report.table.rows] == list(report.arms)
    write_transfer(tmp_path, report)
    write_transfer_page(tmp_path / "report.html", report, command="gridnav", config={})
    assert json.loads((tmp_path / "transfer.json").read_text())["arms"]["clone"]["n_seeds"] == 2
    assert (tmp_path / "transfer.png").stat().st_size > 1000
    page = (tmp_path / "report.html").read_text()
    assert "What transfer saved" in page
    assert "The rungs" not in page


def test_runs_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    first = finished_run(tmp_path / "a", 1, {"scratch": SLOW})
    with pytest.raises(InputError, match="same seed"):
        transfer_report([first, finished_run(tmp_path / "b", 1, {"scratch": SLOW})])
    with pytest.raises(InputError, match="more than its seed: task"):
        transfer_report([first, finished_run(tmp_path / "c", 2, {"scratch": SLOW}, task="any")])
    with pytest.raises(InputError, match="add it to --arms"):
        transfer_report([finished_run(tmp_path / "d", 3, {"clone": QUICK})])
    with pytest.raises(InputError, match="at least one run"):
        transfer_report([])


def test_a_run_without_arms_is_refused(tmp_path: Path) -> None:
    run = finished_run(tmp_path / "a", 1, {"scratch": SLOW})
    run.evaluation.write_text('{"results": {}}')
    with pytest.raises(InputError, match="has no arms to compare"):
        transfer_report([run])
