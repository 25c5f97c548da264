"""The command line; the only module that prints.

Exit codes: 0 done, 1 the lint found a fault, 2 bad input (one line on stderr, nothing written), 3 environment (disk,
lock, display, driver), 4 training stopped at numbers that are not finite, 130 interrupted with a checkpoint written.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro
from joblib import cpu_count
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from gridnav.agents import OnProgress
from gridnav.agents import Progress as Learning
from gridnav.display.viewer import ViewerError
from gridnav.envs import Randomization, RenderingError
from gridnav.experiment.checkpoint import clear_leftovers
from gridnav.experiment.course import CHECKPOINT_S
from gridnav.experiment.run_directory import CONFIG, RESULT, RunDirectory, read_json, write_json
from gridnav.experiment.training import BUDGETS, BudgetName, Job, OnStage, Result, Training
from gridnav.experiment.worlds import RANDOM, Problem
from gridnav.problem.layout import NAMED_LAYOUTS, Layout
from gridnav.problem.reward import Reward
from gridnav.problem.task import Task
from gridnav.problem.types import InputError, NonFiniteError

if TYPE_CHECKING:
    from gridnav.experiment.across_seeds import AcrossSeeds
    from gridnav.experiment.arms import Arm
    from gridnav.experiment.live import Spectator
    from gridnav.experiment.sweeps.sweep import Outcome, Trial

Config = TypeVar("Config")
stderr = Console(stderr=True, highlight=False, soft_wrap=True)
TABLE_WIDTH = 132
"""Columns of the results where the output goes to a file or pipe."""
stdout = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else TABLE_WIDTH)


# ---- The commands and their flags --------------------------------------------------------------


@dataclass(frozen=True)
class _Run:
    """Flags of the commands that make a run."""

    budget: BudgetName = "default"
    """quick: a first look; default: the real thing; full: more of everything."""
    layout: str = "classic"
    """A named layout, a text file, a text, or random: training on many, evaluation on others."""
    task: str = "default"
    """Starts, goals and what a collision does: default, any or fragile."""
    reward: str = "default"
    """default, fragile (for the task of that name) or seed (the tutorial's)."""
    randomization: str = "none"
    """What varies of robots and senses: none, burger, wide, force-only, curriculum, a JSON file or JSON text."""
    seed: int = 0
    """Of everything that is random in training."""
    run_dir: Path | None = None
    """Where the run's files go; runs/<run-id> below the current folder by default."""
    resume: bool = False
    """Go on with the run in --run-dir where it was stopped or killed; its config says the rest."""
    checkpoint_s: float = CHECKPOINT_S
    """Seconds between two checkpoints of a training; 0 makes one at every opportunity."""
    config: Path | None = None
    """A run's config.json: makes that run again; flags after it change it."""
    live: bool = False
    """Show in a Rerun viewer what the agent can do by now, while it learns."""
    live_s: float = 20.0
    """Seconds between two episodes of --live, at least; watching takes no more than 2 % of the time."""
    live_port: int = 0
    """Port of a Rerun viewer that runs on this machine already; by default --live opens a window."""

    def _problem(self) -> tuple[Problem, dict[str, Any]]:
        """The problem, and the configuration as JSON values that need no other file."""
        if not 0 <= self.seed < 2**32:
            raise InputError(f"--seed {self.seed} is outside 0 to 4294967295")
        if not 0 <= self.live_s <= 86_400:
            raise InputError(f"--live-s {self.live_s} is outside 0 to 86400 seconds")
        if not 0 <= self.live_port < 65536:
            raise InputError(f"--live-port {self.live_port} is outside 0 to 65535")
        if not 0 <= self.checkpoint_s <= 86_400:
            raise InputError(f"--checkpoint-s {self.checkpoint_s} is outside 0 to 86400 seconds")
        problem = Problem.load(self.layout, self.task, self.reward, self.randomization)
        layout = self.layout if self.layout in (*NAMED_LAYOUTS, RANDOM) else problem.layout.to_text()
        varied = Randomization.inlined(self.randomization)
        config = asdict(replace(self, layout=layout, randomization=varied, **OF_ONE_START))
        config = {key: value for key, value in config.items() if key not in OF_ONE_START and value is not None}
        if varied == "none":
            del config["randomization"]
        command = {kind: name for name, kind in COMMANDS.items()}[type(self)]
        return problem, json.loads(json.dumps({"command": command, **config}))

    def _spectator(self, problem: Problem) -> Spectator | None:
        """Who watches, in a viewer that is opened for it or runs already."""
        if not self.live and not self.live_port:
            return None
        from gridnav.display.viewer import address_of, open_empty_window
        from gridnav.experiment.live import Spectator

        return Spectator(problem, address_of(self.live_port or open_empty_window()), self.live_s)

    def _job(self, problem: Problem, config: Mapping[str, Any], run: RunDirectory, on_stage: OnStage) -> Job:
        """What is to be made, with the spectator's window open."""
        return Job(
            problem, BUDGETS[self.budget], self.seed, run, on_stage, config, _again(run), self.checkpoint_s,
            self._spectator(problem),
        )  # fmt: skip

    def _directory(self, name: str, config: dict[str, Any]) -> contextlib.AbstractContextManager[RunDirectory]:
        return _directory(self.run_dir, self.resume, name, config)


@contextlib.contextmanager
def _directory(path: Path | None, resume: bool, name: str, config: dict[str, Any]) -> Iterator[RunDirectory]:
    """The run's directory, this process's own: a new one, or the one to go on with."""
    if not resume or path is None or not (path / CONFIG).is_file():
        if resume and path is None:
            raise InputError("--resume needs --run-dir: the run to go on with")
        if resume:
            stderr.print(f"nothing to resume in {str(path)!r}: starting from the beginning", markup=False)
        with RunDirectory.create(path, name, config) as run:
            yield run
        return
    run = RunDirectory.open(path)
    stored = run.read_config()
    for key in stored.keys() | config.keys():
        if stored.get(key) != config.get(key):
            flag = f"--{key.replace('_', '-')}"
            raise InputError(
                f"{flag} {config.get(key)!r:.60} is not what {str(path)!r} was begun with "
                f"({stored.get(key)!r:.60}): leave it out, or begin another run"
            )
    with run.own():
        clear_leftovers(run.checkpoints)
        yield run


@dataclass(frozen=True)
class Ladder(_Run):
    """Climb from a plan on the grid to a MuJoCo robot and measure every rung."""

    arms: str | None = None
    """Compare these ways to carry something to the robot instead: scratch,waypoint,potential,clone,kickstart,weights,
    residual or some of them."""

    def checked(self) -> tuple[Problem, dict[str, Any]]:
        """The problem, and the configuration as JSON values that need no other file, once all is known to be right."""
        arms = self._arms()
        problem, config = self._problem()
        if problem.family is not None:
            raise InputError(
                "the ladder needs one maze: its plan and its table are of one; train ppo on random layouts"
            )
        if arms and problem.randomization.acts_on("layout"):
            raise InputError(
                f"--randomization {self.randomization!r:.60} varies the maze, and what arms carry over is of one: "
                "leave the quantities of mazes out"
            )
        return problem, config

    def __call__(self) -> int:
        """Run it."""
        from gridnav.experiment.ladder import climb, compare

        problem, config = self.checked()
        arms = self._arms()
        with self._directory("ladder", config) as run, _progress() as on_stage:
            job = self._job(problem, config, run, on_stage)
            results = compare(job, arms) if arms else climb(job)
        _show(results, run)
        return 0

    def _arms(self) -> dict[str, Arm]:
        """The arms to compare, if any are."""
        from gridnav.experiment.arms import choose_arms

        return choose_arms(self.arms) if self.arms is not None else {}


@dataclass(frozen=True)
class Train(_Run):
    """Train and evaluate one agent in one world, or compare all that act on the grid."""

    agent: Literal["plan", "q-learning", "dqn", "ppo", "all"] = "q-learning"
    """Who learns: plan is value iteration and needs no learning; all trains and compares those of the grid."""
    env: Literal["gridnav/GridWorld-v0", "gridnav/Unicycle-v0", "gridnav/DiffDrive-v0"] | None = None
    """Where; DiffDrive for ppo and GridWorld for the others by default."""
    observation: Literal["cell_goal", "cell", "features"] = "cell_goal"
    """What an agent of the grid sees: its cell and the goal, its cell alone, or what the robots see."""
    preset: str = ""
    """Named hyper-parameters of the agent; by default those made for what it observes."""
    set: tuple[str, ...] = ()
    """Hyper-parameters that differ from the preset, such as double=false batch_size=64."""

    def checked(self) -> tuple[Problem, dict[str, Any]]:
        """The problem, and the configuration as JSON values that need no other file, once all is known to be right."""
        problem, config = self._problem()
        Training.of(config, problem)
        return problem, config

    def __call__(self) -> int:
        """Run it."""
        from gridnav.experiment.results import train_and_report

        problem, config = self.checked()
        training = Training.of(config, problem)
        with self._directory(f"train-{self.agent}", config) as run, _progress() as on_stage:
            results = train_and_report(self._job(problem, config, run, on_stage), training)
        _show(results, run)
        return 0


OF_ONE_START: dict[str, Any] = {
    "run_dir": None, "resume": False, "checkpoint_s": CHECKPOINT_S, "config": None, "live": False, "live_s": 20.0,
    "live_port": 0,
}  # fmt: skip
"""Flags that are no part of a run's configuration: two starts of one run may differ in them."""


@dataclass(frozen=True)
class Sweep:
    """Do many trials and put them into one table; flags of train or ladder say what all trials have in common."""

    study: Literal["", "arms", "presets", "default", "leave-one-out", "one-at-a-time", "strength"] = ""
    """A ready-made sweep with a report: what transfer saves, PPO under each randomization, both (default), which part
    of a randomization training needs; or, of finished --runs, success against each quantity or all together."""
    seeds: int | None = None
    """Trainings of each kind of a study, with the seeds 0, 1, ...: 3 by default, 10 with --budget full."""
    runs: tuple[Path, ...] = ()
    """Finished runs that one-at-a-time and strength evaluate, which also take --randomization and --episodes."""
    quantities: tuple[str, ...] = ()
    """Of the randomization, for leave-one-out, one-at-a-time and strength; or drive, physics, command, sense."""
    randomizations: tuple[str, ...] = ()
    """What the study presets compares, such as none wide mine.json slow='{"command_delay_s": [0.1, 0.3]}'; all presets
    by default."""
    grid: tuple[str, ...] = ()
    """Fields with the values to combine, such as seed=0,1,2 set.learning_rate=0.001,0.003 layout=classic,u-trap."""
    random: tuple[str, ...] = ()
    """Fields to draw: set.gamma=uniform:0.9:1, set.learning_rate=log:1e-4:1e-2, set.n_steps=int:8:64, agent=dqn,ppo."""
    n_trials: int = 20
    """Draws of --random; each meets every combination of --grid."""
    design_seed: int = 0
    """Of what --random draws."""
    trial: Literal["train", "ladder"] = "train"
    """What a trial does."""
    jobs: int | None = None
    """Trials at once; as many as there are cores by default."""
    backend: Literal["local", "ray"] = "local"
    """Where trials are done: on this machine, or on the Ray cluster that it belongs to."""
    checkpoint_s: float = CHECKPOINT_S
    """Seconds between two checkpoints of a training; 0 makes one at every opportunity."""
    run_dir: Path | None = None
    """Where the files go; runs/<run-id> below the current folder by default."""
    resume: bool = False
    """Go on with the sweep in --run-dir where it was stopped or killed; its config says the rest."""
    config: Path | None = None
    """A sweep's config.json: makes that sweep again; flags after it change it."""
    common: Annotated[tuple[str, ...], tyro.conf.Suppress] = ()
    """The flags of the command that a trial does, as words."""

    def __call__(self) -> int:
        """Run it."""
        from gridnav.experiment.sweeps.sweep import TABLE, carry_out
        from gridnav.experiment.workers import check_backend

        jobs = cpu_count() if self.jobs is None else self.jobs
        if not 1 <= jobs <= 1024:
            raise InputError(f"--jobs {jobs} is outside 1 to 1024")
        check_backend(self.backend)
        trials, config = self._study() if self.study else self._plan()
        with (
            _directory(self.run_dir, self.resume, self.study or "sweep", config) as run,
            _trials_bar(len(trials)) as bar,
        ):
            outcomes = carry_out(
                trials, run, jobs=jobs, backend=self.backend, checkpoint_s=self.checkpoint_s, on_done=bar
            )
        _show_sweep(trials, outcomes)
        stdout.print(f"table      {run.path / TABLE}")
        if self.study:
            from gridnav.experiment.sweeps.findings import write_study

            with _progress() as on_stage:
                sentence = write_study(
                    self.study,
                    trials,
                    outcomes,
                    run,
                    on_stage,
                    jobs=min(jobs, cpu_count()),
                    command=_again(run),
                    config=config,
                )
            stdout.print(f"report     {run.report}\n{sentence}", markup=False)
        return 0

    def _plan(self) -> tuple[list[Trial], dict[str, Any]]:
        """The trials, each checked as its command would, and the configuration of them all."""
        from gridnav.experiment.sweeps.design import settings_of
        from gridnav.experiment.sweeps.sweep import Trial

        if not self.grid and not self.random:
            raise InputError("a sweep needs something to vary: --grid seed=0,1,2, --random FIELD=LAW or --study NAME")
        self._leave_out("seeds", "runs", "quantities", "randomizations", because="is for a --study")
        if not 0 <= self.design_seed < 2**32:
            raise InputError(f"--design-seed {self.design_seed} is outside 0 to 4294967295")
        shared = self._shared(self.trial)
        settings = settings_of(self.grid, self.random, n_draws=self.n_trials, seed=self.design_seed)
        trials = [
            Trial(number, one, _checked(self.trial, _with_settings(shared, one, self.trial)))
            for number, one in enumerate(settings)
        ]
        return trials, self._config(shared)

    def _study(self) -> tuple[list[Trial], dict[str, Any]]:
        """The same of a study."""
        from gridnav.experiment.sweeps.studies import EVALUATING, Wish, plan
        from gridnav.experiment.sweeps.sweep import Trial

        self._leave_out("grid", "random", "n_trials", "design_seed", "trial", because="goes without --study")
        if self.study not in ("presets", "default"):
            self._leave_out("randomizations", because="is for the studies presets and default")
        evaluates = self.study in EVALUATING
        if evaluates:
            self._leave_out("seeds", because="is for studies that train")
            finished = _parse(_Finished, f"sweep --study {self.study}", list(self.common))
            if not 1 <= finished.episodes <= 100_000:
                raise InputError(f"--episodes {finished.episodes} is outside 1 to 100000")
            varied = Randomization.inlined(finished.randomization) if finished.randomization else ""
            shared = json.loads(json.dumps(asdict(replace(finished, randomization=varied))))
            wish = Wish((), finished.randomization, self.quantities, runs=self.runs, episodes=finished.episodes)
        else:
            self._leave_out("runs", because="is for the studies one-at-a-time and strength")
            shared = self._shared("ladder" if self.study in ("arms", "default") else "train")
            seeds = (10 if shared["budget"] == "full" else 3) if self.seeds is None else self.seeds
            if not 1 <= seeds <= 1000:
                raise InputError(f"--seeds {seeds} is outside 1 to 1000")
            self._refuse_what_the_study_decides(shared)
            arms = shared.get("arms") or ""
            wish = Wish(range(seeds), shared.get("randomization", ""), self.quantities, self.randomizations, arms)
        trials = []
        for number, draft in enumerate(plan(self.study, wish)):
            config = draft.fields
            if not evaluates:
                names = {field.name for field in fields(COMMANDS[draft.command])}  # type: ignore[arg-type]
                own = {key: value for key, value in shared.items() if key in names}
                changes = [*own.get("set", ()), *draft.fields.get("set", ())]
                config = _checked(draft.command, {**own, **draft.fields, **({"set": changes} if changes else {})})
            trials.append(Trial(number, draft.settings, config, draft.under))
        return trials, self._config(shared)

    def _refuse_what_the_study_decides(self, shared: Mapping[str, Any]) -> None:
        if shared["seed"] != 0:
            raise InputError(f"--seed {shared['seed']}: a study takes the seeds 0, 1, ...; say how many with --seeds")
        if shared.get("agent", "ppo") not in ("ppo", Train.agent):
            raise InputError(f"--agent {shared['agent']}: the study trains ppo, leave it out")
        if self.study == "presets" and "randomization" in shared:
            raise InputError("--randomization is one for all: leave it out, or name several as --randomizations")
        if self.study == "leave-one-out" and "--randomization" in self.common and "randomization" not in shared:
            raise InputError("--randomization none: nothing varies there, so nothing can be left out")

    def _shared(self, command: str) -> dict[str, Any]:
        """What all trials of a command have in common, as its configuration."""
        common = _parse(COMMANDS[command], command, list(self.common))
        alone = [key for key, default in OF_ONE_START.items() if getattr(common, key) != default]
        if alone:
            raise InputError(f"--{alone[0].replace('_', '-')} is for one run: leave it out of the sweep")
        config: dict[str, Any] = common._problem()[1]
        return {key: value for key, value in config.items() if key != "command"}

    def _config(self, shared: Mapping[str, Any]) -> dict[str, Any]:
        own = {name: value for name in OF_A_SWEEP if (value := getattr(self, name)) != getattr(Sweep, name)}
        if self.runs:
            own["runs"] = [str(path.resolve()) for path in self.runs]
        if self.randomizations:
            from gridnav.experiment.sweeps.studies import compared

            named = compared(self.randomizations)
            own["randomizations"] = [name if name == what else f"{name}={what}" for name, what in named.items()]
        return json.loads(json.dumps({"command": "sweep", **shared, **own}))

    def _leave_out(self, *names: str, because: str) -> None:
        for name in names:
            if getattr(self, name) != getattr(Sweep, name):
                raise InputError(f"--{name.replace('_', '-')} {because}: leave it out")


@dataclass(frozen=True)
class _Finished:
    """Flags of studies of finished runs."""

    randomization: str = ""
    """What varies: a preset, a JSON file or JSON text; by default what varied in training, or else burger."""
    episodes: int = 200
    """Of each evaluation."""


OF_A_SWEEP = (
    "study", "seeds", "runs", "quantities", "randomizations", "trial", "grid", "random", "n_trials", "design_seed",
)  # fmt: skip
"""Flags of a sweep that are part of its configuration, beside those that its trials have in common."""


@dataclass(frozen=True)
class Evaluate:
    """Evaluate the agents of one or several runs again, on fixed seeds; several seeds are put together."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run directories."""
    episodes: int = 200
    """How many, for each agent."""
    seed: int | None = None
    """Of starts, goals and headings; that of every evaluation by default."""
    output: Path | None = None
    """A JSON file for all metrics and one row per episode."""
    figure: Path | None = None
    """A picture, .png or .svg, of the runs' learning curves with intervals over seeds."""
    randomization: str | None = None
    """What varies of robots and senses, as for train; what varied in training by default."""
    reality: tuple[Literal["parametric", "structural", "test"], ...] = ()
    """Measure what the agents keep of their success in these worlds, which training never sees; test is sealed."""
    report: Path | None = None
    """An .html page for --reality: the question, the answer, a table and a figure."""
    keep: Path | None = None
    """A new folder for the episodes in the realities, as a run that view and video show; not of the sealed one."""

    def __call__(self) -> int:
        """Run it."""
        from gridnav.experiment.across_seeds import across_seeds, compared_curves
        from gridnav.experiment.results import evaluate_again, evaluation, stored_evaluation

        if not self.runs:
            raise InputError("evaluate needs the folder of at least one run")
        if self.episodes < 1:
            raise InputError(f"--episodes {self.episodes} must be at least 1")
        if self.seed is not None and self.seed < 0:
            raise InputError(f"--seed {self.seed} must be at least 0")
        for flag, file in (("--output", self.output), ("--figure", self.figure)):
            if file is not None:
                _check_folder(flag, file)
        if self.figure is not None and self.figure.suffix not in (".png", ".svg"):
            raise InputError(f"--figure {str(self.figure)!r} must end with .png or .svg")
        if self.report is not None:
            _check_ending("--report", self.report, ".html")
        if (self.report or self.keep) and not self.reality:
            raise InputError("--report and --keep go with --reality: say which")
        if self.reality and (self.randomization or self.figure or self.seed is not None):
            raise InputError("--randomization, --figure and --seed do not go with --reality: leave them out")
        if self.keep is not None:
            RunDirectory(self.keep).check_free()
        if self.keep is not None and set(self.reality) == {"test"}:
            raise InputError(
                "--keep has nothing to keep: no episode of the test reality is shown; name another one too"
            )
        runs = [RunDirectory.open(path) for path in self.runs]
        for run in runs:
            stored_evaluation(run)  # says that it is not whole before minutes are spent on the others
        if self.reality:
            return self._measure_gaps(runs)
        with _progress() as on_stage:
            results = [
                (run, evaluate_again(run, self.episodes, self.seed, on_stage, randomization=self.randomization))
                for run in runs
            ]
        together = across_seeds(results) if len(runs) > 1 else []
        curves = None if self.figure is None else compared_curves(results)
        if self.output is not None:
            own = {str(run.path): evaluation(one) for run, one in results}
            content: dict[str, Any] = {"results": next(iter(own.values()))} if len(own) == 1 else {"runs": own}
            write_json(self.output, content | ({"across_seeds": [asdict(row) for row in together]} if together else {}))
        if self.figure is not None and curves is not None:
            from gridnav.display.figures import save_figure  # matplotlib takes a second to import

            save_figure(curves, self.figure)
        for run, one in results:
            _show(one, None, title=str(run.path) if len(runs) > 1 else "")
        if together:
            _show_together(together)
        return 0

    def _measure_gaps(self, runs: Sequence[RunDirectory]) -> int:
        """Every agent at home and in the realities."""
        from gridnav.experiment import sim_to_real

        if self.keep is not None:
            sim_to_real.check_one_maze(runs)
        episodes: list[tuple[Problem, Result]] = []
        with _progress() as on_stage:
            gaps = sim_to_real.measure(
                runs, self.reality, self.episodes, on_stage, on_episodes=lambda *one: episodes.append(one)
            )
        if not gaps:
            raise InputError("none of the runs has an agent that drives a robot")
        if self.keep is not None:
            asked = {"runs": [str(path) for path in self.runs], "reality": self.reality, "episodes": self.episodes}
            sim_to_real.keep(self.keep, episodes, {"command": "evaluate", **asked})
        if self.output is not None:
            write_json(self.output, sim_to_real.as_json(gaps))
        if self.report is not None:
            command = f"gridnav evaluate {shlex.join(map(str, self.runs))} --reality {' '.join(self.reality)}"
            sim_to_real.write_gap_report(self.report, gaps, f"{command} --episodes {self.episodes}")
        shown = sim_to_real.table(gaps)
        table = Table(*shown.columns)
        for row in shown.rows:
            table.add_row(*row)
        stdout.print(table)
        stdout.print(sim_to_real.conclusion(gaps))
        for run in runs:
            if "test" in self.reality:
                stdout.print(
                    f"{run.path}: {sim_to_real.sealed_evaluations(run)} evaluations in the test reality so far"
                )
        return 0


@dataclass(frozen=True)
class _Episodes:
    """Flags of the commands that show episodes."""

    rollouts: tuple[str, ...] = ()
    """Names of evaluated agents, such as ppo-warm; by default the last one of the run."""
    episode: int | None = None
    """Number of the episode, from 0."""
    worst: bool = False
    """The episode with the lowest return."""
    failed: bool = False
    """The first episode that did not reach its goal."""


@dataclass(frozen=True, kw_only=True)
class View(_Episodes):
    """Look at a run, or at several side by side, in the Rerun viewer: a window, a browser or a picture."""

    run: Annotated[Path, tyro.conf.Positional]
    """A run directory."""
    compare: tuple[Path, ...] = ()
    """Other runs, whose same episode is shown beside it."""
    overlay: bool = False
    """All episodes at once, in one maze."""
    web: bool = False
    """Show it in a browser of this machine, and of no other one, until interrupted."""
    port: int = 0
    """Where the browser's page is; a free port by default."""
    save: Path | None = None
    """Write the recording to this .rrd file and show nothing."""
    screenshot: Path | None = None
    """Write a picture of the recording to this PNG file; needs no display."""
    time_s: float | None = None
    """The moment of the screenshot, seconds; the end by default."""

    def __call__(self) -> int:
        """Run it."""
        if sum((self.web, self.save is not None, self.screenshot is not None)) > 1:
            raise InputError("--web, --save and --screenshot exclude each other: give one of them")
        if not 0 <= self.port < 65536 or (self.port and not self.web):
            raise InputError(f"--port {self.port} must be from 0 to 65535, and goes with --web")
        if self.time_s is not None and (self.screenshot is None or not 0 <= self.time_s <= 86_400):
            raise InputError(f"--time-s {self.time_s} must be from 0 to 86400 seconds, and goes with --screenshot")
        for flag, file, ending in (("--save", self.save, ".rrd"), ("--screenshot", self.screenshot, ".png")):
            if file is not None:
                _check_ending(flag, file, ending)
        with tempfile.TemporaryDirectory() as folder:
            self._show(self._recording(Path(folder)))
        return 0

    def _recording(self, folder: Path) -> Path:
        """The recording of what was asked for: the run's own one, or a new one."""
        from gridnav.display.recording import check_recording
        from gridnav.experiment.viewing import Pick, find_rollouts, record_episode, record_overlay

        runs = [RunDirectory.open(path) for path in (self.run, *self.compare)]
        pick = Pick(self.episode, self.worst, self.failed)
        if self.overlay and pick.is_given:
            raise InputError("--overlay shows all episodes: leave --episode, --worst and --failed out")
        is_trial = (runs[0].path / RESULT).is_file()  # of a sweep: it has rollouts alone
        if len(runs) == 1 and not (pick.is_given or self.rollouts or self.overlay or is_trial):
            recording = runs[0].recording
            if not recording.is_file():
                raise InputError(f"{str(self.run)!r} has no {recording.name}: the run has not finished")
            check_recording(recording)
            return recording
        found = find_rollouts(runs, self.rollouts)
        recording = folder / "episodes.rrd"
        if self.overlay:
            record_overlay(recording, found)
        else:
            record_episode(recording, found, pick)
        return recording

    def _show(self, recording: Path) -> None:
        from gridnav.display.recording import screenshot
        from gridnav.display.viewer import open_window, web_viewer

        if self.save is not None:
            shutil.copyfile(recording, self.save)
            stdout.print(str(self.save))
        elif self.screenshot is not None:
            screenshot(recording, self.screenshot, time_s=self.time_s)
            stdout.print(str(self.screenshot))
        elif self.web:
            with web_viewer(recording, self.port) as (address, is_running):
                stdout.print(f"{address}\nopen this in a browser on this machine; Ctrl-C ends it")
                sys.stdout.flush()
                with contextlib.suppress(KeyboardInterrupt):
                    while is_running():
                        time.sleep(0.2)
                    raise ViewerError("the Rerun viewer ended by itself: start it again")
        else:
            open_window(recording)


@dataclass(frozen=True, kw_only=True)
class Video(_Episodes):
    """Film an episode of a run in MuJoCo's picture, as .mp4 or .gif; needs no display."""

    run: Annotated[Path, tyro.conf.Positional]
    """A run directory."""
    output: Path = Path("episode.mp4")
    """The file to write."""
    camera: Literal["above", "chase", "onboard"] = "above"
    """From above, from behind the robot, or what the robot would see."""
    size: tuple[int, int] = (640, 480)
    """Width and height, pixels."""
    speed: float = 1.0
    """Seconds of the episode per second of the film."""

    def __call__(self) -> int:
        """Run it."""
        from gridnav.experiment.video import write_video
        from gridnav.experiment.viewing import Pick, find_rollouts

        _check_ending("--output", self.output, ".mp4", ".gif")
        found = find_rollouts([RunDirectory.open(self.run)], self.rollouts)
        if len(found) > 1:
            raise InputError(f"a film shows one agent, not {len(found)}: choose one with --rollouts")
        ((label, rollouts),) = found.items()
        number = Pick(self.episode, self.worst, self.failed).number(rollouts)
        episode, layout = rollouts.episodes[number], rollouts.layout_of(number)
        with Progress(*Progress.get_default_columns(), console=stderr) as bar:
            task = bar.add_task(f"filming episode {number}", total=None)
            write_video(
                self.output, layout, episode, label, camera=self.camera, size=self.size, speed=self.speed,
                on_frame=lambda done, total: bar.update(task, completed=done, total=total),
            )  # fmt: skip
        stdout.print(str(self.output))
        return 0


@dataclass(frozen=True)
class Play:
    """Drive by keyboard, see lidar and reward, and keep the drives as a run that view and video show."""

    env: Literal["gridnav/GridWorld-v0", "gridnav/Unicycle-v0", "gridnav/DiffDrive-v0"] = "gridnav/DiffDrive-v0"
    """Where."""
    layout: str = "classic"
    """A named layout, a text file, or a text."""
    task: str = "default"
    """Starts, goals and what a collision does: default, any or fragile."""
    reward: str = "default"
    """default, fragile (for the task of that name) or seed (the tutorial's)."""
    seed: int = 0
    """Of starts, goals and headings."""
    run_dir: Path | None = None
    """Where the drives go; runs/<run-id> below the current folder by default."""

    def __call__(self) -> int:
        """Run it."""
        from gridnav.experiment.play import play
        from gridnav.experiment.results import write_drives

        if not 0 <= self.seed < 2**32:
            raise InputError(f"--seed {self.seed} is outside 0 to 4294967295")
        if self.run_dir is not None:
            RunDirectory(self.run_dir).check_free()  # before anybody drives
        problem = Problem.load(self.layout, self.task, self.reward)
        world = self.env.split("/")[1].removesuffix("-v0")
        episodes = play(problem, world, self.seed)
        if not episodes:
            stdout.print("nothing was driven, nothing is kept")
            return 0
        layout = self.layout if self.layout in NAMED_LAYOUTS else problem.layout.to_text()
        config = json.loads(json.dumps(asdict(replace(self, layout=layout, run_dir=None)))) | {"command": "play"}
        with RunDirectory.create(self.run_dir, "play", config) as run:
            _show([write_drives(run, problem, world, episodes, self.seed)], run)
        return 0


@dataclass(frozen=True)
class LayoutCommand:
    """Draw, check or generate a layout."""

    action: Annotated[Literal["draw", "check", "generate"], tyro.conf.Positional] = "draw"
    """draw it, check it, or generate a new one."""
    source: Annotated[str, tyro.conf.Positional] = ""
    """To draw or check: a named layout, a text file, or a text (classic). To generate: random (the default) or maze."""
    rows: int = 11
    """Of a generated layout."""
    columns: int = 11
    """Of a generated layout."""
    density: float = 0.2
    """Share of walls of a random layout."""
    seed: int = 0
    """Of a generated layout."""
    output: Path | None = None
    """Write the layout to this text file instead of showing it."""

    def __call__(self) -> int:
        """Run it."""
        layout = self._generated() if self.action == "generate" else Layout.load(self.source or "classic")
        if self.action == "check":
            stdout.print(
                f"ok: {layout.name}, {layout.n_rows} x {layout.n_cols} cells of {layout.cell_size_m} m, "
                f"{int(layout.walls.sum())} walls in {len(layout.wall_rectangles())} rectangles, "
                f"{len(layout.start_cells)} starts, {len(layout.goal_cells)} goals, every goal reachable"
            )
        elif self.output is not None:
            _check_folder("--output", self.output)
            if self.output.exists():
                raise InputError(f"--output {str(self.output)!r} exists: name a new file")
            self.output.write_text(layout.to_text(), encoding="utf-8")
        else:
            sys.stdout.write(layout.to_text())
        return 0

    def _generated(self) -> Layout:
        if self.source in ("", "random"):
            return Layout.random(n_rows=self.rows, n_cols=self.columns, density=self.density, seed=self.seed)
        if self.source == "maze":
            return Layout.maze(n_rows=self.rows, n_cols=self.columns, seed=self.seed)
        raise InputError(f"unknown generator {self.source!r}: choose random or maze")


@dataclass(frozen=True)
class LintReward:
    """Prove that avoiding the goal pays less than reaching it; exit code 1 where it does not."""

    reward: str = "default"
    """default, fragile (for the task of that name) or seed (the tutorial's)."""
    layout: str = "classic"
    """A named layout, a text file, or a text."""
    task: str = "default"
    """Starts, goals and what a collision does: default, any or fragile."""
    goal: float | None = None
    """Change this weight of the reward."""
    collision_cost: float | None = None
    """Change this weight of the reward."""
    distance_cost: float | None = None
    """Change this weight of the reward."""
    time_cost: float | None = None
    """Change this weight of the reward."""
    progress: float | None = None
    """Change this weight of the reward."""
    gamma: float | None = None
    """Change the discount per cell-time, in (0, 1)."""

    def __call__(self) -> int:
        """Run it."""
        from gridnav.experiment.robot_lint import lint_robot
        from gridnav.problem.lint import lint_crashing, lint_grid, lint_idling

        weights = {name: getattr(self, name) for name in asdict(Reward())}
        reward = replace(Reward.load(self.reward), **{k: v for k, v in weights.items() if v is not None})
        layout, task = Layout.load(self.layout), Task.load(self.task)
        stdout.print(f"{self.reward} on {layout.name}: {reward}")
        findings = [lint_grid(reward, layout, task), lint_idling(reward, layout, task)]
        crashing = lint_crashing(reward, layout, task)
        findings += [crashing] if crashing else []
        with stderr.status("driving scripted robots"):
            findings += lint_robot(reward, layout, task)
        for finding in findings:
            stdout.print(str(finding), style=None if finding.is_sane else "bold red")
        return 0 if all(finding.is_sane for finding in findings) else 1


@dataclass(frozen=True)
class Doctor:
    """Print versions, cores and graphics back ends, and what is missing with the command that installs it."""

    def __call__(self) -> int:
        """Run it."""
        from gridnav.experiment.doctor import diagnose

        with stderr.status("looking at this machine"):
            checks = diagnose()
        for check in checks:
            advice = (
                f"  ({check.advice})" if check.advice and not (check.is_fine and check.found != "does not work") else ""
            )
            stdout.print(f"{'ok' if check.is_fine else '! ':<3}{check.name:<26}{check.found}{advice}")
        return 0


COMMANDS: dict[str, Callable[..., Any]] = {
    "ladder": Ladder,
    "train": Train,
    "sweep": Sweep,
    "evaluate": Evaluate,
    "view": View,
    "video": Video,
    "play": Play,
    "layout": LayoutCommand,
    "lint-reward": LintReward,
    "doctor": Doctor,
}


# ---- From words to a command, and from errors to exit codes -------------------------------------


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``gridnav`` and leave with its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    cause: BaseException | None = None
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        sys.exit(_run(words))
    except InputError as error:
        code, message, cause = 2, str(error), error
    except (ViewerError, RenderingError, OSError) as error:
        code, message, cause = 3, str(error), error
    except NonFiniteError as error:
        code, message, cause = 4, str(error), error
    except KeyboardInterrupt as error:
        resumes = words[:1] in (["train"], ["ladder"], ["sweep"])
        message = "interrupted" + ("; --resume goes on from the run's last checkpoint" if resumes else "")
        code, cause = 130, error
    if debug:
        stderr.print("".join(traceback.format_exception(cause)), markup=False)
    stderr.print(f"gridnav: {message}", markup=False)
    # Threads of a half-done step must not keep an interrupted run alive.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code) if code == 130 else sys.exit(code)


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        _help()
        return 0
    if words[0] not in COMMANDS:
        raise InputError(f"unknown command {words[0]!r}: the commands are {', '.join(COMMANDS)}")
    name, flags = words[0], _with_config(words[0], words[1:])
    if COMMANDS[name] is Sweep:
        own, common = _apart(flags)
        code: int = replace(_parse(Sweep, name, own), common=tuple(common))()
    else:
        code = _parse(COMMANDS[name], name, flags)()
    return code


def _apart(words: list[str]) -> tuple[list[str], list[str]]:
    """The flags of a sweep, and those of what its trials do."""
    names = {f"--{field.name.replace('_', '-')}" for field in fields(Sweep)} | {"--help", "-h"}
    own: list[str] = []
    common: list[str] = []
    into = own
    for word in words:
        if word.startswith("--") or word == "-h":
            into = own if word.partition("=")[0].replace("_", "-").replace("--no-", "--") in names else common
        into.append(word)
    return own, common


def _checked(command: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of a trial as its command writes it down, once all in it is known to be right."""
    own: dict[str, Any] = _parse(COMMANDS[command], command, _words(config, "the sweep")).checked()[1]
    return own


def _with_settings(shared: Mapping[str, Any], settings: Mapping[str, str], command: str) -> dict[str, Any]:
    """What trials have in common, with one trial's settings; ``set.NAME`` is a hyper-parameter."""
    known = {field.name for field in fields(COMMANDS[command])} - OF_ONE_START.keys()  # type: ignore[arg-type]
    config = dict(shared)
    for field, words in settings.items():
        group, dot, name = field.partition(".")
        if dot and group == "set" and group in known:
            config["set"] = [pair for pair in config["set"] if pair.partition("=")[0] != name] + [f"{name}={words}"]
        elif field in known - {"set"}:
            config[field] = words
        else:
            near = get_close_matches(group, known, 1, cutoff=0.3)[:1] or sorted(known)
            meant = "set.NAME" if near[0] == "set" else near[0]
            raise InputError(f"{command} has no field {field!r:.60}: did you mean {meant}?")
    return config


def _parse(config: Callable[..., Config], name: str, words: list[str]) -> Config:
    """The command with its flags; tyro's boxed errors become one line."""
    problems = io.StringIO()
    try:
        with contextlib.redirect_stderr(problems):
            return tyro.cli(config, prog=f"gridnav {name}", args=words)
    except SystemExit as leaving:
        if leaving.code != 2:
            raise
    # A box holds a title, the error and, behind a rule, hints; without a terminal a rule stands below the title too.
    lines = [line.strip(" ─│╭╮╰╯-") for line in problems.getvalue().splitlines()]
    blocks = [block.splitlines() for block in re.split(r"\n\n+", "\n".join(lines).strip())]
    error = blocks[0][1:] or blocks[1]
    message = " ".join(" ".join(error).split())
    raise InputError(f"{message} (see 'gridnav {name} --help')")


def _with_config(name: str, words: list[str]) -> list[str]:
    """The flags of ``--config FILE``, or of the run to resume, in front of the others: all are checked alike."""
    words = [
        part
        for word in words
        for part in (word.split("=", 1) if word.startswith(("--config=", "--run-dir=")) else [word])
    ]
    if "--config" in words:
        at = words.index("--config")
        if at + 1 == len(words):
            raise InputError("--config needs a file: the config.json of a run")
        return _flags(name, Path(words[at + 1])) + words[:at] + words[at + 2 :]
    if "--resume" in words and "--run-dir" in words[:-1]:
        config = Path(words[words.index("--run-dir") + 1]) / CONFIG
        return (_flags(name, config) if config.is_file() else []) + words
    return words


def _flags(name: str, config: Path) -> list[str]:
    """A stored configuration as words."""
    stored = read_json(config)
    if stored.pop("command", name) != name:
        raise InputError(f"{str(config)!r} was made by another command than {name}")
    return _words(stored, str(config))


def _words(stored: Mapping[str, Any], source: str) -> list[str]:
    """A configuration as words; ``source`` is where it comes from, for errors."""
    flags = []
    for key, value in stored.items():
        flag = f"--{key.replace('_', '-')}"
        words = value if isinstance(value, list) else []
        if key.replace("-", "_") in OF_ONE_START or any(str(word).startswith("-") for word in words):
            raise InputError(f"{source!r} says {flag} {value!r:.60}, which is no part of a run's configuration")
        if not isinstance(value, list):
            flags.append(f"{flag}={value}")
        elif value:
            flags += [flag, *(str(one) for one in value)]
    return flags


def _help() -> None:
    stdout.print(
        "gridnav: robot navigation from a Q-table to a robot\n\nusage: gridnav COMMAND [--help] [--debug] ...\n"
    )
    for name, command in COMMANDS.items():
        stdout.print(f"  {name:<13}{(command.__doc__ or '').splitlines()[0]}")


def _check_folder(flag: str, file: Path) -> None:
    if file.is_dir() or not file.name:
        raise InputError(f"{flag} {str(file)!r} is a folder: name a file")
    if not file.parent.is_dir():
        raise InputError(f"{flag} {str(file)!r}: there is no folder {str(file.parent)!r}")


def _check_ending(flag: str, file: Path, *endings: str) -> None:
    if file.suffix not in endings:
        raise InputError(f"{flag} {str(file)!r} must end with {' or '.join(endings)}")
    _check_folder(flag, file)


def _again(run: RunDirectory) -> str:
    """The command that makes the run again."""
    return f"gridnav {read_json(run.config)['command']} --config {shlex.quote(str(run.config))}"


# ---- What people see -----------------------------------------------------------------------------


@contextlib.contextmanager
def _progress() -> Iterator[OnStage]:
    """A bar per training or evaluation, with the success rate."""
    columns = (
        TextColumn("{task.description:<28}"),
        BarColumn(bar_width=11),
        TextColumn("{task.fields[words]:<29}"),
        TimeElapsedColumn(),
    )
    bars = Progress(*columns, console=stderr)

    def on_stage(name: str) -> OnProgress:
        bars.start()  # not earlier: what is refused gets one line and no empty ones
        for earlier in bars.task_ids:
            bars.update(earlier, total=1, completed=1)
            bars.stop_task(earlier)
        task = bars.add_task(name, total=None, words="")
        first: list[float] = []  # steps and seconds of the first report: a continued training has a past

        def on_progress(learning: Learning) -> None:
            success = learning.metrics.get("success_rate", float("nan"))
            first.extend(() if first else (learning.steps, bars.tasks[task].elapsed or 0.0))
            seconds = (bars.tasks[task].elapsed or 0.0) - first[1]
            words = f"{(learning.steps - first[0]) / seconds:>10,.0f}/s" if seconds > 0 else " " * 12
            if success == success:
                words += f"  success {success:6.1%}"
            bars.update(task, completed=learning.steps, total=learning.total_steps, words=words)

        return on_progress

    try:
        yield on_stage
    finally:
        if bars.live.is_started:
            bars.stop()


def _show(results: Sequence[Result], run: RunDirectory | None, *, title: str = "") -> None:
    table = Table(
        "rung", "world", "agent", "success (95 % interval)", "SPL", "SCT", "collided", "median time", "steps",
        title=title or None, title_justify="left",
    )  # fmt: skip
    for result in results:
        summary = result.summary
        time = "-" if summary.median_time_s is None else f"{summary.median_time_s:.1f} s"
        success = _share(summary.success_rate, summary.success_interval)
        ratios = f"{summary.spl:.2f}", f"{summary.sct:.2f}", f"{summary.collision_rate:.1%}"
        table.add_row(result.name, result.world, result.agent, success, *ratios, time, f"{result.steps:,}")
    stdout.print(table)
    for result in results:
        for note in _notes(result):
            stdout.print(f"{result.name}: {note}")
    if run is not None:
        if run.report.is_file():  # a drive has none
            stdout.print(f"report     {run.report}")
        stdout.print(f"recording  {run.recording}   ({_program()} view {shlex.quote(str(run.path))})")


def _program() -> str:
    """What one types for ``gridnav`` in this shell; through start.py its folder is not on the path."""
    beside = Path(sys.executable).with_name("gridnav.exe" if os.name == "nt" else "gridnav")
    return shlex.quote(os.path.relpath(beside)) if not shutil.which("gridnav") and beside.exists() else "gridnav"


def _notes(result: Result) -> Iterator[str]:
    """What a reader of the numbers should know beside them."""
    summary = result.summary
    if summary.layouts > 1:
        yield f"{summary.layouts} held-out layouts, success in the worst tenth of them {summary.success_cvar:.1%}"
    for behaviour, share in summary.behaviours.items():
        if share > 0:
            yield f"{behaviour} in {share:.1%} of the episodes"
    if summary.physics_errors:
        yield f"diverged physics ended {summary.physics_errors} episodes"


def _show_together(rows: Sequence[AcrossSeeds]) -> None:
    table = Table(
        "agent", "world", "solved", "success (95 % interval)", "worst", "SPL", "SCT", "collided", "training",
        title="over seeds: interquartile means with 95 % bootstrap intervals; solved: success of at least 99 %",
        title_justify="left",
    )  # fmt: skip
    for row in rows:
        table.add_row(
            row.name, row.world, f"{row.n_solved} of {len(row.seeds)}", _share(row.success, row.success_interval),
            f"{row.success_range[0]:.1%}", f"{row.spl:.2f}", f"{row.sct:.2f}",
            _share(row.collision_rate, row.collision_rate_interval), f"{row.training_seconds:.1f} s",
        )  # fmt: skip
    stdout.print(table)


@contextlib.contextmanager
def _trials_bar(total: int) -> Iterator[Callable[[int, int], None]]:
    """A bar of the trials that are done."""
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=30), TextColumn("{task.fields[words]}"))
    bar = Progress(*columns, TimeElapsedColumn(), console=stderr)
    task = bar.add_task("trials", total=total, words="")

    def on_done(done: int, failed: int) -> None:
        bar.start()  # not earlier: what is refused gets one line and no empty ones
        bar.update(task, completed=done, words=f"{done} of {total}" + (f", {failed} failed" if failed else ""))

    try:
        yield on_done
    finally:
        if bar.live.is_started:
            bar.stop()


