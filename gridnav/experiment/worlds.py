"""What is to be solved, and the worlds to solve it in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym

from gridnav.envs import PARAMETERS, LayoutMix, NavigationVectorEnv, Randomization
from gridnav.problem.layout import Layout
from gridnav.problem.random_layouts import RandomLayouts
from gridnav.problem.reward import Reward
from gridnav.problem.task import Task

NOTHING_VARIES = Randomization()
UNITS = {name: "" if one.unit == "1" else one.unit for name, one in PARAMETERS.items()}
"""Of what a randomization draws, by quantity."""
RANDOM = "random"
"""Name of the family of random layouts, where a layout's name is asked for."""


@dataclass(frozen=True)
class Problem:
    """Layout, task and reward, the same in every world."""

    layout: Layout
    task: Task
    reward: Reward
    family: RandomLayouts | None = None
    """Layouts that training draws from; evaluation is in held-out ones, of which ``layout`` is the first."""
    randomization: Randomization = NOTHING_VARIES
    """What varies of robots, senses and mazes."""

    @classmethod
    def load(cls, layout: str, task: str, reward: str, randomization: str = "none") -> Problem:
        """From names (and a path or text for the layout).

        Raises:
            InputError: When one of them is unknown or wrong.
        """
        family = RandomLayouts() if layout == RANDOM else None
        maze = family.held_out(1)[0] if family else Layout.load(layout)
        return cls(maze, Task.load(task), Reward.load(reward), family, Randomization.load(randomization))

    @property
    def for_evaluation(self) -> Problem:
        """The same with mazes that stay as they are, so that everybody meets the same starts, goals and walls.

        Of a curriculum it is the whole ranges.
        """
        of_mazes = [name for name, parameter in PARAMETERS.items() if parameter.acts_on == "layout"]
        return replace(self, randomization=replace(self.randomization.without(*of_mazes), curriculum=False))

    def worlds(
        self,
        world: str,
        num_envs: int,
        *,
        observation: str = "cell_goal",
        layout: Layout | None = None,
        **options: Any,
    ) -> NavigationVectorEnv:
        """Robots that play this problem, in its layout or in another one; other options go to the environments."""
        if world != "GridWorld":
            options = {"randomization": self.randomization} | options
        return make_worlds(
            world, num_envs, layout=layout or self.layout, task=self.task, reward=self.reward,
            **_grid_options(world, observation), **options,
        )  # fmt: skip

    def training_worlds(
        self, world: str, num_envs: int, *, observation: str = "cell_goal", exploring_starts: float = 0.0
    ) -> NavigationVectorEnv | LayoutMix:
        """Robots to learn with, in layouts that change where there is a family.

        Args:
            world: ``GridWorld``, ``Unicycle`` or ``DiffDrive``.
            num_envs: How many.
            observation: What an agent of the grid sees.
            exploring_starts: Share of the episodes that begin anywhere; on the grid all of them, if it is not 0.
        """
        on_grid = world == "GridWorld"
        problem = replace(self, task=replace(self.task, starts="any")) if exploring_starts and on_grid else self
        options = {} if on_grid else {"exploring_starts": exploring_starts}

        def worlds(layout: Layout, n: int) -> NavigationVectorEnv:
            return problem.worlds(world, n, observation=observation, layout=layout, **options)

        if self.family is not None:
            return LayoutMix(worlds, num_envs, self.family.draw)
        if not on_grid and self.randomization.acts_on("layout"):
            # Every reset varies the layout, which is this one to begin with.
            return LayoutMix(worlds, num_envs, lambda _: self.layout)
        return worlds(self.layout, num_envs)


def make_worlds(world: str, num_envs: int, **options: Any) -> NavigationVectorEnv:
    """The vector form of ``GridWorld``, ``Unicycle`` or ``DiffDrive``, with its usual time limit."""
    worlds = gym.make_vec(f"gridnav/{world}-v0", num_envs=num_envs, **options)
    assert isinstance(worlds, NavigationVectorEnv)
    return worlds


def _grid_options(world: str, observation: str) -> dict[str, Any]:
    """What the grid alone is told: robots observe features and nothing else."""
    return {"observation": observation} if world == "GridWorld" else {}
