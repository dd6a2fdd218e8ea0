from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement

_ROOT = Path(__file__).parents[1]
_PACKAGE = _ROOT / "src" / "torchrl_etdmpc"

# What each layer may import from the package, besides itself; a layer that is not named here fails the test.
_MAY_IMPORT = {
    "functional": set(),
    "modules": {"functional"},
    "envs": {"functional", "modules"},
    "planners": {"functional", "modules"},
    "objectives": {"functional", "modules"},
    "replay": {"functional", "modules"},
    "collectors": {"functional", "modules", "envs", "replay"},
    "analysis": {"envs"},  # the names of the tasks
    "training": {"functional", "modules", "envs", "planners", "objectives", "replay", "collectors", "analysis"},
    "testing": {"functional", "modules", "envs", "planners", "objectives", "replay", "collectors", "training"},
}
_CORE = {"numpy", "tensordict", "torch", "torchrl"}
_EXTRAS = ("dm_control", "gymnasium", "hydra", "matplotlib", "pandas", "scipy", "tensorboard", "tqdm", "wandb")


def _files(layer: str) -> list[Path]:
    return sorted((_PACKAGE / layer).rglob("*.py"))


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


def _outside_functions(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
            yield from _outside_functions(node)


def test_every_folder_of_the_package_has_a_place_in_the_layering():
    folders = {path.parent.relative_to(_PACKAGE).parts[0] for path in _PACKAGE.rglob("*/*.py")}
    assert folders <= set(_MAY_IMPORT)


@pytest.mark.parametrize("layer", _MAY_IMPORT)
def test_imports_flow_one_way(layer):
    allowed = _MAY_IMPORT[layer] | {layer, "keys"}
    for path in _files(layer):
        own = {name for name in _imports_of(path) if name.split(".")[0] == "torchrl_etdmpc"}
        # What is not a layer is the package itself, which sits above all layers.
        wrong = {name for name in own if not set(name.split(".")[1:2]) & allowed}
        assert not wrong, f"{path.relative_to(_ROOT)} imports {', '.join(sorted(wrong))}"


def test_the_keys_import_nothing():
    assert _imports_of(_PACKAGE / "keys.py") == {"__future__.annotations"}


def test_functional_imports_nothing_but_torch():
    for path in _files("functional"):
        roots = {name.split(".")[0] for name in _imports_of(path)}
        wrong = roots - {"torch", "torchrl_etdmpc"} - set(sys.stdlib_module_names)
        assert not wrong, f"{path.relative_to(_ROOT)} imports {', '.join(sorted(wrong))}"


def test_extras_are_imported_only_where_they_are_used():
    # The reports need their extras throughout, and only the commands import them.
    for path in sorted(set(_PACKAGE.rglob("*.py")) - set(_files("analysis"))):
        roots = {name.split(".")[0] for name in _imports_of(path, outside_functions=True)}
        wrong = roots - _CORE - {"torchrl_etdmpc"} - set(sys.stdlib_module_names)
        assert not wrong, f"{path.relative_to(_ROOT)} imports {', '.join(sorted(wrong))} outside of a function"


def test_importing_the_package_loads_no_extra():
    script = (
        "import sys, tensordict, torch, torchrl.collectors, torchrl.data, torchrl.envs, torchrl.modules\n"
        "import torchrl.objectives\n"
        "before = set(sys.modules)\n"
        "import torchrl_etdmpc, torchrl_etdmpc.envs\n"
        f"extras = set({_EXTRAS!r})\n"
        "print(*sorted(extras & (set(sys.modules) - before)))\n"
        "print(*sorted(extras & set(sys.modules) - {'tqdm'}))  # torch loads tqdm itself when it is there\n"
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
    ]
    pins = _pins()
    for requirement in map(Requirement, declared):
        name = _canonical(requirement.name)
        assert name in pins, f"requirements-pins.txt lacks {name}"
        assert requirement.specifier.contains(pins[name]), f"{name}=={pins[name]} is outside {requirement}"
