"""Imports go down the packages only and in no circle, and the ground truth shares no code with what it judges.

Reads the source with ``ast``: an import inside a function counts as much as one at the top. Imports for annotations
alone (``if TYPE_CHECKING:``) do not run and are free.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

PACKAGES = [
    "errors", "native", "defaults", "machine", "quadrature", "rotations", "sh", "region",
    "files", "config", "cameras", "octree", "splats", "field", "kernels", "views", "neural", "medium", "clouds", "models",
    "film", "datasets", "measure", "cluster", "starts", "training", "poses", "export", "viewer", "cli",
]  # fmt: skip
"""From the ground up: each may import itself and what stands before it. A new file in a package needs no line here."""

FORBIDDEN = {
    "octree": {"cameras", "datasets", "kernels"},
    "splats": {"cameras", "datasets", "kernels"},
    "kernels": {"config", "datasets"},
    "measure": {"training"},
}
"""... except these."""

WITHOUT_NUMPY = ("cli", "config", "errors", "defaults")
"""Packages whose modules do not import numpy or torch at their head: help and mistakes answer at once."""

ONLY_COMMANDS = "data_synth"
"""What only commands may call: ground truth is data, not a library of the trainer's."""

SHARED_FILES = {"nerfvol.export.vdb": "data_synth.vdb_write"}
"""... except the writer of a file format, which is no truth: there is one of each."""


def module_name(path: Path, root: Path = ROOT) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


class _Imports(ast.NodeVisitor):
    """Absolute names of everything a module imports when it runs."""

    def __init__(self, package: str, heads_only: bool = False) -> None:
        self.package, self.heads_only, self.found = package, heads_only, []

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if not self.heads_only:
            self.generic_visit(node)

    def visit_If(self, node: ast.If) -> None:
        name = node.test.attr if isinstance(node.test, ast.Attribute) else getattr(node.test, "id", None)
        for child in node.orelse if name == "TYPE_CHECKING" else [node.test, *node.body, *node.orelse]:
            self.visit(child)

    def visit_Import(self, node: ast.Import) -> None:
        self.found += [alias.name for alias in node.names]

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        base = node.module or ""
        if node.level:
            parents = self.package.split(".")
            base = ".".join(parents[: len(parents) - node.level + 1] + ([base] if base else []))
        # "from nerfvol.octree import lod" may name a module or what a package holds: both are what it imports.
        self.found += [f"{base}.{alias.name}" for alias in node.names if not alias.name.startswith("__")] or [base]


def imports(source: str, module: str, is_package: bool, heads_only: bool = False) -> list[str]:
    visitor = _Imports(module if is_package else module.rpartition(".")[0], heads_only)
    visitor.visit(ast.parse(source))
    return visitor.found


def room(module: str) -> str | None:
    """The entry of PACKAGES of nerfvol.<name>[.<more>]; None for the package itself."""
    parts = module.split(".")
    if len(parts) == 1 or parts[1].startswith("__"):
        return None
    if parts[1] not in PACKAGES:
        raise AssertionError(
            f"{module} stands in no package: give {parts[1]} its place in PACKAGES of {Path(__file__).name}"
        )
    return parts[1]


def climbing(source: str, module: str, is_package: bool = False) -> list[str]:
    """The imports of a nerfvol module that it may not make."""
    own, wrong = room(module), []
    for name in imports(source, module, is_package):
        shared = SHARED_FILES.get(module)
        if (
            name.split(".")[0] == ONLY_COMMANDS
            and own != "cli"
            and not (shared and f"{name}.".startswith(f"{shared}."))
        ):
            wrong.append(name)
        if name.split(".")[0] == "nerfvol" and own is not None and (theirs := room(name)) is not None:
            if PACKAGES.index(theirs) > PACKAGES.index(own) or theirs in FORBIDDEN.get(own, ()):
                wrong.append(name)
    return wrong


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """The modules of ``graph`` (module -> what it imports) that reach themselves, each circle once (Tarjan 1972)."""
    index, low, stack, found = {}, {}, [], []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(graph[node] & graph.keys()):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(group) > 1 or node in graph[node]:
                found.append(sorted(group))

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return found


def import_graph(package: str) -> dict[str, set[str]]:
    """Which module of ``package`` imports which; ``from a import b`` is an edge to a.b where that is a module, else to a."""
    files = {module_name(path): path for path in (ROOT / package).rglob("*.py")}
    graph = {}
    for module, path in files.items():
        named = imports(path.read_text(), module, path.name == "__init__.py")
        targets = {name if name in files else name.rpartition(".")[0] for name in named}
        graph[module] = {t for t in targets if t in files and files[t].name != "__init__.py"}
    return graph


MODULES = sorted((ROOT / "nerfvol").rglob("*.py"))


def test_imports_go_down_only():
    wrong = {}
    for path in MODULES:
        if found := climbing(path.read_text(), module_name(path), path.name == "__init__.py"):
            wrong[module_name(path)] = found
    assert not wrong


@pytest.mark.parametrize("package", ["nerfvol", "data_synth"])
def test_no_circles(package):
    assert circles(import_graph(package)) == []


@pytest.mark.parametrize("package", WITHOUT_NUMPY)
def test_help_needs_no_numpy(package):
    for path in MODULES:
        module = module_name(path)
        if room(module) == package:
            heads = imports(path.read_text(), module, path.name == "__init__.py", heads_only=True)
            assert not [name for name in heads if name.split(".")[0] in ("numpy", "torch", "PIL")], module


def test_the_ground_truth_imports_nothing_it_judges():
    for path in sorted((ROOT / "data_synth").rglob("*.py")):
        found = imports(path.read_text(), module_name(path), path.name == "__init__.py")
        assert not [name for name in found if name.split(".")[0] == "nerfvol"], path


@pytest.mark.parametrize("module,source,wrong", [
    ("nerfvol.sh", "import nerfvol.octree", True),
    ("nerfvol.octree.tree", "from nerfvol.kernels.ops import render_rays", True),
    ("nerfvol.octree.tree", "def f():\n    from nerfvol import views", True),
    ("nerfvol.octree.io", "from nerfvol.cameras import Camera", True),
    ("nerfvol.kernels.ops", "from ..datasets.load import load_dataset", True),
    ("nerfvol.kernels.ops", "from ..octree.tree import Octree\nfrom . import reference", False),
    ("nerfvol.kernels.ops", "from nerfvol.config.values import coerce", True),
    ("nerfvol.measure.bench", "from nerfvol.training import session", True),
    ("nerfvol.views", "import data_synth", True),
    ("nerfvol.views", "from data_synth.vdb_write import write_grids", True),
    ("nerfvol.export.vdb", "from data_synth.vdb_write import write_grids", False),
    ("nerfvol.export.vdb", "from data_synth.vdb import read_vdb", True),
    ("nerfvol.cli.demo", "import data_synth\nfrom nerfvol.training import train\nfrom nerfvol import __version__", False),
    ("nerfvol.field.fields", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import nerfvol.views", False),
    ("nerfvol.field.fields", "if x:\n    import nerfvol.views", True),
])  # fmt: skip
def test_the_check_itself(module, source, wrong):
    assert bool(climbing(source, module)) == wrong


def test_circles_are_seen():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}, "e": {"e"}}) == [["a", "b", "c"], ["e"]]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_a_module_without_a_place_is_noticed():
    with pytest.raises(AssertionError, match="stands in no package"):
        room("nerfvol.miscellaneous")
