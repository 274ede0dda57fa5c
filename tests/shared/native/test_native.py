"""Kernels: the committed libraries belong to the sources, and compiled code computes what the Python functions compute."""

import ctypes
import importlib.util
import json
import linecache
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from penumbra.services.haptics import paper_nearest
from penumbra.services.replay.chain import Replay
from penumbra.services.search import contour
from penumbra.shared.cell import description
from penumbra.shared.geometry import raster, surface
from penumbra.shared.native import KERNELS, Kernel, build, inner, kernel, machine
from penumbra.shared.native.compiler import LIBC
from penumbra.shared.native.signature import Signature
from penumbra.sim.world.world import record
from penumbra.tests.support import emulated

ROOT = Path(__file__).parents[3]


def manifest():
    return json.loads((machine.FOLDER / build.MANIFEST).read_text())


def symbols(library, kind):
    """Names of a library's dynamic symbols that are defined ("T") or missing ("U")."""
    lines = subprocess.run(["nm", "-D", library], check=True, capture_output=True, text=True).stdout.splitlines()
    return {line.split()[-1] for line in lines if line.split()[-2] == kind}


def test_every_kernel_is_in_every_library_as_its_source_is_now():
    build.import_kernels()
    floors = tuple(floor.replace("/", ".") for floor in build.FLOORS)
    ours = {each.name: each for each in KERNELS.values() if each.name.startswith(floors)}
    assert {name: each.fingerprint for name, each in ours.items()} == manifest()["kernels"], build.AGAIN
    for name in manifest()["libraries"]:
        assert symbols(machine.FOLDER / name, "T") == {each.symbol for each in ours.values()}, build.AGAIN


def test_a_library_needs_nothing_but_libc_and_libm():
    for name in manifest()["libraries"]:
        assert symbols(machine.FOLDER / name, "U") <= LIBC
        described = subprocess.run(["readelf", "-hd", machine.FOLDER / name], check=True, capture_output=True, text=True).stdout
        assert ("AArch64" if name.startswith("aarch64") else "X86-64") in described
        assert "NEEDED" not in described and "DYN" in described


