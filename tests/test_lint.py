"""The lint passes what is sane, and finds and names what is not."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest

from gridnav import Layout, Reward, Task
from gridnav.problem.lint import Finding, lint_crashing, lint_grid, lint_idling
from gridnav.problem.reward import Transition
from gridnav.problem.types import FloatArray, InputError

CLASSIC = Layout.load("classic")
CORRIDOR = Layout.from_text("S..G\n")
NOTHING = Reward(goal=10.0, collision_cost=0.0, distance_cost=0.0, time_cost=0.0, progress=0.0, gamma=0.99)


@dataclass(frozen=True)
class ClosenessBonus(Reward):
    """The tutorial's mistake in its pure form: every step pays for being near, ``bonus`` at the goal itself."""

    bonus: float = 0.1

    def terms(self, step: Transition) -> dict[str, FloatArray]:
        return super().terms(step) | {"progress": self.bonus * (1 - step.next_distance / 18) * step.duration}


@dataclass(frozen=True)
class ApproachBonus(Reward):
    """Pays for every approach and takes nothing for going away again."""

    def terms(self, step: Transition) -> dict[str, FloatArray]:
        return super().terms(step) | {"progress": 1.0 * (step.next_distance < step.distance)}


def loop_cells(finding: Finding) -> list[tuple[int, int]]:
    """The cells that a finding names."""
    cells = re.findall(r"\((\d+), (\d+)\)", finding.behaviour)
    return [(int(row), int(col)) for row, col in cells]


# ---- What is sane ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["default", "seed"])
def test_the_presets_are_sane_on_classic(name: str) -> None:
    reward = Reward.preset(name)

    assert lint_grid(reward, CLASSIC, Task()).is_sane
    assert lint_idling(reward, CLASSIC, Task()).is_sane
    assert lint_crashing(reward, CLASSIC, Task()) is None


def test_the_fragile_preset_is_sane_where_a_collision_ends_the_episode() -> None:
    reward, task = Reward.preset("fragile"), Task.load("fragile")
    for layout in (CLASSIC, Layout.load("u-trap"), Layout.load("corridors")):
        crashing = lint_crashing(reward, layout, task)
        assert crashing is not None
        assert crashing.is_sane
        assert lint_grid(reward, layout, task).is_sane
        assert lint_idling(reward, layout, task).is_sane


# ---- Loops -------------------------------------------------------------------------------------


def test_the_returns_that_are_compared() -> None:
    # By hand: a move costs 1, the goal pays 10, gamma 0.5. Avoiding: -1 / (1 - 0.5) = -2 from every cell. Reaching it
    # from 3 cells away, where avoiding does best: -1 - 0.5 + 0.25 * (10 - 1) = 0.75.
    finding = lint_grid(replace(NOTHING, time_cost=1.0), CORRIDOR, Task(), gamma=0.5)

    assert finding.avoiding_return == pytest.approx(-2.0)
    assert finding.reaching_return == pytest.approx(0.75)
    assert (finding.start, finding.goal) == ((0, 0), (0, 3))
    assert finding.is_sane
    assert str(finding).startswith("ok   GridWorld: ")


def test_the_start_and_goal_where_avoiding_does_best_are_found() -> None:
    # By hand: from far away the goal's 10 are worth little, so the margin is smallest for the farthest pair.
    layout = Layout.from_text("SSS...GG\n")

    finding = lint_grid(replace(NOTHING, time_cost=0.01), layout, Task())

    assert (finding.start, finding.goal) == ((0, 0), (0, 7))


@pytest.mark.parametrize(("gamma", "is_sane"), [(0.99, True), (0.999, False)])
def test_a_bonus_for_being_near_is_found_when_the_discount_is_close_to_one(gamma: float, is_sane: bool) -> None:
    # By hand, one cell off the goal forever: 0.1 * 17/18 / (1 - gamma) is 9.44 at 0.99 and 94.4 at 0.999; the goal
    # pays 10.
    reward = ClosenessBonus(**vars(NOTHING) | {"gamma": gamma})

    finding = lint_grid(reward, CORRIDOR, Task())

    assert finding.is_sane == is_sane
    assert str(finding).startswith("ok  " if is_sane else "FAIL")


def test_the_loop_that_lives_off_a_bonus_is_named() -> None:
    # By hand, gamma 0.99, bonus 1: next to the goal 17/18 a step forever, 94.4, and less on the way there; the goal
    # ends it with 10 + 1.
    finding = lint_grid(ClosenessBonus(**vars(NOTHING) | {"bonus": 1.0}), CORRIDOR, Task())

    assert not finding.is_sane
    assert loop_cells(finding) == [(0, 2)], "the cell beside the goal, where bumping keeps the robot near"
    assert "bumping at cell (0, 2) forever" in str(finding)
    assert "from (0, 0), goal (0, 3)" in str(finding)
    # 16/18 and then 17/18 forever, from the second step on: 0.8889 + 0.99 * 94.444 = 94.389.
    assert finding.avoiding_return == pytest.approx(94.389, abs=1e-3)
    assert finding.reaching_return <= finding.avoiding_return


