"""Number format of networks on this processor."""

from __future__ import annotations

import os
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")


def has_bfloat16() -> bool:
    """Whether networks are run and trained in bfloat16: where it is faster than float32 and where oneDNN, which torch and
    OpenVINO use, may use it (ONEDNN_MAX_CPU_ISA).

    It is faster with matrix instructions for it (AMX: a step of PredNet takes 4.7 ms, in float32 12.3 ms), and with AMD's vector
    instructions for it (Zen 4: 10.6 and 18.3 ms). Intel's vector instructions alone are slower than float32 (18.5 ms).
    """
    allowed = os.environ.get("ONEDNN_MAX_CPU_ISA", "DEFAULT").upper()
    is_free = allowed in ("DEFAULT", "ALL")
    words = set(CPUINFO.read_text().split()) if CPUINFO.is_file() else set()
    by_matrices = "amx_bf16" in words and (is_free or "AMX" in allowed)
    by_vectors = {"AuthenticAMD", "avx512_bf16"} <= words and (is_free or "BF16" in allowed or "AMX" in allowed)
    return by_matrices or by_vectors
