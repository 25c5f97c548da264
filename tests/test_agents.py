"""The learners: what they learn, what they do at the end of an episode, and that files bring them back unchanged."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gridnav.agents.base import EpisodeWindow, FrameStack
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from gridnav import Layout, Reward, Task
from gridnav.agents import Planner, Progress, QLearning, QLearningConfig
from gridnav.envs import GridWorldVectorEnv
from gridnav.problem.geodesic import cell_distances
from gridnav.problem.grid_mdp import GridMDP, MoveTable
from gridnav.problem.types import InputError

CLASSIC = Layout.load("classic")
STEPS = 600_000
"""Environment steps within which Q-learning solves ``classic``."""


class ShortEpisodes(VectorEnv[Any, Any, Any]):
    """Every episode is one step from state 0 to state 1, which pays 1; the next one starts in state 2."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, num_envs: int, *, terminates: bool, truncates: bool) -> None:
        self.num_envs = num_envs
        self.terminates, self.truncates = terminates, truncates
        self.single_observation_space, self.single_action_space = Discrete(3), Discrete(1)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(self.num_envs, dtype=np.int64), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        n, ended = self.num_envs, self.terminates or self.truncates
        final_obs = np.full(n, None, dtype=object)
        final_obs[:] = [np.int64(1)] * n
        ends = {
            "final_obs": final_obs,
            "_final_obs": np.ones(n, dtype=bool),
            "final_info": {"is_success": np.full(n, self.terminates), "collisions": np.zeros(n)},
            "_final_info": np.ones(n, dtype=bool),
        }
        return (
            np.full(n, 2 if ended else 1),
            np.ones(n),
            np.full(n, self.terminates),
            np.full(n, self.truncates),
            ends if ended else {},
        )


