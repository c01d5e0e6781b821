"""Every public module, class, function and method of nerfvol says what it is; read with ``ast``, nothing is imported."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent / "nerfvol"

Function = ast.FunctionDef | ast.AsyncFunctionDef
Class = tuple[ast.ClassDef, list[str]]
"""A class and the names of its bases."""


def _definitions(body: list[ast.stmt]) -> Iterator[Function | ast.ClassDef]:
    """Functions and classes in ``body``, also under an ``if`` or a ``try``; those inside functions are nobody's business."""
    for node in body:
        if isinstance(node, Function | ast.ClassDef):
            yield node
        elif isinstance(node, ast.If | ast.Try | ast.With):
            for part in ("body", "orelse", "finalbody"):
                yield from _definitions(getattr(node, part, []))
            for handler in getattr(node, "handlers", []):
                yield from _definitions(handler.body)


def _last_name(node: ast.expr) -> str:
    """``a.b.C[T]`` -> ``C``."""
    while isinstance(node, ast.Subscript):
        node = node.value
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def _is_exempt(function: Function) -> bool:
    """Setters share their property's docstring, overloads their implementation's."""
    names = {_last_name(d.func if isinstance(d, ast.Call) else d) for d in function.decorator_list}
    return bool(names & {"setter", "deleter", "overload"})


def _inherits(name: str, bases: list[str], classes: dict[str, Class], seen: frozenset[str] = frozenset()) -> bool:
    """Whether a base class, or one of theirs, documents the method ``name``."""
    for base in bases:
        if base in seen or base not in classes:
            continue
        node, further = classes[base]
        for method in _definitions(node.body):
            if method.name == name and ast.get_docstring(method):
                return True
        if _inherits(name, further, classes, seen | {base}):
            return True
    return False


def undocumented(sources: dict[str, str]) -> list[str]:
    """``module: name`` of what is public and has no docstring, in sources by module."""
    trees = {module: ast.parse(text) for module, text in sources.items()}
    classes: dict[str, Class] = {}
    for tree in trees.values():
        for node in _definitions(tree.body):
            if isinstance(node, ast.ClassDef):
                classes[node.name] = node, [_last_name(base) for base in node.bases]
    missing = []

    def visit(module: str, body: list[ast.stmt], prefix: str, bases: list[str]) -> None:
        for node in _definitions(body):
            if node.name.startswith("_"):
                continue
            if isinstance(node, ast.ClassDef):
                own = [_last_name(base) for base in node.bases]
                visit(module, node.body, f"{prefix}{node.name}.", own)
            elif _is_exempt(node) or _inherits(node.name, bases, classes):
                continue
            if not (ast.get_docstring(node) or "").strip():
                missing.append(f"{module}: {prefix}{node.name}")

    for module, tree in trees.items():
        if not (ast.get_docstring(tree) or "").strip():
            missing.append(f"{module}: the module")
        visit(module, tree.body, "", [])
    return missing


def test_what_is_public_has_a_docstring() -> None:
    sources = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in sorted(ROOT.rglob("*.py"))}
    assert len(sources) > 50
    assert undocumented(sources) == []


def test_the_test_sees_what_is_missing() -> None:
    base = '"""."""\nclass Base:\n    """."""\n    def told(self):\n        """."""\n    def untold(self): ...\n'
    child = (
        "import base\n"
        "class Child(base.Base[int]):\n"
        "    @property\n"
        "    def own(self): ...\n"
        "    @own.setter\n"
        "    def own(self, value): ...\n"
        "    def told(self): ...\n"
        "    def untold(self): ...\n"
        "    def _private(self): ...\n"
        "if True:\n"
        "    def function():\n"
        "        def inner(): ...\n"
    )
    assert undocumented({"base": base, "child": child}) == [
        "base: Base.untold", "child: the module", "child: Child.own", "child: Child.untold", "child: Child",
        "child: function",
    ]  # fmt: skip