@pytest.mark.slow
def test_a_library_is_what_its_sources_give(tmp_path):
    """A sample: three kernels, compiled again, alone and for every processor, give the same bytes as once more; the whole is
    compared by `python -m penumbra.shared.native.build --check`."""
    code = """
        import hashlib, sys
        from penumbra.shared.geometry import raster, surface
        from penumbra.shared.native import KERNELS
        from penumbra.shared.native.compiler import TARGETS, compiled
        kernels = [KERNELS[name] for name in sorted(KERNELS)]
        print([hashlib.sha256(compiled(kernels, target)).hexdigest() for target in TARGETS.values()])
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    first, second = (
        subprocess.run(command, cwd=ROOT, env={**os.environ, "PYTHONHASHSEED": "0"}, check=True, capture_output=True, text=True)
        for _ in range(2)
    )
    assert first.stdout == second.stdout


def ball(rng):
    """A closed convex mesh around the origin: vertices (n, 3), faces (m, 3)."""
    from scipy.spatial import ConvexHull

    points = rng.standard_normal((60, 3))
    hull = ConvexHull(points / np.linalg.norm(points, axis=1, keepdims=True))
    inward = np.einsum("ij,ij->i", np.cross(*(points[hull.simplices[:, k]] for k in (0, 1))), hull.equations[:, :3]) < 0
    return hull.points, np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices).astype(np.int32)


def calls(rng):
    """A kernel of each kind with arguments: loops on integers, on geometry, on statistics."""
    vertices, faces = ball(rng)
    shell = surface.Surface(vertices, faces)
    points = 2.0 * rng.standard_normal((20, 3))
    yield surface.nearest_points, (points, *shell.arrays, np.empty(20), np.empty((20, 3)), np.empty((20, 3)))
    V = np.ascontiguousarray(0.3 * vertices + rng.uniform(-0.1, 0.1, 3) + [0, 0, 0.6])
    yield raster.draw_silhouette, (V, faces, 60.0, 60.0, 32.0, 24.0, np.zeros((48, 64), bool))
    yield contour._front, (V, faces, True, np.zeros_like(faces))
    images = np.full((48, 64), np.inf, np.float32), np.zeros((48, 64), np.uint8), np.zeros((48, 64), np.int32)
    yield raster._draw, (V, faces, 60.0, 60.0, 32.0, 24.0, np.ones(len(faces), np.uint8), 0, *images)
    n = 12
    # fields that Python code too can read as attributes, as kernels do
    contour_points = rng.uniform(0.5, 20.0, (n, 8)).view(contour.POINT)[:, 0].view(np.recarray)
    kind = rng.integers(0, 3, n).astype(np.uint8)
    sums = np.zeros((7, 7)), np.zeros(7), np.zeros(5)
    weights = rng.uniform(size=n)
    offsets = rng.standard_normal(n)
    axes = rng.standard_normal((2, 3))
    yield contour._normal_equations, (contour_points, offsets, kind, weights, *axes, 50.0, 50.0, 0.7, True, *sums)
    signal, precision = rng.uniform(0, 2, (2, 6)), rng.uniform(1e2, 1e4, (2, 6))
    pads = np.array([0, 3, 6]), rng.uniform(-0.02, 0.02, (6, 3)), rng.uniform(1, 3, 6), rng.uniform(1e3, 1e4, 6)
    yield paper_nearest._fit, (signal, precision, *pads, np.empty((2, 2, 3)), np.empty((2, 2, 3, 3)))


@pytest.mark.parametrize("seed", range(3))
def test_compiled_code_computes_what_the_python_function_computes(seed):
    for compiled, arguments in calls(np.random.default_rng(seed)):
        again = [each.copy() if isinstance(each, np.ndarray) else each for each in arguments]
        result = compiled(*arguments)
        assert compiled._code is not None
        with np.errstate(all="ignore"):
            expected = compiled.function(*again)
        assert result == expected
        for ours, theirs in zip(arguments, again, strict=True):
            if isinstance(ours, np.recarray):
                ours, theirs = (each.view((np.float64, 8), np.ndarray) for each in (ours, theirs))
            # sums of a hundred terms, in another order at most
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12, err_msg=compiled.name)


REORDERED = {"penumbra.shared.skin.response.values": 1e-5, "penumbra.services.haptics.solve._descend": 1e-2}
"""Relative tolerances of what sums in single precision in another order, and of the steps that begin from there."""


@pytest.mark.slow
@pytest.mark.skipif(bool(emulated.missing()), reason=f"not installed here: {emulated.missing()} (Debian's qemu-user and gcc)")
def test_on_an_emulated_aarch64_kernels_give_what_they_give_here(tmp_path):
    table = description.load("table")
    with emulated.recorded(most=3) as recorded:
        Replay(table).run(record(table, 11, 1.0))
        for compiled, arguments in calls(np.random.default_rng(0)):
            compiled(*arguments)
    assert len({call.kernel.name for call in recorded}) >= 15, "kernels of every service, and of the emulated sensors"
    for call, arrays, result in emulated.run(recorded, tmp_path):
        kinds, name = call.kernel.signature.parameters, call.kernel.name
        expected = [value for value, kind in zip(call.after, kinds, strict=True) if kind.is_array]
        for ours, theirs in zip([*arrays, *fields(result)], [*expected, *fields(call.result)], strict=True):
            for one, other in zip(fields(ours), fields(theirs), strict=True):
                np.testing.assert_allclose(one, other, rtol=REORDERED.get(name, 1e-9), atol=1e-12, err_msg=name)


def fields(array):
    """The fields of an array of records, and of those in it; an array of numbers, and a number, alone; nothing for None."""
    if array is None:
        return []
    names = getattr(array, "dtype", np.dtype(float)).names
    return [each for name in names for each in fields(array[name])] if names else [array]


def imported(path, text):
    """The module of this text."""
    path.write_text(textwrap.dedent(text))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SCALE = """
    import numpy as np
    from penumbra.shared.native import inner, kernel
    FACTOR = {factor}
    @inner
    def scaled(x):
        return {expression}
    @kernel("f8[n], out f8[n] -> f8")
    def scale(x, out):
        total = 0.0
        for i in range(len(x)):
            out[i] = scaled(x[i])
            total += out[i]
        return total
