"""A plugin of pytest (`-p penumbra.tests.support.without_avx`): kernels run as on a processor of x86-64-v2."""

from penumbra.shared.native import machine

machine.V3 = machine.V3 | {"an instruction that no processor has"}