SHOWN_TRIALS = 60
"""Rows of a sweep that are shown; more are a matter for the table's file."""


def _show_sweep(trials: Sequence[Trial], outcomes: Sequence[Outcome]) -> None:
    settings = list(trials[0].settings)
    is_elsewhere = any("under" in row for outcome in outcomes for row in outcome.rows)
    columns = (*settings, *(["tested under"] if is_elsewhere else []))
    table = Table("trial", *columns, "agent", "success (95 % interval)", "SPL", "SCT", "collided", "steps")
    for one, outcome in zip(trials, outcomes, strict=True):
        for row in outcome.rows:
            table.add_row(
                str(one.number), *(one.settings[name] for name in settings),
                *([str(row.get("under", ""))] if is_elsewhere else []), row["name"],
                _share(row["success"], (row["success_low"], row["success_high"])), f"{row['spl']:.2f}",
                f"{row['sct']:.2f}", f"{row['collided']:.1%}", f"{row['steps']:,}",
            )  # fmt: skip
    if table.row_count <= SHOWN_TRIALS:
        stdout.print(table)
    failed = [(one, outcome.error) for one, outcome in zip(trials, outcomes, strict=True) if outcome.error]
    if failed:
        one, error = failed[0]
        stdout.print(f"{len(failed)} of {len(trials)} trials failed, trial {one.number} of {error}", markup=False)


def _share(value: float, interval: tuple[float, float]) -> str:
    return f"{value:6.1%} ({interval[0]:.1%} to {interval[1]:.1%})"


if __name__ == "__main__":
    main()