"""


def test_a_kernel_is_known_by_its_source_the_functions_it_calls_and_their_constants(tmp_path):
    variants = [(2.0, "FACTOR * x"), (3.0, "FACTOR * x"), (2.0, "FACTOR + x"), (2.0, "FACTOR * x")]
    modules = [imported(tmp_path / f"m{k}.py", SCALE.format(factor=f, expression=e)) for k, (f, e) in enumerate(variants)]
    first, other_constant, other_function, same = (each.scale.fingerprint for each in modules)
    assert len({first, other_constant, other_function}) == 3
    assert same == first


def test_an_edited_kernel_is_compiled_again_and_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path / "cache"))
    x, out = np.arange(3.0), np.empty(3)
    for expression, total in (
        ("FACTOR * x", 6.0),
        ("FACTOR + 1.0 * x", 9.0),
    ):  # of another length: bytecode is kept by seconds and size
        module = imported(tmp_path / "edited.py", SCALE.format(factor=2.0, expression=expression))
        linecache.checkcache()
        assert module.scale(x, out) == total
    assert len(list((tmp_path / "cache" / "native").glob("*.o"))) == 2


def test_what_is_compiled_runs_also_where_it_cannot_be_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_CACHE", "/proc/nowhere")
    module = imported(tmp_path / "unkept.py", SCALE.format(factor=5.0, expression="FACTOR * x"))
    assert module.scale(np.ones(2), np.empty(2)) == 10.0


def test_without_numba_an_edited_kernel_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "penumbra.shared.native.jit", None)
    monkeypatch.delattr("penumbra.shared.native.jit", raising=False)
    module = imported(tmp_path / "lonely.py", SCALE.format(factor=7.0, expression="FACTOR * x"))
    with pytest.raises(ImportError, match=r"lonely\.scale: expected compiled code .* pip install 'penumbra\[native\]'"):
        module.scale(np.ones(2), np.empty(2))


def test_python_runs_instead_where_the_environment_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_NATIVE", "python")
    module = imported(tmp_path / "plain.py", SCALE.format(factor=2.0, expression="FACTOR * x"))
    assert module.scale(np.ones(2), np.empty(2)) == 4.0
    assert module.scale._code is None
    monkeypatch.setenv("PENUMBRA_NATIVE", "rust")
    with pytest.raises(ValueError, match="expected one of library, jit, python, got 'rust'"):
        module.scale(np.ones(2), np.empty(2))


def good():
    return [np.zeros((5, 3)), *ball_arrays(), np.empty(5), np.empty((5, 3)), np.empty((5, 3))]


def ball_arrays():
    return surface.Surface(*ball(np.random.default_rng(0))).arrays


def read_only(array):
    array = array.copy()
    array.flags.writeable = False
    return array


@pytest.mark.parametrize(
    ("at", "change", "words"),
    [
        (0, lambda a: a.astype(np.float32), r"points: expected f8\[n, 3\], got an array float32 \(5, 3\)"),
        (0, lambda a: np.zeros((5, 4)), r"points: expected f8\[n, 3\], got an array float64 \(5, 4\)"),
        (0, lambda a: np.zeros((10, 3))[::2], "not contiguous"),
        (0, lambda a: a.tolist(), r"points: expected f8\[n, 3\], got list"),
        (5, lambda a: np.empty(4), r"distance: expected out f8\[n\], got an array float64 \(4,\), with n = 5 from points"),
        (5, read_only, "distance: .* read-only"),
    ],
)
def test_an_array_that_does_not_fit_is_refused_in_words(at, change, words):
    arguments = good()
    surface.nearest_points(*arguments)
    arguments[at] = change(arguments[at])
    with pytest.raises(TypeError, match=words):
        surface.nearest_points(*arguments)


def test_numbers_that_do_not_fit_and_arguments_too_few_are_refused():
    with pytest.raises(TypeError, match=r"expected 8 arguments \(points, .*\), got 2"):
        surface.nearest_points(np.zeros((5, 3)), np.zeros(3))
    images = np.zeros((4, 4), np.float32), np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.int32)
    V, faces = ball(np.random.default_rng(0))
    with pytest.raises(TypeError, match=r"start: expected i8, got 0\.5"):
        raster._draw(V, faces, 1.0, 1.0, 0.0, 0.0, np.ones(len(faces), np.uint8), 0.5, *images)


@pytest.mark.parametrize("text", ["f9[n]", "f8[n", "f8[n] f8", "u2", "f8[n] -> f8[n]"])
def test_a_signature_that_means_nothing_is_refused(text):
    with pytest.raises(ValueError, match=r"^expected "):
        Signature(text)


def test_a_signature_has_as_many_parameters_as_its_function():
    with pytest.raises(ValueError, match="expected a signature of 2 parameters"):
        kernel("f8[n]")(lambda x, y: None)


def test_an_inner_function_stays_a_function():
    @inner
    def twice(x):
        return 2 * x

    assert twice(4) == 8 and not isinstance(twice, Kernel)


def test_no_service_imports_numba_when_its_kernels_are_called():
    code = """
        import sys
        import numpy as np
        from penumbra.shared.geometry import raster
        V, faces = np.array([[0.0, 0, 1], [1, 0, 1], [0, 1, 1]]), np.array([[0, 1, 2]], np.int32)
        assert raster.silhouette(V, faces, (9.0, 9.0, 0.0, 0.0), (0, 0, 9, 9)).any()
        assert not {"numba", "llvmlite"} & set(sys.modules)
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], cwd=ROOT, check=True)


def test_libraries_are_found_for_the_processor():
    assert machine.name() in {Path(name).stem for name in manifest()["libraries"]} | {None}
    path = machine.library()
    assert path is not None and hasattr(ctypes.CDLL(str(path)), surface.nearest_points.symbol)
