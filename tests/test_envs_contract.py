"""What every world promises, asked of every registered id."""

from __future__ import annotations

import itertools
import re
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_checker import check_env as check_with_stable_baselines

from gridnav import Layout, Reward, Task
from gridnav.problem.reward import TERM_NAMES

IDS = sorted(name for name in gym.registry if name.startswith("gridnav/"))
ROBOTS = ["gridnav/DiffDrive-v0", "gridnav/Unicycle-v0"]

SMALL = Layout.from_text("...\n.#.\n...\n", name="small")
# A robot reaches the next cell's goal circle within 0.01 m, so that short drives hold several episodes.
SHORT = {"layout": SMALL, "task": Task(starts="any", goals="any", goal_radius_m=0.49), "max_episode_steps": 25}

INFO_TYPES = {
    "is_success": bool,
    "collision": bool,
    "collisions": int,
    "path_length_m": float,
    "shortest_path_m": float,
    "elapsed_s": float,
    "cell": tuple,
    "pose": np.ndarray,
    "reward_terms": dict,
}

pytestmark = pytest.mark.parametrize("env_id", IDS)


def draw_actions(env_id: str, steps: int, n: int, seed: int = 0) -> np.ndarray:
    """Actions of ``n`` robots, shape ``(steps, n, ...)``: any move, or any command with a liking for going ahead."""
    rng = np.random.default_rng(seed)
    if env_id not in ROBOTS:
        return rng.integers(4, size=(steps, n))
    commands = rng.uniform(-1.0, 1.0, (steps, n, 2))
    commands[..., 0] = commands[..., 0] / 2 + 0.5
    return commands.astype(np.float32)


def assert_same(one: Any, other: Any, what: str = "value") -> None:
    """Equal to the last bit, through dictionaries, tuples and object arrays."""
    if isinstance(one, dict):
        assert one.keys() == other.keys(), what
        for key in one:
            assert_same(one[key], other[key], f"{what}[{key}]")
    elif isinstance(one, tuple) or (isinstance(one, np.ndarray) and one.dtype == object):
        assert len(one) == len(other), what
        for i in range(len(one)):
            assert_same(one[i], other[i], f"{what}[{i}]")
    elif one is None:
        assert other is None, what
    else:
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other), err_msg=what, strict=True)


def arrays_in(value: Any) -> list[np.ndarray]:
    """Every array of a returned value, also those in dictionaries."""
    if isinstance(value, dict):
        return [array for part in value.values() for array in arrays_in(part)]
    if isinstance(value, np.ndarray) and value.dtype == object:
        return [array for part in value for array in arrays_in(part)]
    return [value] if isinstance(value, np.ndarray) else []


def of_one(info: dict[str, Any], i: int) -> dict[str, Any]:
    """Environment ``i``'s entries of a vector info, without the masks."""
    return {
        key: of_one(value, i) if isinstance(value, dict) else value[i]
        for key, value in info.items()
        if not key.startswith("_") and key not in ("final_obs", "final_info")
    }


def assert_same_info(single: dict[str, Any], vector: dict[str, Any], i: int) -> None:
    """A single environment's info equals environment ``i``'s share of a vector info."""
    share = of_one(vector, i)
    assert single.keys() == share.keys()
    for key, value in single.items():
        if isinstance(value, dict):
            assert {name: float(term) for name, term in share[key].items()} == value
        else:
            np.testing.assert_array_equal(np.asarray(value), share[key], err_msg=key)


# ---- Interfaces ----------------------------------------------------------------------------------


def test_the_registered_ids_are_the_three_worlds(env_id: str) -> None:
    assert IDS == ["gridnav/DiffDrive-v0", "gridnav/GridWorld-v0", "gridnav/Unicycle-v0"]