def test_a_loop_that_pays_for_each_approach_is_named() -> None:
    finding = lint_grid(ApproachBonus(**vars(NOTHING)), CLASSIC, Task())

    cells = loop_cells(finding)
    assert not finding.is_sane
    assert finding.behaviour.startswith("looping over cells")
    assert len(cells) == 2
    assert abs(cells[0][0] - cells[1][0]) + abs(cells[0][1] - cells[1][1]) == 1, "one forward and one back"


def test_a_wage_for_driving_is_found_as_a_loop() -> None:
    # By hand: 1 per cell driven, gamma 0.99: 100 forever, the goal 10.
    finding = lint_grid(replace(NOTHING, distance_cost=-1.0), CORRIDOR, Task())

    assert not finding.is_sane
    assert finding.behaviour.startswith("looping over cells")
    assert finding.avoiding_return == pytest.approx(100.0)


def test_a_collision_that_pays_is_found() -> None:
    # By hand: 5 per bump, gamma 0.9: 50 forever; ending the episode with it, 5 at once against 10 * 0.9**2 = 8.1.
    reward = replace(NOTHING, collision_cost=-5.0, gamma=0.9)

    forever = lint_grid(reward, CORRIDOR, Task())
    assert not forever.is_sane
    assert forever.behaviour.startswith("bumping at cell")
    assert forever.avoiding_return == pytest.approx(50.0)

    once = lint_grid(reward, CORRIDOR, Task(on_collision="end"))
    assert once.is_sane
    assert "ending the episode by a collision at cell" in once.behaviour
    assert once.avoiding_return == pytest.approx(5.0)
    assert once.reaching_return == pytest.approx(8.1)
    assert not lint_grid(replace(reward, collision_cost=-9.0), CORRIDOR, Task(on_collision="end")).is_sane


def test_never_arriving_is_no_better_when_it_pays_only_a_little_more() -> None:
    # By hand, gamma 0.5: 1 per step forever is 2; a way to the goal of n steps pays 2 * (1 - 0.5**n), always less.
    finding = lint_grid(replace(NOTHING, goal=0.0, time_cost=-1.0), CORRIDOR, Task(), gamma=0.5)

    assert not finding.is_sane
    assert finding.avoiding_return == pytest.approx(2.0)
    assert finding.reaching_return < 2.0


@pytest.mark.parametrize("gamma", [1.0, 0.0, 1.5])
def test_without_a_discount_there_is_nothing_to_compare(gamma: float) -> None:
    with pytest.raises(InputError, match=r"outside \(0, 1\)"):
        lint_grid(Reward(), CORRIDOR, Task(), gamma=gamma)


# ---- Idling and crashing -----------------------------------------------------------------------


def test_free_time_makes_idling_pay() -> None:
    # By hand: progress 0.5 at D = 3 with gamma 0.9: 0.5 * 3 * (1 - 0.9) = 0.15 per cell-time.
    reward = replace(NOTHING, progress=0.5, gamma=0.9)

    finding = lint_idling(reward, CORRIDOR, Task())

    assert not finding.is_sane
    assert finding.avoiding_return == pytest.approx(0.15)
    assert (finding.start, finding.goal) == ((0, 0), (0, 3))
    assert "FAIL all worlds: standing still" in str(finding)
    assert lint_idling(replace(reward, time_cost=0.16), CORRIDOR, Task()).is_sane
    assert not lint_idling(replace(reward, time_cost=0.14), CORRIDOR, Task()).is_sane


def test_the_default_without_a_time_cost_is_found_on_classic() -> None:
    assert not lint_idling(replace(Reward(), time_cost=0.0), CLASSIC, Task()).is_sane


def test_a_bonus_for_being_near_pays_for_idling_there() -> None:
    finding = lint_idling(ClosenessBonus(**vars(NOTHING)), CLASSIC, Task())

    assert not finding.is_sane
    assert abs(finding.start[0] - finding.goal[0]) + abs(finding.start[1] - finding.goal[1]) == 1


def test_a_cheap_collision_pays_where_it_ends_the_episode() -> None:
    # By hand: at 2 cells off the goal the potential gives back 1.0 * 2; at 3 cells it gives 3.
    reward = replace(NOTHING, progress=1.0, collision_cost=2.5)

    finding = lint_crashing(reward, CORRIDOR, Task(on_collision="end"))

    assert finding is not None
    assert not finding.is_sane
    assert finding.avoiding_return == pytest.approx(0.5)
    assert (finding.start, finding.goal) == ((0, 0), (0, 3))
    dear = lint_crashing(replace(reward, collision_cost=3.5), CORRIDOR, Task(on_collision="end"))
    assert dear is not None
    assert dear.is_sane


def test_returns_of_a_finding_compare_strictly() -> None:
    tie = Finding("GridWorld", "a loop", (0, 0), (0, 1), avoiding_return=1.0, reaching_return=1.0)

    assert not tie.is_sane
    assert replace(tie, reaching_return=np.nextafter(1.0, 2.0)).is_sane