class Reaching(VectorEnv[Any, Any, Any]):
    """One-step episodes in boxes: the observation is a number x, the best action x / 2, a miss costs its square."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, num_envs: int = 16, *, truncates: bool = False) -> None:
        self.num_envs, self.truncates = num_envs, truncates
        self.single_observation_space = Box(-1.0, 1.0, (1,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.seeds: list[Any] = []

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.seeds.append(seed)
        self._rng = np.random.default_rng(seed)
        self._x = self._draw()
        return self._x, {}

    def _draw(self) -> Any:
        return self._rng.uniform(-1.0, 1.0, (self.num_envs, 1)).astype(np.float32)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        n, everywhere = self.num_envs, np.ones(self.num_envs, dtype=bool)
        miss = np.abs(actions - self._x / 2)[:, 0]
        final_obs = np.full(n, None, dtype=object)
        final_obs[:] = list(self._x)
        self._x = self._draw()
        info = {
            "final_obs": final_obs,
            "_final_obs": everywhere,
            "final_info": {"is_success": miss < 2.0, "collisions": np.zeros(n)},
            "_final_info": everywhere,
        }
        ends = np.full(n, not self.truncates), np.full(n, self.truncates)
        return self._x, -(miss**2), *ends, info


def free_states(layout: Layout) -> np.ndarray:
    """``cell_goal`` observations of every free cell with every other goal."""
    n_goals = len(layout.goal_cells)
    cells = np.flatnonzero(layout.reachable.ravel())
    goals = layout.goal_cells[:, 0] * layout.n_cols + layout.goal_cells[:, 1]
    states = cells[:, None] * n_goals + np.arange(n_goals)
    return states[cells[:, None] != goals]


# ---- Planner -----------------------------------------------------------------------------------


def test_the_plan_holds_the_solution_of_each_goal() -> None:
    layout = Layout.from_text("S.#\n..G\n#GG\n")
    task = Task(on_collision="end")

    table = Planner.solve(layout, task, Reward(), gamma=0.9, slip=0.1).action_values.reshape(9, 3, 4)

    for number, goal in enumerate([(1, 2), (2, 1), (2, 2)]):
        expected = GridMDP.of(layout, goal, Reward(), task, gamma=0.9, slip=0.1).solve()
        np.testing.assert_array_equal(table[:, number], expected)


def test_the_plan_goes_a_shortest_way_from_every_cell_to_every_goal() -> None:
    planner = Planner.solve(CLASSIC, Task(), Reward())
    states = free_states(CLASSIC)
    cells, goals = np.divmod(states, len(CLASSIC.goal_cells))
    distance = np.stack([cell_distances(CLASSIC, (r, c)).ravel() for r, c in CLASSIC.goal_cells.tolist()], axis=1)

    reached = MoveTable.of(CLASSIC).next_cell[cells, planner.act(states)]

    np.testing.assert_array_equal(distance[reached, goals], distance[cells, goals] - 1)


def test_the_planner_has_nothing_to_learn() -> None:
    planner = Planner(np.arange(12.0).reshape(3, 4))

    planner.learn(ShortEpisodes(2, terminates=True, truncates=False), steps=100)

    np.testing.assert_array_equal(planner.action_values, np.arange(12.0).reshape(3, 4))


def test_ties_go_to_the_lower_action() -> None:
    assert Planner(np.array([[1.0, 2.0, 2.0, 0.0], [3.0, 3.0, 3.0, 3.0]])).act(np.array([0, 1])).tolist() == [1, 0]


# ---- Q-learning --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_q_learning_finds_the_planners_way_from_every_cell_to_every_goal_of_classic(seed: int) -> None:
    task = Task(starts="any")
    config = QLearningConfig(seed=seed, gamma=Reward().gamma)
    env = GridWorldVectorEnv(config.num_envs, layout=CLASSIC, task=task, max_episode_steps=100)
    agent = QLearning(env.single_observation_space, env.single_action_space, config)

    agent.learn(env, steps=STEPS)

    states = free_states(CLASSIC)
    plan = Planner.solve(CLASSIC, task, Reward()).action_values[states]
    lost = plan.max(axis=1) - plan[np.arange(len(states)), agent.act(states)]
    assert len(states) == 88 * 8 - 8
    assert lost.max() < 1e-6, f"{(lost > 1e-6).sum()} of {len(lost)} states choose a worse move"


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize(
    ("terminates", "truncates", "target"),
    [
        # By hand, reward 1, gamma 0.9, Q(1) = 5, Q(2) = 100 (the next episode's state, which must not count).
        (True, False, 1.0),  # nothing comes after the end
        (False, True, 1.0 + 0.9 * 5.0),  # a truncated episode goes on beyond its last state
        (True, True, 1.0),
        (False, False, 1.0 + 0.9 * 5.0),
    ],
)
def test_q_learning_bootstraps_where_the_task_goes_on_and_nowhere_else(
    num_envs: int, terminates: bool, truncates: bool, target: float
) -> None:
    env = ShortEpisodes(num_envs, terminates=terminates, truncates=truncates)
    config = QLearningConfig(num_envs=num_envs, learning_rate=0.5, gamma=0.9)
    agent = QLearning(env.single_observation_space, env.single_action_space, config)
    agent.action_values[:] = [[3.0], [5.0], [100.0]]

    agent.learn(env, steps=num_envs)

    # By hand: half of the way from 3 to the target, once, however many environments made the same transition.
    assert agent.action_values.tolist() == [[3.0 + 0.5 * (target - 3.0)], [5.0], [100.0]]


def learn_a_little(seed: int) -> np.ndarray:
    """A table after 5,000 steps on ``classic``."""
    env = GridWorldVectorEnv(50, max_episode_steps=100)
    agent = QLearning(env.single_observation_space, env.single_action_space, QLearningConfig(seed=seed, num_envs=50))
    agent.learn(env, steps=5_000)
    return agent.action_values


def test_a_seed_decides_everything_and_no_global_random_state_does() -> None:
    np.random.seed(1)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # type: ignore[index]  # noqa: NPY002
    once = learn_a_little(3)
    after = np.random.get_state()[1].copy()  # type: ignore[index]  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002

    np.testing.assert_array_equal(once, learn_a_little(3))
    np.testing.assert_array_equal(before, after)
    assert not np.array_equal(once, learn_a_little(4))


def test_training_reports_its_steps_and_its_success() -> None:
    reports: list[Progress] = []
    env = ShortEpisodes(4, terminates=True, truncates=False)
    agent = QLearning(env.single_observation_space, env.single_action_space, QLearningConfig(num_envs=4))

    agent.learn(env, steps=402, on_progress=reports.append)

    assert [report.steps for report in reports][-1] == 400  # whole batches of 4, never more than asked for
    assert {report.total_steps for report in reports} == {400}
    assert reports[-1].metrics["success_rate"] == 1.0
    assert reports[-1].metrics["episodes"] == 400
    epsilons = [report.metrics["epsilon"] for report in reports]
    assert epsilons == sorted(epsilons, reverse=True)
    assert epsilons[-1] == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize("spaces", [(Box(0, 1, (2,)), Discrete(4)), (Discrete(9), Box(-1, 1, (2,)))])
def test_q_learning_refuses_spaces_that_have_no_table(spaces: tuple[gym.Space[Any], gym.Space[Any]]) -> None:
    with pytest.raises(ValueError, match="Q-learning needs Discrete spaces"):
        QLearning(*spaces, QLearningConfig())


# ---- Files -------------------------------------------------------------------------------------


def test_tables_come_back_bit_by_bit(tmp_path: Path) -> None:
    table = np.random.default_rng(0).normal(size=(50, 4)) * 10.0 ** np.arange(-8, 8, 4)
    table[0] = [0.0, -0.0, np.nextafter(1.0, 2.0), 1e-308]
    learner = QLearning(Discrete(50), Discrete(4), QLearningConfig(seed=7, learning_rate=0.125))
    learner.action_values = table
    for agent in (learner, Planner(table)):
        directory = tmp_path / agent.kind
        directory.mkdir()
        agent.save(directory)

        loaded = type(agent).load(directory)

        assert loaded.action_values.tobytes() == table.tobytes()
        assert {path.name for path in directory.iterdir()} == {"agent.safetensors", "agent.json"}
    assert QLearning.load(tmp_path / "q-learning").config == learner.config


def test_a_loaded_table_can_go_on_learning(tmp_path: Path) -> None:
    env = ShortEpisodes(1, terminates=True, truncates=False)
    QLearning(Discrete(3), Discrete(1), QLearningConfig(num_envs=1, learning_rate=0.5)).save(tmp_path)

    loaded = QLearning.load(tmp_path)
    loaded.learn(env, steps=1)

    assert loaded.action_values[0, 0] == 0.5


def test_a_file_of_another_kind_of_agent_is_refused(tmp_path: Path) -> None:
    Planner(np.zeros((3, 4))).save(tmp_path)

    with pytest.raises(ValueError, match="holds an agent of kind 'plan', not 'q-learning'"):
        QLearning.load(tmp_path)
    (tmp_path / "agent.json").write_text("{}")
    with pytest.raises(ValueError, match="holds an agent of kind None, not 'plan'"):
        Planner.load(tmp_path)


def test_agents_import_without_torch() -> None:
    """It takes seconds, which the command line would spend on its help page."""
    code = "import sys, gridnav.agents, gridnav.experiment.checkpoint; print('torch' in sys.modules)"

    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert result.stdout.strip() == "False"


# ---- PPO ---------------------------------------------------------------------------------------


def ppo(seed: int = 0, *, env: VectorEnv[Any, Any, Any] | None = None, **changes: Any) -> Any:
    """A small PPO agent for ``Reaching``."""
    from gridnav.agents import PPOAgent, PPOConfig  # torch takes seconds to import: not before a test needs it

    small = {"num_envs": 16, "n_steps": 16, "batch_size": 64, "hidden": (16,), "target_success": None}
    env = env or Reaching()
    config = PPOConfig(seed=seed, **small | changes)
    return PPOAgent(env.single_observation_space, env.single_action_space, config)


def weights(agent: Any) -> dict[str, bytes]:
    """All weights as bytes."""
    return {name: array.tobytes() for name, array in agent.state().arrays.items()}


def test_ppo_learns_where_to_reach() -> None:
    agent = ppo(learning_rate=1e-2, n_epochs=4)
    x = np.linspace(-1.0, 1.0, 21, dtype=np.float32)[:, None]
    untrained = np.abs(agent.act(x) - x / 2).mean()

    agent.learn(Reaching(), steps=4_096)

    assert untrained > 0.2
    assert np.abs(agent.act(x) - x / 2).mean() < 0.08


def test_ppo_acts_the_same_every_time_and_within_the_box() -> None:
    import torch

    agent = ppo()
    x = np.linspace(-1.0, 1.0, 5, dtype=np.float32)[:, None]

    first = agent.act(x)
    torch.manual_seed(99)

    assert first.shape == (5, 1)
    np.testing.assert_array_equal(first, agent.act(x))
    agent.policy.action_net.bias.data += 100.0
    np.testing.assert_array_equal(agent.act(x), np.ones((5, 1)))


def test_a_seed_decides_what_ppo_learns() -> None:
    trained = []
    for seed in (0, 0, 1):
        agent = ppo(seed)
        agent.learn(Reaching(), steps=256)
        trained.append(weights(agent))

    assert trained[0] == trained[1]
    assert trained[0] != trained[2]


def test_ppo_goes_on_from_the_weights_it_has() -> None:
    agent = ppo(learning_rate=1e-12)
    agent.policy.action_net.bias.data += 0.5  # otherwise the seed would bring the same weights again
    before = agent.act(np.ones((1, 1), dtype=np.float32))

    agent.learn(Reaching(), steps=256)

    np.testing.assert_allclose(agent.act(np.ones((1, 1), dtype=np.float32)), before, atol=1e-6)


def test_ppo_comes_back_from_its_files_unchanged(tmp_path: Path) -> None:
    from gridnav.agents import PPOAgent

    agent = ppo(5, hidden=(16, 8))
    agent.learn(Reaching(), steps=256)
    agent.save(tmp_path)

    loaded = PPOAgent.load(tmp_path)

    x = np.linspace(-1.0, 1.0, 50, dtype=np.float32)[:, None]
    assert loaded.act(x).tobytes() == agent.act(x).tobytes()
    assert weights(loaded) == weights(agent)
    assert loaded.config == agent.config
    assert {path.name for path in tmp_path.iterdir()} == {"agent.safetensors", "agent.json"}
    assert json.loads((tmp_path / "agent.json").read_text())["kind"] == "ppo"
    with pytest.raises(ValueError, match="kind 'ppo', not 'plan'"):
        Planner.load(tmp_path)


def test_ppo_stops_when_the_last_episodes_arrived_often_enough() -> None:
    agent, reports = ppo(target_success=0.9), list[Progress]()

    agent.learn(Reaching(), steps=100_000, on_progress=reports.append)

    # By hand: every episode is a success, and the window of 400 is full after 25 steps of 16 environments.
    assert reports[-1].steps == 400
    assert reports[-1].metrics["success_rate"] == 1.0


def test_ppo_refuses_spaces_that_are_no_boxes() -> None:
    from gridnav.agents import PPOAgent, PPOConfig

    with pytest.raises(ValueError, match="PPO here needs Box spaces"):
        PPOAgent(Discrete(5), Discrete(4), PPOConfig())


def test_an_untrained_policy_drives_ahead_and_hidden_numbers_must_exist() -> None:
    from gridnav.agents import PPOAgent, PPOConfig

    seen, told = Box(-1.0, 1.0, (3,), np.float32), Box(-1.0, 1.0, (2,), np.float32)
    agent = PPOAgent(seen, told, PPOConfig(hidden=(8,), initial_forward=0.7))
    np.testing.assert_allclose(agent.act(np.zeros((4, 3), np.float32)), np.tile([0.7, 0.0], (4, 1)), atol=1e-6)
    with pytest.raises(ValueError, match="ignored 3 must be below 3, the observation's length"):
        PPOAgent(seen, told, PPOConfig(ignored=(1, 3)))


def test_a_frame_stack_holds_the_last_observations_and_none_of_the_episode_before() -> None:
    stack = FrameStack(3)

    # By hand: newest first, two robots; before the first observation there was always the same one.
    np.testing.assert_array_equal(stack.begin(np.array([[1.0], [10.0]])), [[1, 1, 1], [10, 10, 10]])
    np.testing.assert_array_equal(stack.push(np.array([[2.0], [20.0]])), [[2, 1, 1], [20, 10, 10]])
    begun = np.array([False, True])
    np.testing.assert_array_equal(stack.push(np.array([[3.0], [30.0]]), begun), [[3, 2, 1], [30, 30, 30]])
    np.testing.assert_array_equal(stack.push(np.array([[4.0], [40.0]])), [[4, 3, 2], [40, 30, 30]])


class Recalling(Reaching):
    """Episodes without an end, in which the best action is half of what was observed one step before."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        observations, info = super().reset(**options)
        self._before = observations
        return observations, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        miss = (actions - self._before / 2)[:, 0]
        self._before, self._x = self._x, self._draw()
        never = np.zeros(self.num_envs, dtype=bool)
        return self._x, -(miss**2), never, never, {}


