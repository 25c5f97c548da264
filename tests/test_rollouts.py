"""Episodes on disk come back as they were, and damaged files are refused in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from gridnav.agents import Planner
from gridnav.experiment.evaluation import evaluate_in
from gridnav.experiment.policy_maps import policy_maps
from gridnav.experiment.rollouts import Rollouts, load_rollouts, names, save_rollouts
from gridnav.experiment.worlds import Problem
from gridnav.problem.types import InputError

PROBLEM = Problem.load("S...\n.#..\n...G", "default", "default")


@pytest.fixture(scope="module")
def rollouts() -> Rollouts:
    """Episodes of the plan driving the kinematic robot, so that there are scans, and what it makes of the maze."""
    planner = Planner.solve(PROBLEM.layout, PROBLEM.task, PROBLEM.reward)
    episodes = evaluate_in(PROBLEM, planner, "Unicycle", 5)
    maps = policy_maps(PROBLEM, planner, "GridWorld", [episodes[0].goal])
    return Rollouts("drive", "Unicycle", "plan", {PROBLEM.layout.name: PROBLEM.layout}, episodes, maps)


def test_what_is_kept_comes_back(rollouts: Rollouts, tmp_path: Path) -> None:
    save_rollouts(tmp_path, rollouts)
    back = load_rollouts(tmp_path, "drive")

    assert names(tmp_path) == ["drive"]
    assert (back.world, back.agent, len(back.episodes)) == ("Unicycle", "plan", 5)
    assert back.layout_of(0).to_text() == PROBLEM.layout.to_text()
    for one, other in zip(rollouts.episodes, back.episodes, strict=True):
        assert one.row() == other.row()
        assert one.trace is not None
        assert other.trace is not None
        np.testing.assert_array_equal(one.trace.poses, other.trace.poses)
        np.testing.assert_allclose(one.trace.time_s, other.trace.time_s, atol=1e-9)
        np.testing.assert_allclose(one.trace.actions, other.trace.actions, atol=1e-7)
        np.testing.assert_allclose(one.trace.scans_m, other.trace.scans_m, atol=0.002)
        np.testing.assert_array_equal(one.trace.hits, other.trace.hits)
        assert one.trace.reward_terms.keys() == other.trace.reward_terms.keys()
    goal = rollouts.episodes[0].goal
    np.testing.assert_allclose(back.maps[goal].values, rollouts.maps[goal].values, rtol=1e-6)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def shorten(path: Path) -> None:
    arrays = load_file(path)
    arrays["poses"] = arrays["poses"][:-1]
    save_file(arrays, path)


def negative(path: Path) -> None:
    arrays = load_file(path)
    arrays["steps"] = -arrays["steps"]
    save_file(arrays, path)


def other_layout(path: Path) -> None:
    values = json.loads(path.read_text())
    values["layouts"] = {"elsewhere": {"text": "S.G", "cell_size_m": 0.5}}
    path.write_text(json.dumps(values))


def unknown_field(path: Path) -> None:
    values = json.loads(path.read_text())
    values["rows"][0]["surprise"] = 1
    path.write_text(json.dumps(values))


def endless(path: Path) -> None:
    values = json.loads(path.read_text())
    values["step_s"][0] = 10**400
    path.write_text(json.dumps(values))


def in_a_wall(path: Path) -> None:
    values = json.loads(path.read_text())
    values["rows"][0]["goal"] = [1, 1]
    path.write_text(json.dumps(values))


def words(path: Path) -> None:
    values = json.loads(path.read_text())
    values["rows"][0]["episode_return"] = "much"
    path.write_text(json.dumps(values))


def not_a_number(path: Path) -> None:
    arrays = load_file(path)
    arrays["poses"][3, 0] = np.nan
    save_file(arrays, path)


def flat(path: Path) -> None:
    arrays = load_file(path)
    arrays["scans_m"] = arrays["scans_m"][:, 0].copy()
    save_file(arrays, path)


@pytest.mark.parametrize(
    ("part", "damage"),
    [
        ("drive.safetensors", not_a_number),
        ("drive.safetensors", flat),
        ("drive.json", endless),
        ("drive.json", in_a_wall),
        ("drive.json", words),
        ("drive.safetensors", cut),
        ("drive.safetensors", shorten),
        ("drive.safetensors", negative),
        ("drive.json", cut),
        ("drive.json", other_layout),
        ("drive.json", unknown_field),
    ],
)
def test_damaged_rollouts_are_refused_in_one_line(
    part: str, damage: Callable[[Path], None], rollouts: Rollouts, tmp_path: Path
) -> None:
    save_rollouts(tmp_path, rollouts)
    damage(tmp_path / part)
    with pytest.raises(InputError, match="are damaged") as caught:
        load_rollouts(tmp_path, "drive")
    assert "\n" not in str(caught.value)


def test_a_name_that_is_not_there_is_answered_with_those_that_are(rollouts: Rollouts, tmp_path: Path) -> None:
    save_rollouts(tmp_path, rollouts)
    with pytest.raises(InputError, match="there are drive"):
        load_rollouts(tmp_path, "dive")
