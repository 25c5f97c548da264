"""The house as drawn in the documentation: which part may import which, and what some parts alone may do."""

import ast
import importlib.util
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {
    "gridnav": ROOT / "gridnav",
    "gridnav.envs": ROOT / "envs",
    "gridnav.agents": ROOT / "agents",
    "gridnav.assets": ROOT / "assets",
}

# The arrows that point down. A part may always import its own files, as long as they make no circle.
MAY_IMPORT = {
    "problem": set(),
    "assets": set(),
    "envs": {"problem", "assets"},
    "display": {"problem", "assets"},
    "agents": {"problem"},
    "experiment": {"problem", "assets", "envs", "display", "agents"},
    "gridnav": {"problem", "envs"},  # the face, gridnav/__init__.py: names for users, registered worlds
    "cli": {"problem", "assets", "envs", "display", "agents", "experiment", "gridnav"},
}

# Libraries that one module alone knows.
ONLY_IN = {
    "rerun": {"gridnav.display.recording"},
    "rich": {"gridnav.cli"},  # it prints
}

# A file that comes from elsewhere must never run code here.
UNSAFE_IMPORTS = {"pickle", "cloudpickle", "dill", "marshal", "shelve"}
UNSAFE_CALLS = {"eval", "exec", "os.system", "os.popen", "joblib.load", "torch.load", "torch.save"}

# The held-out worlds are for measuring alone.
REALITY = "gridnav.experiment.reality"
MAY_IMPORT_REALITY = {"gridnav.experiment.sim_to_real"}
TRAINS = {
    "training", "course", "validation", "live", "presets", "worlds", "checkpoint", "sweep", "trials", "arms", "ladder",
    "demonstrations", "greedy_curve",
}  # fmt: skip
"""Of ``gridnav.experiment``: what learning happens in. Agents, worlds, problems and pictures are all of it."""


def find_modules() -> dict[str, Path]:
    """Import name -> file, of everything that is installed."""
    modules = {}
    for package, folder in FOLDERS.items():
        for path in folder.rglob("*.py"):
            parts = [package, *path.relative_to(folder).with_suffix("").parts]
            modules[".".join(parts).removesuffix(".__init__")] = path
    return modules


MODULES = find_modules()
TREES = {module: ast.parse(path.read_text(), str(path)) for module, path in MODULES.items()}


def imports(module: str) -> set[str]:
    """Full names of the modules that a module imports, anywhere in its text, for types alone too."""
    package = module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]
    found = set()
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            members = {f"{base}.{alias.name}" for alias in node.names}
            submodules = members & MODULES.keys()
            found |= submodules if submodules == members else submodules | {base}
    return found


def calls(module: str) -> Iterator[tuple[str, ast.Call]]:
    """Each call and its full name: after `import numpy as np`, `np.load(f)` is `numpy.load`."""
    full_names = {}
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            full_names |= {alias.asname: alias.name for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom):
            full_names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Call):
            first, dot, rest = ast.unparse(node.func).partition(".")
            yield full_names.get(first, first) + dot + rest, node


def part_of(module: str) -> str:
    """`problem` for `gridnav.problem.layout`, `cli` for `gridnav.cli`."""
    return module.removeprefix("gridnav.").split(".")[0]


IMPORTS = {module: imports(module) for module in MODULES}
OWN_IMPORTS = {module: found & MODULES.keys() for module, found in IMPORTS.items()}


def test_every_module_has_its_place_in_the_house() -> None:
    assert {part_of(module) for module in MODULES} <= MAY_IMPORT.keys()


def test_imports_between_parts_point_downwards() -> None:
    upward = [
        f"{module} imports {imported}"
        for module, found in OWN_IMPORTS.items()
        for imported in found
        if part_of(imported) not in MAY_IMPORT[part_of(module)] | {part_of(module)}
    ]

    assert upward == []


def test_imports_between_files_make_no_circle() -> None:
    try:
        TopologicalSorter(OWN_IMPORTS).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_only_the_command_line_knows_sweeps() -> None:
    """A trial is what a command does: nothing that a trial is made of may ask what it is a trial of."""
    room = "gridnav.experiment.sweeps"
    users = {module for module, found in OWN_IMPORTS.items() if any(name.startswith(room) for name in found)}

    assert {module for module in users if not module.startswith(room)} == {"gridnav.cli"}