def test_with_a_stack_ppo_learns_what_one_observation_does_not_say() -> None:
    errors = []
    before, now = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 200, 1)).astype(np.float32)
    for size in (1, 2):
        agent = ppo(learning_rate=1e-2, n_epochs=4, stack_size=size, gamma=0.0)
        agent.learn(Recalling(), steps=8_192)
        act = agent.begin()
        act(before)
        errors.append(np.abs(act(now) - before / 2).mean())

    # By hand: who knows nothing says 0, a quarter off on average.
    assert errors[0] > 0.2
    assert errors[1] < 0.1


def test_a_stacked_policy_acts_on_one_observation_as_at_the_beginning_of_an_episode() -> None:
    agent = ppo(stack_size=3)
    x = np.linspace(-1.0, 1.0, 5, dtype=np.float32)[:, None]

    np.testing.assert_array_equal(agent.act(x), agent.begin()(x))
    np.testing.assert_array_equal(agent.act(x), agent.act(np.repeat(x, 3, axis=1)))
    np.testing.assert_array_equal(agent.values(x), agent.values(np.repeat(x, 3, axis=1)))


def test_weights_are_carried_to_a_network_that_sees_more_and_change_nothing_at_first(tmp_path: Path) -> None:
    from gridnav.agents import PPOAgent

    source, agent = ppo(1), ppo(2, stack_size=3)
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.0, 1.0, (6, 3)).astype(np.float32)

    agent.take_weights(source)

    np.testing.assert_allclose(agent.act(x), source.act(x[:, :1]), atol=1e-6)
    np.testing.assert_allclose(agent.values(x), source.values(x[:, :1]), atol=1e-6)
    agent.save(tmp_path)
    np.testing.assert_array_equal(PPOAgent.load(tmp_path).act(x), agent.act(x))
    with pytest.raises(InputError, match="cannot be carried"):
        source.take_weights(agent)
    with pytest.raises(InputError, match="stack_size 33 of PPOConfig is outside 1 to 32"):
        ppo(stack_size=33)


