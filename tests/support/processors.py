"""The switches with which libraries do without the instructions of newer processors: each has its own."""

PROCESSORS = {
    "x86-64-v2": {
        "ATEN_CPU_CAPABILITY": "default",
        "NPY_DISABLE_CPU_FEATURES": "AVX AVX2 FMA3 AVX512F AVX512_SKX AVX512_ICL AVX512_SPR X86_V3 X86_V4",
        "ONEDNN_MAX_CPU_ISA": "SSE41",
        "OPENBLAS_CORETYPE": "Nehalem",
        "PYTEST_ADDOPTS": "-p penumbra.tests.support.without_avx",
    },
    "x86-64-v3": {
        "ATEN_CPU_CAPABILITY": "avx2",
        "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512_SKX AVX512_ICL AVX512_SPR X86_V4",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "OPENBLAS_CORETYPE": "Haswell",
    },
}
"""Switches of torch, numpy, oneDNN (in torch and OpenVINO), OpenBLAS (in numpy and scipy) and the kernels' library."""