@pytest.mark.parametrize("library", ONLY_IN)
def test_a_library_is_known_to_its_one_module_alone(library: str) -> None:
    users = {module for module, found in IMPORTS.items() if library in {name.split(".")[0] for name in found}}

    assert users <= ONLY_IN[library]


def test_only_the_command_line_prints() -> None:
    printing = {
        module
        for module in MODULES
        for name, _ in calls(module)
        if name in {"print", "pprint.pprint"} or name.startswith(("sys.stdout", "sys.stderr"))
    }

    assert printing <= {"gridnav.cli"}


def test_nothing_reads_or_writes_pickles() -> None:
    users = [module for module, found in IMPORTS.items() if UNSAFE_IMPORTS & {name.split(".")[0] for name in found}]

    assert users == []


def test_nothing_runs_code_from_data() -> None:
    unsafe = [
        f"{MODULES[module]}:{call.lineno}"
        for module in MODULES
        for name, call in calls(module)
        if is_unsafe(name, call)
    ]

    assert unsafe == []


def is_unsafe(name: str, call: ast.Call) -> bool:
    """Whether a call may run code that came in as data."""
    keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
    return (
        name.removeprefix("builtins.") in UNSAFE_CALLS
        or (name == "numpy.load" and keywords.get("allow_pickle") != "False")
        or keywords.get("shell", "False") != "False"
        # PPO.load and its like unpickle the archive.
        or (name.startswith("stable_baselines3.") and name.rpartition(".")[2].startswith("load"))
    )


def test_the_unsafe_calls_are_recognised() -> None:
    """So that the test above cannot pass because it sees nothing."""
    unsafe = [
        "eval(x)",
        "numpy.load(x)",
        "numpy.load(x, allow_pickle=True)",
        "run(x, shell=True)",
        "torch.load(x)",
    ]
    safe = ["model.eval()", "numpy.load(x, allow_pickle=False)", "run(x)", "Dqn.load(x)"]

    for text in unsafe + safe:
        call = ast.parse(text, mode="eval").body
        assert isinstance(call, ast.Call)
        assert is_unsafe(ast.unparse(call.func), call) == (text in unsafe), text


def test_only_measuring_sees_the_held_out_worlds() -> None:
    assert REALITY in MODULES
    assert {module for module, found in OWN_IMPORTS.items() if REALITY in found} <= MAY_IMPORT_REALITY


def test_what_trains_cannot_reach_the_held_out_worlds_by_any_way() -> None:
    training = {
        module
        for module in MODULES
        if part_of(module) in {"envs", "agents", "problem", "display"}
        or (part_of(module) == "experiment" and module.rpartition(".")[2] in TRAINS)
    }
    assert len(training) > 40

    assert REALITY not in reachable_from(training)
    assert REALITY in reachable_from({REALITY})
    assert "gridnav.experiment.evaluation" in reachable_from({REALITY})


def reachable_from(modules: set[str]) -> set[str]:
    """These modules, what they import, what that imports, and so on; a package runs when a module of it is imported."""
    reached: set[str] = set()
    ahead = modules & MODULES.keys()
    while ahead:
        reached |= ahead
        found = set().union(*(OWN_IMPORTS[module] for module in ahead))
        packages = {module.rpartition(".")[0] for module in ahead | found} & MODULES.keys()
        ahead = (found | packages) - reached
    return reached


def imported_names(tree: ast.Module) -> set[str]:
    """Names that a file takes from other files of gridnav."""
    return {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.level or (node.module or "").startswith("gridnav"))
        for alias in node.names
    }


def test_what_is_compiled_and_kept_on_disk_uses_nothing_of_other_files() -> None:
    """Numba notices changes of a function's own file alone: others' constants and functions would stay as they were."""
    kept = 0
    for module, tree in TREES.items():
        foreign = imported_names(tree)
        for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
            if not any("cache=True" in ast.unparse(decorator) for decorator in function.decorator_list):
                continue
            kept += 1
            body = {node.id for part in function.body for node in ast.walk(part) if isinstance(node, ast.Name)}
            assert not body & foreign, f"{module}.{function.name} uses {sorted(body & foreign)}: pass them in"
    assert kept > 10