class Endings(Reaching):
    """One step in which the four environments go on, terminate, truncate, and do both."""

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        observations, rewards, _, _, info = super().step(actions)
        terminated, truncated = np.array([False, True, False, True]), np.array([False, False, True, True])
        info["_final_obs"] = info["_final_info"] = terminated | truncated
        return observations, rewards, terminated, truncated, info


def test_stable_baselines_is_told_which_observation_ended_an_episode_and_whether_by_time() -> None:
    from gridnav.agents.ppo import Sb3VecEnv

    env = Endings(4)
    adapter = Sb3VecEnv(env, reward_scale=10.0)
    before = adapter.reset().copy()

    after, rewards, dones, infos = adapter.step(np.zeros((4, 1), dtype=np.float32))

    assert dones.tolist() == [False, True, True, True]
    assert infos[0] == {}
    for i in (1, 2, 3):
        np.testing.assert_array_equal(infos[i]["terminal_observation"], before[i])
    assert [infos[i]["TimeLimit.truncated"] for i in (1, 2, 3)] == [False, True, False]
    assert not np.array_equal(after, before)
    assert rewards.dtype == np.float32
    np.testing.assert_allclose(rewards, -10.0 * (before[:, 0] / 2) ** 2, rtol=1e-5)


def test_what_ended_an_episode_is_stacked_on_what_came_before_it() -> None:
    from gridnav.agents.ppo import Sb3VecEnv

    env = Endings(4)
    adapter = Sb3VecEnv(env, stack_size=2)
    first = adapter.reset()[:, :1].copy()

    after, _, _, infos = adapter.step(np.zeros((4, 1), dtype=np.float32))

    np.testing.assert_array_equal(after[0, 1:], first[0])
    for i in (1, 2, 3):  # by hand: the final observation, which is the first one here, and the first one
        np.testing.assert_array_equal(infos[i]["terminal_observation"], [*first[i], *first[i]])
        assert after[i, 0] == after[i, 1]


