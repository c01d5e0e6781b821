"""Imports go down the layers only, and the ground truth shares no code with what it judges.

Reads the source with ``ast``: an import inside a function counts as much as one at the top. Imports for annotations
alone (``if TYPE_CHECKING:``) do not run and are free.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

LAYERS: dict[int, set[str]] = {
    # mathematics and files, no state
    0: {
        "errors", "files", "arrayfile", "native",
        "lens", "cameras", "sh", "quadrature", "sampling", "losses", "metrics",
    },
    # representations
    1: {"settings", "encodings", "fields", "occupancy", "topology", "octree", "octree_codec", "octree_io", "merge", "lod"},
    # operators on rays and octrees
    2: {"kernels"},
    # use: data in, training, pictures and records out
    3: {
        "datasets", "camera_paths", "pictures", "config", "options", "runs", "machine", "memory", "checkpoint", "tiles",
        "train_field", "distill", "finetune", "session", "trainer", "render", "evaluate", "truth",
        "roofline", "plots",
    },
    # what a person calls
    4: {"cli", "viewer", "export", "bench", "info", "demo"},
}  # fmt: skip


def layer_of(module: str) -> int | None:
    """The layer of nerfvol.<name>[.<more>]; None for the package itself, which everything may import."""
    parts = module.split(".")
    if len(parts) == 1:
        return None
    for layer, names in LAYERS.items():
        if parts[1] in names:
            return layer
    raise AssertionError(f"{module} stands in no layer: give {parts[1]} its place in LAYERS of {Path(__file__).name}")


def module_name(path: Path, root: Path = ROOT) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


class _Imports(ast.NodeVisitor):
    """Absolute names of everything a module imports when it runs."""

    def __init__(self, package: str) -> None:
        self.package, self.found = package, []

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
        if base in ("nerfvol", "data_synth"):  # "from nerfvol import octree" names modules, not contents
            self.found += [f"{base}.{alias.name}" for alias in node.names if not alias.name.startswith("__")]
        else:
            self.found.append(base)


def imports(source: str, module: str, is_package: bool) -> list[str]:
    visitor = _Imports(module if is_package else module.rpartition(".")[0])
    visitor.visit(ast.parse(source))
    return visitor.found


def climbing(source: str, module: str, is_package: bool = False) -> list[str]:
    """The imports of a nerfvol module that it may not make."""
    own = layer_of(module)
    wrong = []
    for name in imports(source, module, is_package):
        if name.split(".")[0] == "data_synth" and own != 4:
            wrong.append(name)
        if name.split(".")[0] == "nerfvol" and own is not None:
            theirs = layer_of(name)
            if theirs is not None and theirs > own:
                wrong.append(name)
    return wrong


MODULES = sorted((ROOT / "nerfvol").rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_imports_go_down_only(path):
    module = module_name(path)
    wrong = climbing(path.read_text(), module, path.name == "__init__.py")
    assert not wrong, f"{module} may not import {', '.join(wrong)}"


def test_the_ground_truth_imports_nothing_it_judges():
    for path in sorted((ROOT / "data_synth").rglob("*.py")):
        found = imports(path.read_text(), module_name(path), path.name == "__init__.py")
        assert not [name for name in found if name.split(".")[0] == "nerfvol"], path


@pytest.mark.parametrize("module,source,wrong", [
    ("nerfvol.sh", "import nerfvol.octree", True),
    ("nerfvol.octree", "from nerfvol.kernels.ops import render_rays", True),
    ("nerfvol.octree", "def f():\n    from nerfvol import render", True),
    ("nerfvol.kernels.ops", "from ..datasets.load import load_dataset", True),
    ("nerfvol.kernels.ops", "from ..octree import Octree\nfrom . import reference", False),
    ("nerfvol.render", "import data_synth", True),
    ("nerfvol.cli", "import data_synth\nfrom nerfvol import trainer, __version__", False),
    ("nerfvol.fields", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import nerfvol.render", False),
    ("nerfvol.fields", "if x:\n    import nerfvol.render", True),
])  # fmt: skip
def test_the_check_itself(module, source, wrong):
    assert bool(climbing(source, module)) == wrong


def test_a_module_without_a_layer_is_noticed():
    with pytest.raises(AssertionError, match="stands in no layer"):
        layer_of("nerfvol.miscellaneous")
