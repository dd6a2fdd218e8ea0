from __future__ import annotations

import ast
import importlib
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from torchrl_etdmpc.runs import RunDirectory

_ROOT = Path(__file__).parents[1]
_PACKAGE = _ROOT / "src" / "torchrl_etdmpc"

# From the ground up: a folder imports from the floors below its own, and of those what stands beside its name.
_FLOORS = (
    {
        "functional": set(),
        "keys": set(),
        "envs": set(),
        "runs": set(),
    },
    {
        "modules": {"functional"},
        "replay": {"keys"},
        "collectors": {"keys", "envs", "runs"},
        "checkpoints": {"keys", "runs"},
        "analysis": {"envs", "runs"},  # of the environments the names of the tasks
    },
    {
        "planners": {"functional", "keys", "envs", "modules"},  # of the environments what fits a model
        "objectives": {"functional", "keys", "modules"},
        "testing": {"functional", "keys", "modules"},
    },
    {
        "training": {
            *("functional", "keys", "envs", "runs"),
            *("modules", "replay", "collectors", "checkpoints", "analysis"),
            *("planners", "objectives"),
        },
    },
    {
        "suites": {"analysis", "envs", "runs", "training"},
        "inspector": {"functional", "keys", "envs", "runs", "modules", "analysis", "planners", "training"},
    },
    {
        "commands": {
            *("analysis", "checkpoints", "collectors", "envs", "planners", "runs"),
            *("inspector", "suites", "training"),
        },
    },
)
_MAY_IMPORT = {name: allowed for floor in _FLOORS for name, allowed in floor.items()}
_CORE = {"numpy", "tensordict", "torch", "torchrl"}
_EXTRAS = (
    *("dm_control", "gymnasium", "hydra", "imageio_ffmpeg", "matplotlib", "mujoco", "pandas", "scipy", "tensorboard"),
    *("tqdm", "wandb", "yaml", "dash", "flask", "plotly", "werkzeug"),
)


def _files(layer: str) -> list[Path]:
    file = _PACKAGE / f"{layer}.py"
    return [file] if file.exists() else sorted((_PACKAGE / layer).rglob("*.py"))