def test_stable_baselines_does_not_write_into_the_info_that_environments_share() -> None:
    from gridnav.agents.ppo import Sb3VecEnv

    env = Endings(4)
    agent = ppo(env=env, num_envs=4, n_steps=8, batch_size=16)
    agent.learn(env, steps=64)
    adapter = Sb3VecEnv(env)
    adapter.reset()

    assert adapter.step(np.zeros((4, 1), dtype=np.float32))[3][0] == {}


def test_a_seed_is_used_for_the_next_reset_alone() -> None:
    from gridnav.agents.ppo import Sb3VecEnv

    env = Reaching(4)
    adapter = Sb3VecEnv(env)
    adapter.seed(7)
    adapter.reset()
    adapter.reset()

    assert env.seeds == [7, None]


def test_ppo_values_a_truncated_episode_beyond_its_end_and_a_terminated_one_not() -> None:
    """Every step costs about as much in both; only what goes on after its time limit adds up to many of them."""
    import torch

    values = []
    for truncates in (False, True):
        agent = ppo(learning_rate=1e-2, n_epochs=4, gamma=0.9, ent_coef=0.0)
        agent.learn(Reaching(truncates=truncates), steps=4_096)
        with torch.no_grad():
            values.append(float(agent.policy.predict_values(torch.zeros(1, 1))))

    assert values[1] < 5 * values[0] < 0.0


