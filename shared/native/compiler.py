"""Compiler of kernels: numba types and lowers the Python functions, LLVM generates machine code for any processor.

numba's code raises Python exceptions and counts references to arrays in its own runtime. Neither remains: `_without_python`
reduces an exception to a failure status, and `RUNTIME` replaces numba's runtime.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
from llvmlite.binding import newpassmanagers as passes
from numba.core import config, types
from numba.core.compiler import Flags, compile_extra
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target
from numba.np import numpy_support

from penumbra.shared.native import Kernel
from penumbra.shared.native.fingerprint import is_native, plain, used
from penumbra.shared.native.signature import Parameter

VERSIONS = {"llvmlite": llvmlite.__version__, "numba": numba.__version__}


@dataclass(frozen=True)
class Target:
    """A processor, in LLVM's terms."""

    triple: str
    cpu: str
    features: str = ""

    def machine(self) -> llvm.TargetMachine:
        """LLVM's code generator for it."""
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
        target = llvm.Target.from_triple(self.triple)
        return target.create_target_machine(cpu=self.cpu, features=self.features, opt=3, reloc="pic", codemodel="default")


TARGETS = {
    "x86_64-v2": Target("x86_64-unknown-linux-gnu", "x86-64-v2"),
    "x86_64-v3": Target("x86_64-unknown-linux-gnu", "x86-64-v3"),
    "aarch64": Target("aarch64-unknown-linux-gnu", "generic"),
}
"""Processors that libraries are built for, by the libraries' names."""

LIBC = {
    "malloc", "free", "memcpy", "memmove", "memset", "acos", "asin", "asinh", "atan", "atan2", "cbrt", "cos", "cosf", "cosh",
    "exp", "exp2", "expf", "expm1", "fmod", "hypot", "log", "log10", "log1p", "log2", "logf", "pow", "powf", "sin", "sinf",
    "sinh", "sincos", "tan", "tanh", "tanhf", "ceil", "floor", "rint", "round", "trunc", "sqrt", "sqrtf",
}  # fmt: skip
"""Functions that a library may call; every Python process provides them."""

RUNTIME = """
; The memory of an array: a header (the number of references, ..., the data's address, ...) as numba lays it out, and the data.
%memory = type { i64, ptr, ptr, ptr, i64 }

declare noalias ptr @malloc(i64)
declare void @free(ptr)

define noalias ptr @NRT_Allocate(i64 %size) {
  %memory = call ptr @malloc(i64 %size)
  ret ptr %memory
}

define void @NRT_Free(ptr %memory) {
  call void @free(ptr %memory)
  ret void
}

define noalias ptr @NRT_MemInfo_alloc_aligned(i64 %size, i32 %align) {
  %wide = zext i32 %align to i64
  %slack = add i64 %wide, 40
  %total = add i64 %size, %slack
  %memory = call ptr @malloc(i64 %total)
  %none = icmp eq ptr %memory, null
  br i1 %none, label %full, label %fill
full:
  ret ptr null
fill:
  %address = ptrtoint ptr %memory to i64
  %after = add i64 %address, %slack
  %before = sub i64 %after, 1
  %mask = sub i64 0, %wide
  %aligned = and i64 %before, %mask
  %distance = sub i64 %aligned, %address
  %data = getelementptr i8, ptr %memory, i64 %distance
  store i64 1, ptr %memory
  %field = getelementptr %memory, ptr %memory, i32 0, i32 3
  store ptr %data, ptr %field
  ret ptr %memory
}

define ptr @NRT_MemInfo_data_fast(ptr %memory) {
  %field = getelementptr %memory, ptr %memory, i32 0, i32 3
  %data = load ptr, ptr %field
  ret ptr %data
}

define void @NRT_incref(ptr %memory) {
  %none = icmp eq ptr %memory, null
  br i1 %none, label %done, label %count
count:
  %old = load i64, ptr %memory
  %new = add i64 %old, 1
  store i64 %new, ptr %memory
  br label %done
done:
  ret void
}

define void @NRT_decref(ptr %memory) {
  %none = icmp eq ptr %memory, null
  br i1 %none, label %done, label %count
count:
  %old = load i64, ptr %memory
  %new = sub i64 %old, 1
  store i64 %new, ptr %memory
  %unused = icmp eq i64 %new, 0
  br i1 %unused, label %last, label %done
last:
  call void @free(ptr %memory)
  br label %done
done:
  ret void
}
"""


