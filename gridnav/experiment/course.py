"""The course of one training: where it stands, and its checkpoints, by the clock and on request."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from typing import Any, Self

import numpy as np

from gridnav.agents import Agent, OnProgress, Progress
from gridnav.envs import LayoutMix, NavigationVectorEnv, WrappedWorlds
from gridnav.experiment.checkpoint import Checkpoint, Standing, save_checkpoint
from gridnav.experiment.greedy_curve import SUCCESS, GreedyCurve
from gridnav.experiment.live import Watch
from gridnav.experiment.run_directory import MetricsLog, RunDirectory
from gridnav.experiment.validation import Validation
from gridnav.problem.types import InputError, IntArray, State

CHECKPOINT_S = 10.0
"""Seconds between two checkpoints of a training."""
CHECKPOINT_SHARE = 0.01
"""Of the time of a training that its checkpoints may take: where one takes long, the next one waits longer."""
UNFIT = LookupError, TypeError, ValueError, AttributeError, RuntimeError, OverflowError
"""What comes of a checkpoint whose parts are whole and do not belong together."""


Worlds = NavigationVectorEnv | LayoutMix | WrappedWorlds
"""Where an agent may learn."""


class Course:
    """One agent's training, from its beginning or from where a checkpoint left it.

    Args:
        name: Series of the metrics and name of the checkpoints.
        agent: Who learns; afterwards who is kept.
        worlds: Where.
        validation: Judges its policies; without it the last one is kept.
        before: Where the run stands.
        saved: The checkpoint that is continued, if one is.
        run: Where checkpoints go.
        log: Where metrics go.
        report: Told of the progress.
        checkpoint_s: Seconds between two checkpoints; 0 makes one at every opportunity.
        watch: Looks at the agent whenever it likes.
        curve: Measures its greedy policies, where arms are compared.
    """

    def __init__(
        self,
        name: str,
        agent: Agent,
        worlds: Worlds,
        validation: Validation | None,
        before: Standing,
        saved: Checkpoint | None,
        run: RunDirectory,
        log: MetricsLog,
        report: OnProgress,
        checkpoint_s: float,
        watch: Watch | None = None,
        curve: GreedyCurve | None = None,
    ) -> None:
        self._watch, self._curve = watch, curve
        self._name, self.agent, self._worlds, self._validation = name, agent, worlds, validation
        self._before, self._saved = before, saved
        self._run, self._log, self._report = run, log, report
        self._clock, self._interruption = Clock(checkpoint_s), Interruption()
        self._steps, self._n_cuts = before.steps, 0
        self.visits: IntArray | None = None if saved is None else saved.visits
        """How often a robot was seen in each cell; none in a mix of layouts."""
        self._robots = worlds.unwrapped
        if saved is None and isinstance(self._robots, NavigationVectorEnv):
            self.visits = np.zeros(self._robots.layout.walls.shape, dtype=np.int64)

    def go(self, steps: int) -> Standing:
        """Train until ``steps`` environment steps are taken in all, and make the last checkpoint.

        Returns:
            Where the run stands then.

        Raises:
            InputError: When the checkpoint does not fit the training.
            KeyboardInterrupt: After a checkpoint, when the process was asked to stop.
            NonFiniteError: When a NaN or infinity came up; the last checkpoint is from before.
        """
        if self._watch is not None:  # what it can do before it learns is no part of its time
            self._watch(self.agent, self._steps)
        self._began = time.perf_counter()
        resume = None if self._saved is None else self._saved.training
        with self._interruption:
            try:
                self.agent.learn(
                    self._worlds, steps=steps, on_progress=self._on_progress, on_cut=self._on_cut, resume=resume
                )
            except UNFIT as error:
                # Until a first piece of training is through, it is the checkpoint's fault.
                if self._saved is None or self._n_cuts > 1:
                    raise
                words = f"the checkpoint of {self._name!r} does not fit its training: {error!r:.100}"
                raise InputError(words) from error
            self._measure()
            if self._validation is not None:
                self._judge(self._validation)
                self.agent = self._validation.best()
            end = self._standing(is_finished=True)
            self._save(end, None, None)
            if self._interruption.is_asked:
                raise KeyboardInterrupt
        return end

    def _on_progress(self, progress: Progress) -> None:
        self._steps = progress.steps
        metrics = dict(progress.metrics)
        if isinstance(self._robots, NavigationVectorEnv | LayoutMix):
            strength = self._robots.curriculum_strength
            metrics |= {} if strength is None else {"curriculum_strength": strength}
        self._log.add(self._name, progress.steps, metrics)
        self._report(progress)

    def _on_cut(self, training: Callable[[], State]) -> None:
        self._n_cuts += 1
        is_saved = self._saved is not None and self._n_cuts == 1  # it is the cut that the checkpoint was made at
        if not is_saved and (self._clock.is_due or self._interruption.is_asked):
            with self._clock:
                self._save(self._standing(is_finished=False), training(), self._worlds.get_state())
        if self._interruption.is_asked:
            raise KeyboardInterrupt
        if self._watch is not None:
            self._watch(self.agent, self._steps)
        # After the checkpoint, for a continued training comes by here again.
        if self._validation is not None and self._validation.is_due(self._steps):
            self._judge(self._validation)
        self._measure()
        if self.visits is not None and isinstance(self._robots, NavigationVectorEnv):
            np.add.at(self.visits, tuple(self._robots.cells.T), 1)

    def _measure(self) -> None:
        """A point of the curve, if one is due; the log, cut back as the training is, says which ones there are."""
        measured = self._log.curve(self._name, SUCCESS)[0]
        if self._curve is not None and self._curve.is_due(self._steps, int(measured[-1]) if measured else -1):
            self._log.add(self._name, self._steps, self._curve.measure(self.agent))

    def _judge(self, validation: Validation) -> None:
        self._log.add(self._name, self._steps, validation.judge())

    def _standing(self, *, is_finished: bool) -> Standing:
        before = self._before
        looked = 0.0 if self._curve is None else self._curve.seconds
        seconds = before.seconds + time.perf_counter() - self._began - looked
        run_steps = before.run_steps + self._steps - before.steps
        return Standing(self._steps, seconds, run_steps, self._log.sync(), is_finished)

    def _save(self, standing: Standing, training: State | None, worlds: State | None) -> None:
        validation = None if training is None or self._validation is None else self._validation.state()
        checkpoint = Checkpoint(self.agent, standing, training, worlds, self.visits, validation)
        save_checkpoint(self._run.checkpoints, self._name, checkpoint)


def bring_back(worlds: Worlds, saved: Checkpoint, name: str) -> None:
    """Put worlds where a checkpoint left them.

    Raises:
        InputError: When it is not one of such worlds.
    """
    try:
        if saved.worlds is None or saved.training is None:
            raise InputError("it holds no training to go on with")
        worlds.set_state(saved.worlds)
        robots = worlds.unwrapped
        if saved.visits is not None and isinstance(robots, NavigationVectorEnv):
            np.add.at(saved.visits, tuple(robots.cells.T), 0)  # fails unless it is a map of this layout
    except UNFIT as error:
        raise InputError(f"the checkpoint of {name!r} does not fit its worlds: {error!r:.100}") from error


class Interruption:
    """SIGINT and SIGTERM as a request, which training answers at its next cut; a second one ends it at once."""

    is_asked = False

    def __enter__(self) -> Self:
        self._before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, *_: object) -> None:
        if self.is_asked:
            raise KeyboardInterrupt
        self.is_asked = True


class Clock:
    """When the next checkpoint is due; a context around the making of one."""

    def __init__(self, period_s: float) -> None:
        self._period_s, self._due = period_s, time.perf_counter()

    @property
    def is_due(self) -> bool:
        """It is time for one."""
        return time.perf_counter() >= self._due

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        now = time.perf_counter()
        wait = max(self._period_s, (now - self._began) / CHECKPOINT_SHARE) if self._period_s else 0.0
        self._due = now + wait