def test_the_success_rate_is_not_known_before_every_environment_has_ended_an_episode() -> None:
    """Successes end early and failures at the time limit: the first to end would tell of the good ones alone."""
    window = EpisodeWindow()
    ended = {"is_success": np.array([True, False]), "collisions": np.array([0, 2])}

    window.add({"final_info": ended, "_final_info": np.array([True, False])})
    assert np.isnan(window.metrics["success_rate"])
    assert window.metrics["episodes"] == 1

    window.add({})
    window.add({"final_info": ended, "_final_info": np.array([False, True])})
    assert window.metrics == {"success_rate": 0.5, "collision_rate": 0.5, "episodes": 2.0, "physics_errors": 0.0}


def test_diverged_physics_is_counted_and_part_of_the_windows_state() -> None:
    window = EpisodeWindow()
    ended = {"is_success": np.zeros(3, bool), "collisions": np.zeros(3), "physics_error": np.array([True, False, True])}

    # By hand: the third robot's physics diverged too, but its episode is not among those that ended.
    window.add({"final_info": ended, "_final_info": np.array([True, True, False])})

    assert window.metrics["physics_errors"] == 1.0
    assert window.metrics["episodes"] == 2.0
    again = EpisodeWindow.from_state(json.loads(json.dumps(window.state())))
    assert again.state() == window.state()