def _imports(nodes: Iterator[ast.AST], package: str) -> Iterator[str]:
    """The absolute names of imported modules; of ``from package import name`` also ``package.name``."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*above, *([node.module] if node.module else [])])
            yield from (f"{module}.{alias.name}" for alias in node.names)


def _imports_of(path: Path, *, outside_functions: bool = False) -> set[str]:
    tree = ast.parse(path.read_text())
    package = ".".join(path.parent.relative_to(_PACKAGE.parent).parts)
    nodes = _outside_functions(tree) if outside_functions else ast.walk(tree)
    return set(_imports(nodes, package))


def _name(path: Path) -> str:
    """The module's name; that of a package is its folder's."""
    return ".".join(path.relative_to(_PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def _outside_functions(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
            yield from _outside_functions(node)


def test_every_folder_and_file_of_the_package_has_a_place_on_a_floor():
    found = {path.relative_to(_PACKAGE).parts[0].removesuffix(".py") for path in _PACKAGE.rglob("*.py")}
    assert found == {"__init__", *_MAY_IMPORT}


def test_what_a_folder_may_import_is_on_a_floor_below_its_own():
    below: set[str] = set()
    for floor in _FLOORS:
        for name, allowed in floor.items():
            assert allowed <= below, name
        below |= set(floor)


@pytest.mark.parametrize("layer", _MAY_IMPORT)
def test_imports_flow_one_way(layer):
    allowed = _MAY_IMPORT[layer] | {layer}
    for path in _files(layer):
        own = {name for name in _imports_of(path) if name.split(".")[0] == "torchrl_etdmpc"}
        own -= {"torchrl_etdmpc.__version__"}
        # What is not a layer is the package itself, which sits above all layers; its version is everybody's.
        wrong = {name for name in own if not set(name.split(".")[1:2]) & allowed}
        assert not wrong, f"{path.relative_to(_ROOT)} imports {', '.join(sorted(wrong))}"


def test_no_file_imports_itself_on_any_way():
    """Imports for type checkers and inside of functions included."""
    files = {_name(path): path for path in _PACKAGE.rglob("*.py")}
    graph = {}
    for module, path in files.items():
        names = {name for name in _imports_of(path) if name.split(".")[0] == "torchrl_etdmpc"}
        graph[module] = {name if name in files else name.rpartition(".")[0] for name in names}
        assert graph[module] <= set(files)
    assert sum(map(len, graph.values())) > len(files)
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def _strings(path: Path) -> Iterator[str]:
    """All but docstrings."""
    tree = ast.parse(path.read_text())
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
            yield node.value


def test_the_files_of_a_run_are_named_in_one_place():
    directory = RunDirectory("")
    files = (directory.config, directory.train, directory.eval, directory.curve, directory.summary)
    spelled = {
        (path.relative_to(_PACKAGE).as_posix(), file.name)
        for path in _PACKAGE.rglob("*.py")
        for text in _strings(path)
        for file in files
        if file.name in text
    }
    assert spelled == {("runs/directory.py", file.name) for file in files}


def test_whole_files_are_made_in_one_place():
    durable = {"fdatasync", "fsync", "link", "rename", "renames", "replace", "symlink"}
    found: dict[str, set[str]] = {}
    for path in _PACKAGE.rglob("*.py"):
        calls = {
            f"os.{node.attr}"
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
            if node.value.id == "os" and node.attr in durable
        }
        calls |= {"tempfile" for name in _imports_of(path) if name.split(".")[0] == "tempfile"}
        if calls:
            found[path.relative_to(_PACKAGE).as_posix()] = calls
    assert found == {
        "runs/files.py": {"os.fsync", "os.link", "os.replace", "tempfile"},  # an unnamed one, to see whether one can
        "checkpoints/store.py": {"os.replace"},  # of folders
        "training/ray_cluster.py": {"tempfile"},  # a folder for Ray's sockets, which goes with them
        "commands/command_line.py": {"tempfile"},  # a folder for Hydra's notes of a sweep, likewise
    }


@pytest.mark.parametrize("script", sorted(path.name for path in (_ROOT / "examples").glob("*.py")))
def test_the_examples_use_public_names_only(script):
    pytest.importorskip("scipy")  # of analysis
    for node in ast.walk(ast.parse((_ROOT / "examples" / script).read_text())):
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "torchrl_etdmpc":
            public = importlib.import_module(node.module).__all__
            assert {alias.name for alias in node.names} <= set(public), node.module


def test_functional_imports_nothing_but_torch():
    for path in _files("functional"):
        roots = {name.split(".")[0] for name in _imports_of(path)}
        wrong = roots - {"torch", "torchrl_etdmpc"} - set(sys.stdlib_module_names)
        assert not wrong, f"{path.relative_to(_ROOT)} imports {', '.join(sorted(wrong))}"


def test_extras_are_imported_only_where_they_are_used():
    # The reports and the suites need their extras throughout, and only the commands import them.
    for path in sorted(set(_PACKAGE.rglob("*.py")) - set(_files("analysis")) - set(_files("suites"))):
        roots = {name.split(".")[0] for name in _imports_of(path, outside_functions=True)}
        wrong = roots - _CORE - {"torchrl_etdmpc"} - set(sys.stdlib_module_names)
        assert not wrong, f"{path.relative_to(_ROOT)} imports {', '.join(sorted(wrong))} outside of a function"


def test_importing_the_package_loads_no_extra():
    script = (
        "import sys, tensordict, torch, torchrl.collectors, torchrl.data, torchrl.envs, torchrl.modules\n"
        "import torchrl.objectives\n"
        "before = set(sys.modules)\n"
        "import torchrl_etdmpc, torchrl_etdmpc.checkpoints, torchrl_etdmpc.envs, torchrl_etdmpc.runs\n"
        "import torchrl_etdmpc.testing, torchrl_etdmpc.training\n"
        f"extras = set({_EXTRAS!r})\n"
        "print(*sorted(extras & (set(sys.modules) - before)))\n"
        "loaded_by_torch = {'mujoco', 'tqdm', 'yaml'}  # and TorchRL; the last by Ray, where it is there\n"
        "print(*sorted(extras & set(sys.modules) - loaded_by_torch))\n"
    )
    environment = os.environ | {"PYTHONPATH": str(_ROOT / "src"), "MUJOCO_GL": "disable"}
    run = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout == "\n\n"


def _pins() -> dict[str, str]:
    lines = (line.split("#")[0].strip() for line in (_ROOT / "requirements-pins.txt").read_text().splitlines())
    return {_canonical(name): version for name, version in (line.split("==") for line in lines if line)}


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_the_pins_satisfy_the_declared_ranges_of_everything_that_the_commands_need():
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    declared = [
        *project["dependencies"],
        *extras["dmc"],
        *extras["train"],
        *extras["analysis"],
        *extras["test"],
        *extras["tensorboard"],
        *extras["wandb"],
        *extras["ray"],
        *extras["sweep"],
        *extras["inspect"],
    ]
    pins = _pins()
    for requirement in map(Requirement, declared):
        name = _canonical(requirement.name)
        assert name in pins, f"requirements-pins.txt lacks {name}"
        assert requirement.specifier.contains(pins[name]), f"{name}=={pins[name]} is outside {requirement}"