def compiled(kernels: Sequence[Kernel], target: Target, lowered: Sequence[str] | None = None) -> bytes:
    """Object file for a processor with the entry points of kernels: `int symbol(const int64_t *block)`.

    The block holds the offset of the data's address in an array object, then the arguments: a number, or an array object's
    address and its sizes; last the array for the result. The return value is zero, or one where the kernel failed. lowered:
    output of `lower` for each kernel, where it is available already.
    """
    machine = target.machine()
    module = llvm.parse_assembly(RUNTIME)
    for code in lowered or [lower(each) for each in kernels]:
        module.link_in(llvm.parse_assembly(code))
    module.triple, module.data_layout = target.triple, str(machine.target_data)
    _internalise(module, {each.symbol for each in kernels})
    _optimise(module, machine)
    module.verify()
    strange = {each.name for each in module.functions if each.is_declaration and each.name.split(".")[0] != "llvm"} - LIBC
    if strange:
        raise ValueError(
            f"{', '.join(each.name for each in kernels)}: expected calls of libc and libm only, "
            f"got {', '.join(sorted(strange))}; write what needs it (BLAS, LAPACK, a reshape) as loops"
        )
    return machine.emit_object(module)  # type: ignore[no-any-return]


@global_compiler_lock  # type: ignore[untyped-decorator]  # numba has no types for it
def lower(kernel: Kernel) -> str:
    """LLVM assembly of a kernel and its entry point, not optimised and independent of the processor."""
    with _without_optimisation():
        _declare(kernel.function)
        kinds = [_numba_type(each) for each in kernel.signature.parameters]
        result = numpy_support.from_dtype(kernel.signature.result) if kernel.signature.result else types.none
        context, flags = cpu_target.target_context, _flags(**kernel.native_options)
        made = compile_extra(cpu_target.typing_context, context, kernel.function, kinds, result, flags, {})
        made.library.finalize()
        code = _without_python(made.library.get_llvm_str())
        internal = f'define i32 @"{made.fndesc.llvm_func_name}"('
        if internal not in code:
            internal = internal.replace('"', "")
        return code.replace(internal, internal.replace("define", "define internal")) + _entry(kernel, made.fndesc.llvm_func_name)


def _numba_type(parameter: Parameter) -> types.Type:
    kind = numpy_support.from_dtype(parameter.dtype)
    return types.Array(kind, len(parameter.sizes), "C", readonly=not parameter.is_out) if parameter.is_array else kind


def _flags(fastmath: bool) -> Flags:
    flags: Any = Flags()  # its fields are made at run time
    flags.nrt = flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
    flags.error_model = "numpy"
    flags.fastmath = REORDERED if fastmath else False
    return flags  # type: ignore[no-any-return]


