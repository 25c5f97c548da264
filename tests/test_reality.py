"""The held-out worlds are wrong in what they say, the same every time, and the sealed one stays sealed."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from gridnav.agents import Planner
from gridnav.envs import RANDOMIZATION_PRESETS, Randomization
from gridnav.experiment import reality
from gridnav.experiment.drivability import try_driving
from gridnav.experiment.reality import REALITIES, find_reality
from gridnav.experiment.worlds import Problem
from gridnav.problem.types import InputError

PROBLEM = Problem.load("S...\n....\n...G", "default", "default")
OPEN = Problem.load("open", "default", "default")
NAMES = ("parametric", "structural", "test")


def planner() -> Planner:
    return Planner.solve(PROBLEM.layout, PROBLEM.task, PROBLEM.reward)


def robots_of(name: str, randomization: Randomization | None = None, n: int = 1) -> Any:
    """Robots in ``open``, in a world built as this one is."""
    one = find_reality(name)
    varied = one.randomization if randomization is None else randomization
    return OPEN.worlds("DiffDrive", n, randomization=varied, **one.options)


def test_there_are_three_and_others_are_refused_by_name() -> None:
    assert tuple(REALITIES) == NAMES

    with pytest.raises(InputError, match="unknown reality 'mars': choose parametric, structural, test"):
        find_reality("mars")


@pytest.mark.parametrize("name", ["parametric", "structural"])
def test_every_evaluation_meets_the_same_episodes(name: str) -> None:
    one, other = (find_reality(name).episodes(PROBLEM, planner(), 2) for _ in range(2))

    assert [episode.row() for episode in one] == [episode.row() for episode in other]
    assert one[0].randomization != one[1].randomization
    assert one[0].randomization.keys() == set(find_reality(name).randomization.names)


def test_the_problem_s_own_randomization_does_not_matter() -> None:
    varied = Problem.load("S...\n....\n...G", "default", "default", "wide")
    one, other = (find_reality("parametric").episodes(problem, planner(), 1)[0] for problem in (PROBLEM, varied))

    assert one.row() == other.row()


def test_the_sealed_one_gives_metrics_and_shows_no_episode() -> None:
    sealed = find_reality("test")
    with pytest.raises(InputError, match="the test reality is sealed: it gives metrics, and no episode is shown"):
        sealed.episodes(PROBLEM, planner(), 1)

    assert sealed.measure(PROBLEM, planner(), 2).episodes == 2
    assert "Range" not in repr(sealed)
    assert [name for name in REALITIES if find_reality(name).is_sealed] == ["test"]


def test_a_seed_that_was_not_committed_to_breaks_the_seal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reality, "SEAL", "0" * 64)

    with pytest.raises(InputError, match="the seal of the test reality is broken"):
        find_reality("test")
    find_reality("structural")  # nobody asks for the seed


def test_the_numbers_of_the_parametric_one_lie_beyond_those_of_training() -> None:
    beyond, trained = find_reality("parametric").randomization, RANDOMIZATION_PRESETS["burger"]
    same = {"command_quantum", "lidar_skew"}  # the firmware's steps, and a whole turn: there is nothing beyond

    for name in set(beyond.names) - same:
        ours, theirs = getattr(beyond, name), getattr(trained, name)
        assert ours.low >= theirs.high or ours.high <= theirs.low, name
    assert len(beyond.names) > 25


@pytest.mark.parametrize("name", NAMES)
def test_nearly_all_robots_of_a_reality_can_drive(name: str) -> None:
    one = find_reality(name)

    assert try_driving(one.randomization, 64, **one.options).driving_share >= 0.95


# ---- The structural one --------------------------------------------------------------------------


def test_the_structural_model_is_made_otherwise() -> None:
    model, ordinary = robots_of("structural").model, OPEN.worlds("DiffDrive", 1).model

    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST != ordinary.opt.integrator
    assert model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL != ordinary.opt.cone
    assert model.opt.timestep == pytest.approx(0.005)
    wheel = model.geom("wheel_left")
    np.testing.assert_allclose(wheel.solref, [0.01, 1.2])
    np.testing.assert_allclose(wheel.pos, [0.0005, 0.0, 0.0])
    # The bristles of LuGre friction are a state of each motor; stall torque and no-load speed are those of the robot.
    assert (model.na, ordinary.na) == (2, 0)
    np.testing.assert_allclose(model.actuator_gainprm[:, :2], ordinary.actuator_gainprm[:, :2])


def test_wheels_of_the_structural_model_have_play() -> None:
    robots = robots_of("structural", Randomization())
    robots.reset(seed=0, options={"start": (5, 2), "goal": (0, 0), "heading_rad": 0.0})
    joint = robots.model.joint("play_right")  # of the wheel that is round: the other one's weight moves it too
    (address,) = joint.qposadr
    places = []
    for forward in (0.5, -0.5):
        for _ in range(5):
            robots.step(np.array([[forward, 0.0]]))
        places.append(robots._qpos[0, address])

    # By hand: half a degree to each side, and a motor pushes its wheel from the side that it drives from.
    np.testing.assert_allclose(joint.range, [-np.deg2rad(0.5), np.deg2rad(0.5)], rtol=0.01)
    assert -np.deg2rad(0.7) < places[0] < -np.deg2rad(0.3)
    assert np.deg2rad(0.3) < places[1] < np.deg2rad(0.7)


def test_motors_of_the_structural_model_stick_until_their_torque_is_large_enough() -> None:
    """At 0.1 of the top speed the controller gives 0.5 * 0.6 = 0.3 N m, at 0.02 it gives 0.06: less than sticks."""
    for fraction, moves in ((0.02, False), (0.1, True)):
        robots = robots_of("structural", Randomization())
        robots.reset(seed=0, options={"start": (5, 2), "goal": (0, 0), "heading_rad": 0.0})
        for _ in range(10):
            *_, info = robots.step(np.array([[fraction, 0.0]]))
        assert (info["path_length_m"][0] > 0.01) == moves, fraction


def test_patches_cover_a_part_of_the_floor_and_wheels_slip_on_them() -> None:
    robots = robots_of("structural", Randomization())
    model = robots.model
    patches = [i for i in range(model.ngeom) if model.geom(i).name.startswith("patch_")]
    # By hand: a fifth of 25 square metres in pieces of 0.36 square metres is 13.
    assert len(patches) == 13

    place = model.geom_pos[patches[0]]
    data = mujoco.MjData(model)
    data.qpos[:2] = place[:2]
    for _ in range(200):
        mujoco.mj_step(model, data)
    touching = {}
    for contact in data.contact:
        names = [model.geom(geom).name for geom in contact.geom]
        touching[names[1] if names[0] in ("floor",) or names[0].startswith("patch") else names[0]] = names, contact
    for side in ("wheel_left", "wheel_right"):
        names, contact = touching[side]
        assert "floor" not in names
        assert 0.1 <= contact.friction[0] <= 0.3
    names, contact = touching["caster"]
    assert "floor" in names
    assert contact.friction[0] == pytest.approx(0.02)


def test_the_battery_and_other_drawn_numbers_reach_the_rebuilt_motors() -> None:
    speeds = []
    for volts in (11.1, 9.0):
        robots = robots_of("structural", Randomization.fixed(battery_v=volts))
        robots.reset(seed=0, options={"start": (5, 2), "goal": (0, 0), "heading_rad": 0.0})
        for _ in range(20):
            *_, info = robots.step(np.array([[1.0, 0.0]]))
        speeds.append(info["path_length_m"][0])

    assert speeds[1] / speeds[0] == pytest.approx(9.0 / 11.1, rel=0.04)


@pytest.mark.parametrize("name", NAMES)
def test_the_physics_holds_and_observations_stay_within_their_space(name: str) -> None:
    robots = robots_of(name, n=6)
    robots.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(40):
        observations, _, _, _, info = robots.step(rng.uniform([-0.3, -1.0], [1.0, 1.0], (6, 2)))
        assert robots.observation_space.contains(observations)
        assert "physics_error" not in info
