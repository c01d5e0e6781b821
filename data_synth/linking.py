"""How numba's compiler is told to optimise and translate a kernel once, whole.

Left to itself numba optimises every function as it comes, links into it all that it calls, which was optimised before, and
makes machine code of the whole again, although nothing but kernels is ever called from Python: what lies ten calls deep is
optimised eleven times and translated eleven times. Here an inner function stays the code that lowering made of it. A kernel
links all those below it once, makes them its own, so that what is inlined everywhere is dropped, and is optimised as one.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from llvmlite.binding import Linkage, ModuleRef
from numba import _dynfunc  # pyright: ignore[reportAttributeAccessIssue]
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering


class _Inner(JITCodeLibrary):
    """The code of one inner function, neither optimised nor translated."""

    def _optimize_functions(self, ll_module) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def finalize(self) -> None:
        self._raise_if_finalized()
        self._finalized = True

    def alone(self) -> ModuleRef:
        """Its own code, whose calls lead out of it."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> ModuleRef:
        """With all it calls: what numba compiles in its own way, a density function for example, links nothing else."""
        whole = self.alone().clone()
        _link_in_all(whole, self)
        return whole


class _Whole(JITCodeLibrary):
    """The code of a kernel with all it calls."""

    def finalize(self) -> None:
        _link_in_all(self._final_module, self)
        self._linking_libraries.clear()
        super().finalize()

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == Linkage.linkonce_odr:
                function.linkage = Linkage.internal
        made = self._codegen._module_pass_manager()
        if not isinstance(made, tuple):  # numba before LLVM's new pass managers
            super()._optimize_final_module()
            return
        passes, builder = made
        with self._recorded_timings.record("optimisation of the whole", builder):
            passes.run(self._final_module, builder)


def _link_in_all(module: ModuleRef, library: JITCodeLibrary) -> None:
    """Link into the code of a library all that it calls, each function once."""
    for each in _callers_first(library)[1:]:
        module.link_in(each.alone() if isinstance(each, _Inner) else each._get_module_for_linking(), preserve=True)


def _callers_first(library: JITCodeLibrary) -> list[JITCodeLibrary]:
    """A library and all it calls, directly or not, each once and behind all its callers: linking takes of a module what was
    asked for before. What is no inner function has all it calls in itself."""
    left: dict[JITCodeLibrary, None] = {}

    def walk(each: JITCodeLibrary) -> None:
        if each not in left:
            for called in each._linking_libraries if isinstance(each, _Inner) or each is library else ():
                walk(called)
            left[each] = None

    walk(library)
    return list(reversed(left))


def _library(state, kind):
    library = kind(state.targetctx.codegen(), state.func_id.func_qualname)
    library.enable_object_caching()
    return library


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerInner(NativeLowering):
    _name = "lower_inner"

    def run_pass(self, state):
        state.library, state.flags.no_compile = _library(state, _Inner), True
        super().run_pass(state)
        made = state["cr"]
        name = made.fndesc.qualname
        mark = _dynfunc.make_function(made.fndesc.lookup_module(), name.split(".")[-1], name, 0, made.env, ())
        state.targetctx.insert_user_function(mark, made.fndesc, [state.library])
        state["cr"] = made._replace(cfunc=mark)
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerWhole(NativeLowering):
    _name = "lower_whole"

    def run_pass(self, state):
        state.library = _library(state, _Whole)
        return super().run_pass(state)


# Passes for what no function here has: closures, generators, literal arguments, array expressions, objects. By name, so that
# another numba that lacks one is none the worse.
NEEDLESS = {
    "WithLifting", "InlineClosureLikes", "RewriteDynamicRaises", "MakeFunctionToJitFunction", "InlineInlinables",
    "FindLiterallyCalls", "LiteralUnroll", "LiteralPropagationSubPipelinePass", "InlineOverloads", "NopythonRewrites",
    "DumpParforDiagnostics", "DeadBranchPrune",
}  # fmt: skip


OF_LIBRARY = (
    "_codegen", "_final_module", "_finalized", "_get_module_for_linking", "_linking_libraries", "_optimize_final_module",
    "_optimize_functions", "_raise_if_finalized", "_recorded_timings", "enable_object_caching",
)  # fmt: skip
OF_CODEGEN = ("_data_layout", "_module_pass_manager")


@cache
def _fits(codegen: Any) -> bool:
    """Whether numba has inside what is used here; where not, it compiles in its own way."""
    library = JITCodeLibrary(codegen, "probe")
    held = {library: OF_LIBRARY, codegen: OF_CODEGEN, _dynfunc: ("make_function",)}
    return all(hasattr(each, name) for each, names in held.items() for name in names)


class Compiler(CompilerBase):
    """Compiles a kernel."""

    lowering = _LowerWhole

    def define_pipelines(self):
        """See CompilerBase."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        if not _fits(self.state.targetctx.codegen()):
            return [passes]
        kept = [(each, words) for each, words in passes.passes if each.__name__ not in NEEDLESS]
        passes.passes = [(self.lowering if each is NativeLowering else each, words) for each, words in kept]
        passes.finalize()
        return [passes]


class InnerCompiler(Compiler):
    """Compiles what kernels call."""

    lowering = _LowerInner
