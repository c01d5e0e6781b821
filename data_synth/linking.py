"""How numba's compiler is told to optimise and translate a kernel once, whole.

Left to itself numba optimises every function as it comes, links into it all that it calls, which was optimised before, and
makes machine code of the whole again, although nothing but kernels is ever called from Python: what lies ten calls deep is
optimised eleven times and translated eleven times. Here an inner function stays the code that lowering made of it. A kernel
links all those below it once, makes them its own, so that what is inlined everywhere is dropped, and is optimised as one.
"""

from __future__ import annotations

from llvmlite.binding import Linkage
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


class _Whole(JITCodeLibrary):
    """The code of a kernel with all it calls."""

    def finalize(self) -> None:
        self._linking_libraries = _callers_first(self)[1:]
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


def _callers_first(library: JITCodeLibrary) -> list[JITCodeLibrary]:
    """A library and all it calls, directly or not, each once and behind all its callers: linking takes of a module what was
    asked for before."""
    left: dict[JITCodeLibrary, None] = {}

    def walk(each: JITCodeLibrary) -> None:
        if each not in left:
            for called in each._linking_libraries if isinstance(each, (_Inner, _Whole)) else ():
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


class Compiler(CompilerBase):
    """Compiles a kernel."""

    lowering = _LowerWhole

    def define_pipelines(self):
        """See CompilerBase."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        kept = [(each, words) for each, words in passes.passes if each.__name__ not in NEEDLESS]
        passes.passes = [(self.lowering if each is NativeLowering else each, words) for each, words in kept]
        passes.finalize()
        return [passes]


class InnerCompiler(Compiler):
    """Compiles what kernels call."""

    lowering = _LowerInner