def test_both_public_checkers_pass_without_a_warning(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(env_id)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # What MuJoCo draws needs a GL back end; tests/test_rendering.py looks at it.
        check_with_gymnasium(env.unwrapped, skip_render_check=env_id == "gridnav/DiffDrive-v0")
        check_with_stable_baselines(env)
    env.close()


def test_make_gives_the_documented_spaces_and_time_limits(env_id: str) -> None:
    env = gym.make(env_id)

    # classic: 10 x 10 cells; its goals are the 3 x 3 corner less the wall at (7, 8).
    if env_id == "gridnav/GridWorld-v0":
        assert env.observation_space == gym.spaces.Discrete(100 * 8)
        assert env.action_space == gym.spaces.Discrete(4)
        assert env.spec.max_episode_steps == 100
    else:
        assert env.observation_space.shape == (24 + 1 + 2 + 2 + 2 + 2 + 2,)
        assert env.observation_space.dtype == np.float32
        assert env.action_space == gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        assert env.spec.max_episode_steps == 500
    assert env.unwrapped.layout == Layout.load("classic")


def test_make_vec_gives_the_worlds_own_vector_form(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=3)

    assert type(env).__name__ == env_id.removeprefix("gridnav/").removesuffix("-v0") + "VectorEnv"
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    single = gym.make(env_id)
    assert env.single_observation_space == single.observation_space
    assert env.single_action_space == single.action_space
    assert env.observation_space == gym.vector.utils.batch_space(single.observation_space, 3)
    observations, _ = env.reset(seed=0)
    assert observations in env.observation_space
    observations, rewards, terminated, truncated, _ = env.step(env.action_space.sample())
    assert observations in env.observation_space
    assert (rewards.shape, rewards.dtype) == ((3,), np.float64)
    assert terminated.shape == truncated.shape == (3,)
    assert terminated.dtype == truncated.dtype == bool


def test_gymnasiums_own_vector_statistics_work(env_id: str) -> None:
    env = gym.wrappers.vector.RecordEpisodeStatistics(gym.make_vec(env_id, num_envs=2, max_episode_steps=3))
    env.reset(seed=0)

    rewards, lengths = np.zeros(2), None
    for actions in draw_actions(env_id, 3, 2):
        _, step_rewards, _, _, info = env.step(actions)
        rewards += step_rewards
        lengths = info.get("episode", {}).get("l")

    np.testing.assert_array_equal(lengths, [3, 3])
    np.testing.assert_allclose(info["episode"]["r"], rewards)


def test_stepping_before_the_first_reset_is_refused(env_id: str) -> None:
    world = gym.make_vec(env_id, num_envs=2)
    single = gym.make(env_id)

    with pytest.raises(gym.error.ResetNeeded):
        world.step(draw_actions(env_id, 1, 2)[0])
    with pytest.raises(gym.error.ResetNeeded):
        single.unwrapped.step(draw_actions(env_id, 1, 1)[0, 0])


def test_close_may_be_called_twice(env_id: str) -> None:
    for env in (gym.make(env_id), gym.make_vec(env_id, num_envs=2)):
        env.reset(seed=0)
        env.close()
        env.close()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"layout": "nowhere"}, "nowhere"),
        ({"layout": 3}, "int"),
        ({"task": "nothing"}, "nothing"),
        ({"reward": "money"}, "money"),
        ({"render_mode": "smell"}, "smell"),
        ({"max_episode_steps": 0}, "0"),
    ],
)
def test_a_wrong_argument_is_named_in_one_line(env_id: str, arguments: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named) as caught:
        gym.make_vec(env_id, num_envs=2, **arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("num_envs", [0, -1, 2.5, True, "two", 10**12])
def test_a_wrong_number_of_environments_is_refused(env_id: str, num_envs: Any) -> None:
    world = type(gym.make_vec(env_id, num_envs=1))

    with pytest.raises(ValueError, match="num_envs"):
        world(num_envs)


# ---- Info ----------------------------------------------------------------------------------------


def test_info_has_every_key_with_its_type_at_reset_and_at_every_step(env_id: str) -> None:
    env = gym.make(env_id, **SHORT)
    _, info = env.reset(seed=0)
    infos = [info]

    for action in draw_actions(env_id, 60, 1)[:, 0]:
        _, _, terminated, truncated, info = env.step(action)
        infos.append(info)
        if terminated or truncated:
            infos.append(env.reset()[1])

    for info in infos:
        assert {key: type(value) for key, value in info.items()} == INFO_TYPES
        assert [type(number) for number in info["cell"]] == [int, int]
        assert (info["pose"].shape, info["pose"].dtype) == ((3,), np.float64)
        assert list(info["reward_terms"]) == list(TERM_NAMES)
        assert {type(value) for value in info["reward_terms"].values()} == {float}


def test_info_of_a_batch_has_every_key_with_a_leading_batch_axis(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=4, **SHORT)
    infos = [env.reset(seed=0)[1]]
    infos += [env.step(actions)[4] for actions in draw_actions(env_id, 60, 4)]

    kinds = {"is_success": "b", "collision": "b", "collisions": "i", "cell": "i"}
    for info in infos:
        for key in INFO_TYPES:
            for array in arrays_in(info[key]):
                assert len(array) == 4
                assert array.dtype.kind == kinds.get(key, "f"), key
        assert set(info) - set(INFO_TYPES) <= {"final_obs", "_final_obs", "final_info", "_final_info"}


def test_info_at_reset_describes_the_start(env_id: str) -> None:
    env = gym.make(env_id)

    _, info = env.reset(seed=0, options={"start": (0, 1), "goal": (9, 8), "heading_rad": 1.5})

    # Cell (0, 1) of ten rows of 0.5 m: x = 1.5 * 0.5, y = (10 - 0.5) * 0.5.
    np.testing.assert_allclose(info["pose"], [0.75, 4.75, 1.5])
    assert info["cell"] == (0, 1)
    assert (info["is_success"], info["collision"], info["collisions"]) == (False, False, 0)
    assert (info["path_length_m"], info["elapsed_s"]) == (0.0, 0.0)
    assert set(info["reward_terms"].values()) == {0.0}


def test_time_and_way_add_up(env_id: str) -> None:
    env = gym.make(env_id)
    env.reset(seed=1)

    way, hits = 0.0, 0
    for number, action in enumerate(draw_actions(env_id, 40, 1)[:, 0], start=1):
        before = env.unwrapped.worlds._pose[0, :2].copy()
        _, _, terminated, _, info = env.step(action)
        assert not terminated
        way += float(np.hypot(*(info["pose"][:2] - before)))
        hits += info["collision"]
        # A grid move takes the time to cross 0.5 m at top speed: 0.5 / 0.197 = 2.538 s; a command takes 0.2 s.
        seconds = 0.2 if env_id in ROBOTS else 0.5 / (5.969 * 0.033)
        assert info["elapsed_s"] == pytest.approx(number * seconds)
        assert info["collisions"] == hits
        # Arcs are longer than the chords between poses, by at most x 1.011 for 0.5 rad per step (a/2 / sin(a/2)).
        assert way - 1e-9 <= info["path_length_m"] <= way * 1.02 + 4e-3


@pytest.mark.parametrize("reward", ["default", "seed"])
def test_the_reward_is_the_sum_of_its_terms(env_id: str, reward: str) -> None:
    env = gym.make_vec(env_id, num_envs=8, **SHORT, reward=reward)
    env.reset(seed=3)

    seen = dict.fromkeys(TERM_NAMES, False)
    for actions in draw_actions(env_id, 80, 8):
        _, rewards, terminated, truncated, info = env.step(actions)
        final = info.get("final_info", info)["reward_terms"]
        np.testing.assert_allclose(rewards, sum(final.values()), rtol=0, atol=1e-12)
        # Where the next episode has begun, its own terms are zero.
        for name in TERM_NAMES:
            seen[name] |= bool((final[name] != 0).any())
            assert (info["reward_terms"][name][terminated | truncated] == 0).all()

    if reward == "default":
        assert all(seen.values()), seen


# ---- Autoreset -----------------------------------------------------------------------------------


def test_an_ended_episode_goes_to_final_obs_and_final_info_with_masks(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=6, **SHORT)
    observations, _ = env.reset(seed=2)

    ends = 0
    for actions in draw_actions(env_id, 60, 6):
        observations, _, terminated, truncated, info = env.step(actions)
        ended = terminated | truncated
        assert ("final_obs" in info) == ("final_info" in info) == ended.any()
        assert (info["elapsed_s"] == 0.0).tolist() == ended.tolist()
        if not ended.any():
            continue
        ends += int(ended.sum())
        np.testing.assert_array_equal(info["_final_obs"], ended)
        np.testing.assert_array_equal(info["_final_info"], ended)
        final = info["final_info"]
        np.testing.assert_array_equal(final["is_success"][ended], terminated[ended])
        assert (final["elapsed_s"][ended] > 0).all()
        for i in range(6):
            assert (info["final_obs"][i] is not None) == ended[i]
            if ended[i]:
                assert np.asarray(info["final_obs"][i]) in env.single_observation_space
                if env_id in ROBOTS:
                    # The last observation is of the last pose, the returned one of the new start.
                    last, _ = env.features.poses_and_goals(info["final_obs"][i][None])
                    np.testing.assert_allclose(last[0], final["pose"][i], atol=1e-5)
                    first, _ = env.features.poses_and_goals(observations[i][None])
                    np.testing.assert_allclose(first[0], info["pose"][i], atol=1e-5)
    assert ends >= 12


def test_a_neighbours_reset_does_not_show_in_the_others(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=6, **SHORT)
    env.reset(seed=2)

    ends = 0
    for actions in draw_actions(env_id, 60, 6):
        _, _, terminated, truncated, info = env.step(actions)
        if "final_info" not in info:
            continue
        ends += 1
        going = ~(terminated | truncated)
        for key in INFO_TYPES:
            for now, final in zip(arrays_in(info[key]), arrays_in(info["final_info"][key]), strict=True):
                np.testing.assert_array_equal(now[going], final[going], err_msg=key)
    assert ends >= 5


# ---- Scalar and vector, seeds and streams --------------------------------------------------------


def assert_batch_equals_singles(env_id: str, seeds: list[int], steps: int, **options: Any) -> None:
    """Every observation, reward, flag and info of a batch is that of single environments, to the last bit."""
    batch = gym.make_vec(env_id, num_envs=len(seeds), **SHORT, **options)
    observations, info = batch.reset(seed=seeds)
    singles = [gym.make(env_id, **SHORT) for _ in seeds]
    for i, single in enumerate(singles):
        observation, one_info = single.reset(seed=seeds[i])
        np.testing.assert_array_equal(observation, observations[i])
        assert_same_info(one_info, info, i)

    ends = np.zeros(len(seeds), dtype=int)
    for actions in draw_actions(env_id, steps, len(seeds)):
        observations, rewards, terminated, truncated, info = batch.step(actions)
        for i, single in enumerate(singles):
            observation, reward, one_terminated, one_truncated, one_info = single.step(actions[i])
            assert (reward, one_terminated, one_truncated) == (rewards[i], terminated[i], truncated[i])
            if one_terminated or one_truncated:
                ends[i] += 1
                np.testing.assert_array_equal(observation, info["final_obs"][i])
                assert_same_info(one_info, info["final_info"], i)
                observation, one_info = single.reset()
            np.testing.assert_array_equal(observation, observations[i])
            assert_same_info(one_info, info, i)
    assert ends.min() >= 3


def test_a_batch_equals_single_environments_bit_for_bit_over_episodes(env_id: str) -> None:
    assert_batch_equals_singles(env_id, [11, 12, 13], 90)


@pytest.mark.slow
@pytest.mark.parametrize("n_threads", [1, 2, 3])
def test_a_batch_equals_single_environments_over_a_hundred_thousand_steps(env_id: str, n_threads: int) -> None:
    threads = {"n_threads": n_threads} if env_id == "gridnav/DiffDrive-v0" else {}
    if not threads and n_threads > 1:
        pytest.skip("one thread is all that this world uses")
    assert_batch_equals_singles(env_id, list(range(20)), 5_000, **threads)


def test_an_environment_does_not_depend_on_what_the_others_do(env_id: str) -> None:
    alone, other = (gym.make_vec(env_id, num_envs=3, **SHORT) for _ in range(2))
    one, _ = alone.reset(seed=[5, 6, 7])
    two, _ = other.reset(seed=[5, 8, 9])

    mine, theirs = draw_actions(env_id, 70, 3, seed=1), draw_actions(env_id, 70, 3, seed=2)
    theirs[:, 0] = mine[:, 0]
    assert_same(one[0], two[0])
    for a, b in zip(mine, theirs, strict=True):
        one, two = alone.step(a), other.step(b)
        for mine_part, their_part in zip(one[:4], two[:4], strict=True):
            assert_same(mine_part[0], their_part[0])
        for key, value in of_one(one[4], 0).items():
            assert_same(value, of_one(two[4], 0)[key], key)


def test_the_same_seed_gives_the_same_trajectory_in_new_and_in_used_environments(env_id: str) -> None:
    new, used = (gym.make_vec(env_id, num_envs=3, **SHORT) for _ in range(2))
    used.reset(seed=99)
    for actions in draw_actions(env_id, 37, 3, seed=4):
        used.step(actions)

    assert_same(new.reset(seed=1)[1], used.reset(seed=1)[1])
    for actions in draw_actions(env_id, 60, 3):
        for one, other in zip(new.step(actions), used.step(actions), strict=True):
            assert_same(one, other)


def test_resetting_without_a_seed_goes_on_with_the_stream(env_id: str) -> None:
    """Otherwise every episode of a run would start in the same cell."""
    one, other = gym.make(env_id), gym.make(env_id)
    starts = [env.reset(seed=0)[1]["pose"] for env in (one, other)]
    later = [[env.reset()[1]["pose"] for _ in range(20)] for env in (one, other)]

    np.testing.assert_array_equal(starts[0], starts[1])
    np.testing.assert_array_equal(later[0], later[1])
    assert len({tuple(pose[:2]) for pose in later[0]}) >= 4


def first_starts(env_id: str, seed: int, episodes: int = 4) -> list[tuple[float, ...]]:
    """Headings (robots) or start and goal cells of the first episodes of four environments, one tuple each."""
    env = gym.make_vec(env_id, num_envs=4, layout="open", task="any")
    env.reset(seed=seed)
    drawn: list[list[float]] = [[] for _ in range(4)]
    for _ in range(episodes):
        for i in range(4):
            start, goal = env.start_and_goal(i)
            drawn[i] += [*start, *goal, float(env._pose[i, 2])]
        env.reset()
    return [tuple(one) for one in drawn]


def test_one_seed_gives_every_environment_a_stream_that_no_other_seed_gives(env_id: str) -> None:
    """With seed + i, environment 1 of seed 0 would be environment 0 of seed 1."""
    drawn = [stream for seed in range(8) for stream in first_starts(env_id, seed)]

    assert len(set(drawn)) == 8 * 4


def test_a_seed_per_environment_must_be_given_for_each(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=3)

    with pytest.raises(ValueError, match="2 seeds were given for 3"):
        env.reset(seed=[1, 2])


def test_the_global_generators_are_neither_read_nor_written(env_id: str) -> None:
    trajectories = []
    for global_seed in (0, 1):
        np.random.seed(global_seed)  # noqa: NPY002
        before = np.random.get_state()[1].copy()  # noqa: NPY002
        env = gym.make_vec(env_id, num_envs=2, **SHORT)
        parts = [env.reset(seed=5)[0]]
        parts += [env.step(actions)[0] for actions in draw_actions(env_id, 60, 2)]
        trajectories.append(np.array(parts))
        np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002

    np.testing.assert_array_equal(*trajectories)


def test_nothing_of_the_start_is_random_when_start_goal_and_heading_are_given(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=4)
    options = {"start": (0, 0), "goal": (9, 9), "heading_rad": 0.5}

    seen = [env.reset(seed=seed, options=options) for seed in (0, 1, None)]

    for observations, info in seen:
        assert_same(info, seen[0][1])
        for i in range(4):
            np.testing.assert_array_equal(observations[i], seen[0][0][0])


def test_options_hold_for_the_episodes_that_follow_in_a_batch(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=3, layout=SMALL, max_episode_steps=2)
    env.reset(seed=0, options={"start": (0, 0), "goal": (2, 2)})

    for actions in draw_actions(env_id, 8, 3):
        env.step(actions)
        assert [env.start_and_goal(i) for i in range(3)] == [((0, 0), (2, 2))] * 3
    env.reset()
    drawn = set()
    for actions in draw_actions(env_id, 40, 3):
        env.step(actions)
        drawn |= {env.start_and_goal(i) for i in range(3)}
    assert len(drawn) > 10


def test_one_given_end_never_meets_the_drawn_other_end(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=64, layout=SMALL)

    for options in ({"start": (0, 0)}, {"goal": (0, 0)}):
        env.reset(seed=0, options=options)
        ends = [env.start_and_goal(i) for i in range(64)]
        assert all(start != goal for start, goal in ends)
        assert all(end[0 if "start" in options else 1] == (0, 0) for end in ends)


def test_a_layout_given_at_reset_is_the_one_that_is_played(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=2, layout=SMALL, task="any")
    if env_id == "gridnav/GridWorld-v0":
        env = gym.make_vec(env_id, num_envs=2, layout=SMALL, task="any", observation="features")
    other = Layout.from_text("...\n...\n#..\n", name="other")
    fresh = gym.make_vec(
        env_id, num_envs=2, layout=other, task="any", **({} if env_id in ROBOTS else {"observation": "features"})
    )
    env.reset(seed=0)
    env.step(draw_actions(env_id, 1, 2)[0])

    assert_same(env.reset(seed=4, options={"layout": other}), fresh.reset(seed=4))

    assert env.layout == other
    for actions in draw_actions(env_id, 40, 2):
        for one, two in zip(env.step(actions), fresh.step(actions), strict=True):
            assert_same(one, two)


# ---- Memory --------------------------------------------------------------------------------------


def internal_arrays(value: Any, depth: int = 0) -> list[np.ndarray]:
    """Arrays that an object holds, also in the objects it holds."""
    if isinstance(value, np.ndarray):
        return [value]
    if depth > 3:
        return []
    parts: list[Any] = []
    if isinstance(value, dict):
        parts = list(value.values())
    elif isinstance(value, list | tuple):
        parts = list(value)
    elif type(value).__module__.startswith("gridnav") and hasattr(value, "__dict__"):
        parts = list(vars(value).values())
    return [array for part in parts for array in internal_arrays(part, depth + 1)]


def test_returned_arrays_share_no_memory_with_each_other_the_world_or_the_actions(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=3, **SHORT)
    returned = arrays_in(env.reset(seed=0)[0]) + arrays_in(env.reset(seed=0)[1])
    given = []
    for actions in draw_actions(env_id, 28, 3):  # beyond the time limit: autoresets too
        given.append(actions)
        for part in env.step(actions):
            returned += arrays_in(part)

    inside = internal_arrays(env) + given
    spans = [np.lib.array_utils.byte_bounds(array) for array in returned]
    # Every array is kept alive above, so two that overlap in bytes are one memory.
    ordered = sorted(spans)
    assert all(first[1] <= second[0] for first, second in itertools.pairwise(ordered))
    assert len(inside) > 15
    for low, high in (np.lib.array_utils.byte_bounds(array) for array in inside if array.size):
        assert not any(low < end and begin < high for begin, end in spans)


def test_a_callers_changes_to_what_was_returned_change_nothing(env_id: str) -> None:
    clean, abused = (gym.make_vec(env_id, num_envs=2, **SHORT) for _ in range(2))
    clean.reset(seed=0)
    observations, info = abused.reset(seed=0)

    for actions in draw_actions(env_id, 40, 2):
        for array in arrays_in(observations) + arrays_in(info):
            array[...] = 77
        own = actions.copy()
        expected = clean.step(actions)
        got = abused.step(own)
        own[...] = 0
        for one, other in zip(expected, got, strict=True):
            assert_same(one, other)
        observations, info = got[0], got[4]


def test_single_environments_return_fresh_memory(env_id: str) -> None:
    env = gym.make(env_id, **SHORT)
    observation, info = env.reset(seed=0)
    kept = arrays_in(observation) + arrays_in(info)
    for action in draw_actions(env_id, 20, 1)[:, 0]:
        observation, _, _, _, info = env.step(action)
        kept += arrays_in(observation) + arrays_in(info)
    inside = internal_arrays(env.unwrapped.worlds)

    assert len(kept) >= 21
    for i, array in enumerate(kept):
        assert not any(np.shares_memory(array, other) for other in kept[i + 1 :])
        assert not any(np.shares_memory(array, other) for other in inside)


# ---- Wrong actions and options -------------------------------------------------------------------

BAD_MOVES: list[Any] = [4, -1, 1.0, 0.5, np.nan, np.inf, True, "up", None, [1], [[0]], [0, [1]], {}, 1 + 0j, 10**30]
BAD_COMMANDS: list[Any] = [
    [np.nan, 0.0], [0.0, np.inf], [-np.inf, 0.0], 0.5, [0.5], [0.5, 0.5, 0.5], [[0.5, 0.5]], [0.5, [1.0]],
    ["0.5", "0.5"], "go", None, [True, False], [0.5 + 0j, 0.0], {}, [None, 0.0], [10**400, 0],
]  # fmt: skip


def test_a_wrong_action_is_named_and_changes_nothing(env_id: str) -> None:
    env, twin = gym.make(env_id, **SHORT), gym.make(env_id, **SHORT)
    env.reset(seed=0)
    twin.reset(seed=0)
    good = draw_actions(env_id, 40, 1)[:, 0]

    for number, bad in enumerate(BAD_COMMANDS if env_id in ROBOTS else BAD_MOVES):
        with pytest.raises(ValueError, match="action") as caught:
            env.step(bad)
        assert "\n" not in str(caught.value), bad
        assert_same(env.step(good[number]), twin.step(good[number]))


def test_a_wrong_action_in_a_batch_moves_nobody(env_id: str) -> None:
    env, twin = (gym.make_vec(env_id, num_envs=3, **SHORT) for _ in range(2))
    env.reset(seed=0)
    twin.reset(seed=0)
    good = draw_actions(env_id, 40, 3)
    if env_id in ROBOTS:
        bad = [good[0, 0], good[0, :2], [[np.nan, 0], [0, 0], [0, 0]], [[0, 0], [0, 0], [0]], None, "abc", [[0, 0]] * 4]
    else:
        bad = [1, [1, 2], [[0], [1], [2]], [0, 0, 4], [0, -1, 0], [0.0, 1.0, 2.0], None, "abc", [0, 0, [0, 0]]]

    for number, actions in enumerate(bad):
        with pytest.raises(ValueError, match="action"):
            env.step(actions)
        for one, other in zip(env.step(good[number]), twin.step(good[number]), strict=True):
            assert_same(one, other)


def test_every_kind_of_number_that_means_the_same_action_does_the_same(env_id: str) -> None:
    envs = [gym.make(env_id) for _ in range(4)]
    kinds: list[Any]
    if env_id in ROBOTS:
        kinds = [np.array([1, 0], np.float32), np.array([1.0, 0.0]), [1, 0], (5.0, 0.0)]  # beyond 1 is full speed
    else:
        kinds = [3, np.int64(3), np.uint8(3), np.array(3)]

    results = []
    for env, action in zip(envs, kinds, strict=True):
        env.reset(seed=0)
        results.append([env.step(action)[1:] for _ in range(5)])

    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            assert_same(one[3], two[3])
            assert one[:3] == two[:3]


BAD_OPTIONS: list[tuple[dict[str, Any], str]] = [
    ({"start": (3, 3)}, r"start \(3, 3\).*wall"),
    ({"goal": (3, 3)}, r"goal \(3, 3\).*wall"),
    ({"start": (10, 0)}, r"start \(10, 0\)"),
    ({"start": (-1, 0)}, r"start \(-1, 0\)"),
    ({"goal": (0, 10)}, r"goal \(0, 10\)"),
    ({"start": (0, 0), "goal": (0, 0)}, "must differ"),
    ({"start": (0.5, 0)}, "start.*whole"),
    ({"start": "ab"}, "start.*whole"),
    ({"start": 3}, "start.*whole"),
    ({"start": (1, 2, 3)}, "start.*whole"),
    ({"start": (np.nan, 0)}, "start.*whole"),
    ({"goal": [[0, 0]]}, "goal.*whole"),
    ({"heading_rad": np.nan}, "heading_rad"),
    ({"heading_rad": np.inf}, "heading_rad"),
    ({"heading_rad": "north"}, "heading_rad"),
    ({"heading_rad": [0.0]}, "heading_rad"),
    ({"heading_rad": True}, "heading_rad"),
    ({"begin": (0, 0)}, "begin"),
    ({"layout": "nowhere"}, "nowhere"),
    ({"layout": "four-rooms"}, "11 x 11"),
    ({"layout": 5}, "layout"),
]


@pytest.mark.parametrize(("options", "pattern"), BAD_OPTIONS, ids=[str(options) for options, _ in BAD_OPTIONS])
def test_a_wrong_reset_option_is_named_in_one_line_and_changes_nothing(
    env_id: str, options: dict[str, Any], pattern: str
) -> None:
    arguments = {"layout": "classic", "task": "any"}
    env, twin = gym.make(env_id, **arguments), gym.make(env_id, **arguments)
    env.reset(seed=0)
    twin.reset(seed=0)

    with pytest.raises(ValueError, match=pattern) as caught:
        env.reset(seed=1, options=options)

    assert "\n" not in str(caught.value)
    for action in draw_actions(env_id, 3, 1)[:, 0]:
        assert_same(env.step(action), twin.step(action))
    assert_same(env.reset(), twin.reset())  # the wrong call's seed has no effect either


def test_a_cell_that_no_start_reaches_is_refused(env_id: str) -> None:
    env = gym.make(env_id, layout="S.#.\nG.#.\n")

    for key in ("start", "goal"):
        with pytest.raises(ValueError, match=re.escape(f"{key} (0, 3) cannot be reached")):
            env.reset(options={key: (0, 3)})


# ---- Ends ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("vector", [False, True])
def test_the_time_limit_truncates_and_never_terminates(env_id: str, vector: bool) -> None:
    arguments: dict[str, Any] = {"layout": "classic", "max_episode_steps": 5}
    env = gym.make_vec(env_id, num_envs=1, **arguments) if vector else gym.make(env_id, **arguments)

    for _ in range(2):
        if not vector:
            env.reset(seed=0)
        else:
            env.reset(seed=0, options={"start": (0, 0)})
        flags = []
        for actions in draw_actions(env_id, 5, 1):
            _, _, terminated, truncated, _ = env.step(actions if vector else actions[0])
            flags.append((bool(np.all(terminated)), bool(np.all(truncated))))
        assert flags == [(False, False)] * 4 + [(False, True)]


def test_the_default_time_limit_holds_in_both_forms(env_id: str) -> None:
    limit = 100 if env_id == "gridnav/GridWorld-v0" else 500
    still = np.array([0]) if env_id == "gridnav/GridWorld-v0" else np.zeros((1, 2), np.float32)
    batch, single = gym.make_vec(env_id, num_envs=1), gym.make(env_id)
    batch.reset(seed=0, options={"start": (0, 0)})
    single.reset(seed=0, options={"start": (0, 0)})

    ends = [[], []]
    for number in range(1, limit + 1):
        for where, step in zip(ends, (batch.step(still), single.step(still[0])), strict=True):
            if step[3]:
                where.append(number)
    assert ends == [[limit], [limit]]


@pytest.mark.parametrize("through", ["class", "make"])
def test_rewards_that_look_at_the_time_limit_see_the_same_one_in_both_forms(env_id: str, through: str) -> None:
    """The tutorial's reward charges 1 for the move that ends the time."""
    arguments: dict[str, Any] = {"reward": "seed", "max_episode_steps": 4}
    batch, single = gym.make_vec(env_id, num_envs=1, **arguments), gym.make(env_id, **arguments)
    if through == "class":
        single = type(single.unwrapped)(**arguments)
    batch.reset(seed=[0])
    single.reset(seed=0)

    pairs = [(batch.step(a)[1][0], single.step(a[0])[1]) for a in draw_actions(env_id, 4, 1)]

    assert pairs[-1] == (-1.0, -1.0)
    assert all(one == other for one, other in pairs)


def test_the_goal_terminates_with_success_and_pays(env_id: str) -> None:
    """One cell to the right: one move, or at most 0.5 m at 0.18 m/s."""
    env = gym.make(env_id, layout="SG\n")
    env.reset(seed=0, options={"heading_rad": 0.0})

    for _ in range(30):
        _, _, terminated, truncated, info = env.step(3 if env_id not in ROBOTS else [1.0, 0.0])
        if terminated:
            break

    assert (terminated, truncated, info["is_success"], info["collisions"]) == (True, False, True, 0)
    assert info["reward_terms"]["goal"] == Reward().goal
    if env_id in ROBOTS:
        assert abs(info["pose"][0] - 0.75) <= 0.15


@pytest.mark.parametrize(("on_collision", "ends"), [("stop", False), ("end", True), ("slide", False)])
def test_a_collision_is_counted_and_charged_and_ends_only_where_the_task_says_so(
    env_id: str, on_collision: Any, ends: bool
) -> None:
    env = gym.make(env_id, layout="...\n...\n...\n", task=Task(on_collision=on_collision))
    env.reset(seed=0, options={"start": (1, 0), "goal": (1, 2), "heading_rad": np.pi})

    # Into the left outer wall: 0.25 - 0.105 m away, under a second at top speed.
    for _ in range(12):
        _, _, terminated, truncated, info = env.step(2 if env_id not in ROBOTS else [1.0, 0.0])
        if info["collision"]:
            break

    assert (info["collision"], info["collisions"], info["is_success"]) == (True, 1, False)
    assert info["reward_terms"]["collision"] == -Reward().collision_cost
    assert (terminated, truncated) == (ends, False)


def test_a_layout_task_and_reward_may_be_given_as_objects(env_id: str) -> None:
    env = gym.make(env_id, layout=SMALL, task=Task(on_collision="end"), reward=Reward(goal=3.0))

    assert env.unwrapped.layout is SMALL
    assert env.unwrapped.task == Task(on_collision="end")
    assert env.unwrapped.reward == Reward(goal=3.0)


def test_observations_and_rewards_stay_good_over_many_random_steps(env_id: str) -> None:
    """Late faults: a bound, a type or a shape that breaks only after a while."""
    env = gym.make_vec(env_id, num_envs=8, layout=SMALL, task="any", max_episode_steps=150)
    observations, _ = env.reset(seed=0)
    space = env.observation_space

    for actions in draw_actions(env_id, 400, 8):
        observations, rewards, terminated, truncated, _ = env.step(actions)
        assert observations in space
        assert (rewards.dtype, rewards.shape) == (np.float64, (8,))
        assert np.isfinite(rewards).all()
        assert (terminated.dtype, truncated.dtype) == (bool, bool)


def test_the_robot_worlds_show_their_control_period_and_the_physics_its_model(env_id: str) -> None:
    world = gym.make(env_id).unwrapped

    assert world.layout.cell_size_m == 0.5
    assert hasattr(world, "control_period_s") == (env_id in ROBOTS)
    assert hasattr(world, "model") == (env_id == "gridnav/DiffDrive-v0")
    if env_id in ROBOTS:
        assert world.control_period_s == 0.2
        assert gym.make(env_id, control_period_s=0.1).unwrapped.control_period_s == 0.1
        for wrong in (0.0, -0.2, 2.0, np.nan):
            with pytest.raises(ValueError, match="control_period_s"):
                gym.make(env_id, control_period_s=wrong)


def test_documented_numbers_are_those_of_the_code(env_id: str) -> None:
    env = gym.make(env_id)
    page = type(env.unwrapped).__doc__

    assert str(env.spec.max_episode_steps) in page
    if env_id in ROBOTS:
        robot, world = env.unwrapped.worlds.robot, env.unwrapped.worlds
        assert f"``Box`` of {env.observation_space.shape[0]} numbers" in page
        assert f"{robot.max_speed_m_s:.3f} m/s and {robot.max_turn_rad_s:.2f} rad/s" in page
        assert f"{world.control_period_s} s is {world.step_duration:.3f} cell-times" in page
        assert f"within {world.task.goal_radius_m} m" in page


def test_two_walls_of_a_corner_are_two_collisions(env_id: str) -> None:
    """From the top right cell: 0.145 m to the right wall, then along it as far to the top wall."""
    if env_id not in ROBOTS:
        pytest.skip("the grid counts every bump")
    env = gym.make(env_id)
    env.reset(seed=0, options={"start": (0, 9), "goal": (9, 9), "heading_rad": 0.0})

    for _ in range(8):
        info = env.step([1.0, 0.0])[4]
    assert info["collisions"] == 1
    while info["pose"][2] < np.pi / 2 + 0.02:  # less, and the right wall refuses to let it go ahead
        info = env.step([0.0, 0.2])[4]
    for _ in range(10):
        info = env.step([1.0, 0.0])[4]

    assert info["collisions"] == 2


@pytest.mark.parametrize("as_vector", [False, True])
def test_a_layout_option_holds_until_the_next_reset(env_id: str, as_vector: bool) -> None:
    env = gym.make_vec(env_id, num_envs=2) if as_vector else gym.make(env_id)
    classic = env.unwrapped.layout
    other = Layout.from_text(classic.to_text().replace("#", "."))

    env.reset(seed=0, options={"layout": other})
    assert env.unwrapped.layout == other
    env.reset(seed=0)
    assert env.unwrapped.layout == classic


def test_pressing_against_a_wall_is_another_collision_every_cell_time(env_id: str) -> None:
    """The grid counts every bump, which takes one cell-time; so do the robots: 2.54 s are 12.7 periods of 0.2 s."""
    env = gym.make(env_id)
    env.reset(seed=0, options={"start": (0, 9), "goal": (9, 9), "heading_rad": 0.0})
    per_bump = 13 if env_id in ROBOTS else 1
    while not env.step([1.0, 0.0] if env_id in ROBOTS else 3)[4]["collision"]:
        pass

    counts = [env.step([1.0, 0.0] if env_id in ROBOTS else 3)[4]["collisions"] for _ in range(3 * per_bump)]

    assert counts[per_bump - 1 :: per_bump] == [2, 3, 4]


@pytest.mark.parametrize("options", [{"start": (8, 9)}, {"goal": (0, 0)}])
def test_a_start_or_goal_that_leaves_no_other_end_is_refused(env_id: str, options: dict[str, Any]) -> None:
    env = gym.make(env_id, layout="corridors")  # one start and one goal, here swapped
    with pytest.raises(ValueError, match=r"give both|cannot name"):
        env.reset(seed=0, options=options)