def _declare(function: Any) -> None:
    """Registers all functions that this one calls with numba, which reads the attribute `_numba_type_` of values of unknown
    types."""
    for _, value in used(function):
        if is_native(value) and not hasattr(value, "_numba_type_"):
            fastmath = REORDERED if value.native_options["fastmath"] else False
            make: Any = numba.njit  # its types leave some options out
            make = make(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy", fastmath=fastmath)
            _CALLED.append(make(plain(value)))
            value._numba_type_ = types.Dispatcher(_CALLED[-1])
            _declare(plain(value))


REORDERED = {"reassoc", "nsz", "contract"}
"""LLVM's flags for a function with `fastmath`. Infinities and NaN keep their meaning."""
_CALLED: list[Any] = []
"""numba's dispatchers of the functions that kernels call. Their types refer to them without keeping them alive."""


@contextlib.contextmanager
def _without_optimisation() -> Iterator[None]:
    """Turns off numba's optimisation; LLVM optimises once, for the target processor."""
    level, config.OPT = config.OPT, config._OptLevel(0)  # type: ignore[attr-defined]
    try:
        yield
    finally:
        config.OPT = level  # type: ignore[attr-defined]


def _without_python(code: str) -> str:
    """Removes the code that constructs exceptions; numba's status still shows that there was one."""
    code = re.sub(r"^(define [^\n]*raise_with_shape_context[^\n]*\{\n).*?^\}", r"\1  ret i32 1\n}", code, flags=re.M | re.S)
    code = re.sub(r"^  store ptr [^\n]*, ptr %excinfo\b[^\n]*\n", "", code, flags=re.M)
    return re.sub(r"^target [^\n]*\n", "", code, flags=re.M)


def _entry(kernel: Kernel, function: str) -> str:
    """Entry point that Python calls: reads the block and calls numba's function by numba's calling convention."""
    lines: list[str] = []
    given, slot = ["ptr %result", "ptr %exception"], 0

    def line(text: str) -> str:
        lines.append(f"  %v{len(lines)} = {text}")
        return f"%v{len(lines) - 1}"

    def load(kind: str = "i64") -> str:
        nonlocal slot
        slot += 1
        return line(f"load {kind}, ptr {line(f'getelementptr i64, ptr %block, i64 {slot - 1}')}")

    def data(array: str) -> str:
        return line(f"load ptr, ptr {line(f'getelementptr i8, ptr {array}, i64 {offset}')}")

    offset = load()
    for parameter in kernel.signature.parameters:
        if parameter.is_array:
            address, sizes = data(load("ptr")), [load() for _ in parameter.sizes]
            strides = [str(parameter.dtype.itemsize)]
            for size in reversed(sizes):
                strides.insert(0, line(f"mul i64 {strides[0]}, {size}"))
            items = line(f"sdiv exact i64 {strides[0]}, {parameter.dtype.itemsize}")
            given += ["ptr null", "ptr null", f"i64 {items}", f"i64 {parameter.dtype.itemsize}", f"ptr {address}"]
            given += [f"i64 {each}" for each in (*sizes, *strides[1:])]
        elif parameter.dtype == "f4":
            wide = load("double")
            given.append(f"float {line(f'fptrunc double {wide} to float')}")
        elif parameter.dtype == "f8":
            given.append("double " + load("double"))
        elif parameter.dtype == "b1":
            wide = load()
            given.append(f"i8 {line(f'trunc i64 {wide} to i8')}")
        else:
            given.append(f"i64 {load()}")
    kind = {None: "ptr", "f8": "double", "i8": "i64"}[kernel.signature.result and kernel.signature.result.str[1:]]
    status = line(f'call i32 @"{function}"({", ".join(given)})')
    if kernel.signature.result:
        value, place = line(f"load {kind}, ptr %result"), data(load("ptr"))
        lines.append(f"  store {kind} {value}, ptr {place}")
    body = "\n".join(lines)
    return f"""
define i32 @{kernel.symbol}(ptr %block) {{
  %exception = alloca ptr
  %result = alloca {kind}
  store {kind} zeroinitializer, ptr %result
{body}
  %success = icmp eq i32 {status}, 0
  %none = icmp eq i32 {status}, -2
  %well = or i1 %success, %none
  %failed = select i1 %well, i32 0, i32 1
  ret i32 %failed
}}
"""


def _internalise(module: llvm.ModuleRef, symbols: set[str]) -> None:
    """Makes everything but the symbols internal: it may be inlined and dropped."""
    for each in module.functions:
        if not each.is_declaration and each.name not in symbols:
            each.linkage = "internal"
    for each in module.global_variables:
        if not each.is_declaration:
            each.linkage = "internal"


def _optimise(module: llvm.ModuleRef, machine: llvm.TargetMachine) -> None:
    """Optimises as numba does: inline cheaply, remove reference counts that cancel, then run all passes."""
    cheap, full = (passes.create_pipeline_tuning_options(level) for level in (0, 3))
    cheap.loop_vectorization = cheap.slp_vectorization = full.slp_vectorization = False
    full.loop_vectorization = True
    builder = passes.create_pass_builder(machine, full)
    for function in module.functions:
        if not function.is_declaration:
            simplify = builder.getFunctionPassManager()
            simplify.add_refprune_pass()
            simplify.run(function, builder)
    builder = passes.create_pass_builder(machine, cheap)
    inline = builder.getModulePassManager()
    inline.add_loop_rotate_pass()
    inline.add_instruction_combine_pass()
    inline.add_jump_threading_pass()
    inline.add_refprune_pass()
    inline.run(module, builder)
    builder = passes.create_pass_builder(machine, full)
    everything = builder.getModulePassManager()
    everything.run(module, builder)
