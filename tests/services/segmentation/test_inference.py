"""The running network: its masks beside torch's, its precisions, sizes compiled ahead, windows that a machine has time for."""

import os
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from penumbra.services.replay.chain import Replay, ReplayNode
from penumbra.services.segmentation import inference, model, openvino_step, prednet, service
from penumbra.services.segmentation.prednet import PredNet, Settings
from penumbra.services.segmentation.training import evaluate
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.labels import Label
from penumbra.shared.native import processor
from penumbra.shared.perception.lookout import MAX_PIXELS, Lookout, Window
from penumbra.tests.support import nodes
from penumbra.tests.support.live import wait_for
from penumbra.tests.support.network import as_rows, scene

SMALL = Settings(channels=(4, 4, 8), kernels=(3, 3, 3), decoder_channels=4)


@pytest.fixture(autouse=True)
def one_thread():
    torch.manual_seed(0)
    torch.set_num_threads(1)


def test_a_segmenter_forgets_when_time_jumps_and_remembers_when_it_flows():
    net = PredNet(SMALL).eval()
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    window = Window(0, 0, 64, 64)
    first = inference.Segmenter(prednet.stored(net), precision="f32")
    start = first(image, window, 10**9)
    flowing = [first(image, window, 10**9 + k * 50_000_000) for k in range(1, 4)]
    assert any((mask != start).any() for mask in flowing)
    np.testing.assert_array_equal(first(image, window, 10**9 + 10**10), start)
    with np.errstate(all="raise"):  # a clock that is set back by an hour
        np.testing.assert_array_equal(first(image, window, 10**9 - 3600 * 10**9), start)
    with pytest.raises(ValueError, match="expected a window inside the image of 64 x 64"):
        first(image, Window(8, 0, 64, 64), 10**9 + 10**10)


def test_a_window_that_the_network_cannot_take_is_continued_at_its_edges_and_its_state_kept():
    net = prednet.stored(PredNet(replace(SMALL, priors=2)).eval())
    rng = np.random.default_rng(0)
    images, priors = rng.integers(0, 255, (3, 70, 90, 3), dtype=np.uint8), rng.uniform(-1.0, 1.0, (70, 90, 2)).astype(np.float32)
    window, whole = Window(0, 0, 90, 70), Window(0, 0, 96, 72)
    ours, theirs = (inference.Segmenter(net, precision="f32", has_colours=False) for _ in range(2))
    for t, image in enumerate(images):
        found = ours(image, window, 10**9 + t * 50_000_000, priors)
        continued = (np.pad(of, ((0, 2), (0, 6), (0, 0)), "edge") for of in (image, priors))
        wanted = theirs(next(continued), whole, 10**9 + t * 50_000_000, next(continued))
        assert found.shape == (70, 90)
        np.testing.assert_array_equal(found, wanted[:70, :90])
    moved = ours(images[0], Window(8, 0, 82, 70), 10**9 + 3 * 50_000_000)
    assert moved.shape == (70, 82)
    ours.prepare(window)
    wait_for(lambda: ours.is_prepared(window), 20.0, "a compiled window")


@pytest.mark.parametrize(
    "settings",
    [
        SMALL,
        Settings(),
        Settings(SMALL.channels, SMALL.kernels, delay=True),
        Settings(cell="convlstm"),
        Settings(cell="conv"),
        Settings(priors=2),
        Settings(encoder=True),
    ],
)
def test_compiled_the_network_gives_torch_s_logits_and_state(settings):
    net = PredNet(settings).eval()
    for p in net.parameters():
        p.data += 0.05 * torch.randn_like(p)
    quick = openvino_step.Compiled(prednet.stored(net), "f32")
    for images in (scene(4, 96), scene(4, 96)[:, :64]):
        height, width = images.shape[1:3]
        state, other = net.initial_state(1, height, width), quick.initial_state(height, width)
        for t, image in enumerate(images):
            picture = inference.cut(image, Window(0, 0, width, height))
            known = np.random.default_rng(t).uniform(-1.0, 1.0, (height, width, 2)).astype(np.float32)
            given = known if settings.priors and t else None  # nothing is known of the first picture
            with torch.inference_mode():
                prior = None if given is None else torch.from_numpy(given).permute(2, 0, 1)[None]
                logits, _, state = net(torch.from_numpy(picture).permute(2, 0, 1)[None], state, prior)
            found, other = quick(picture, other, given)
            # both are sums of thousands of products in single precision, in another order
            np.testing.assert_allclose(found, logits[0].numpy(), rtol=1e-3, atol=1e-3)
            for a, b in zip(other, state, strict=True):
                np.testing.assert_allclose(a, as_rows(b), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("precision", "tied", "share"), [("f32", 0.0, 0.001), (None, 0.1, 0.01)])
def test_masks_of_the_running_network_are_torch_s_but_for_rounding(precision, tied, share):
    """Where the processor has bfloat16, classes whose logits differ by less than 0.1 are as likely as each other."""
    images, window = scene(), Window(0, 0, 96, 96)
    net, card = prednet.load(inference.WEIGHTS)
    calibrated = card["calibration"]["target_logit_offset"]
    offset = torch.zeros(len(Label), 1, 1)
    offset[list(inference.TARGET_LABELS)] = calibrated
    ours = inference.Segmenter(prednet.stored(net), calibrated, precision, has_colours=False)
    for t, (image, logits) in enumerate(zip(images, evaluate.run(net, images), strict=True)):
        mask = ours(image, window, (t + 1) * 50_000_000)
        first, second = (logits + offset).topk(2, dim=0).values
        differs = mask != (logits + offset).argmax(0).numpy()
        assert (differs & (first - second >= tied).numpy()).mean() < share
    assert len(np.unique(mask)) > 1


def test_a_network_of_other_channels_and_more_inputs_runs_with_nothing_but_its_weights():
    """Nothing but the settings and the arrays says how large it is."""
    rng, settings = np.random.default_rng(0), Settings((8, 12, 16), (3, 5, 3), decoder_channels=6)
    weights = prednet.stored(PredNet(settings)).weights
    for name in ("predict.0.weight", "predict.0.bias"):
        shape = (5 * model.FOLD**2, *weights[name].shape[1:])
        weights[name] = rng.normal(0.0, 0.1, shape).astype(np.float32)
    for name, count in (("ascend.0.weight", 2), ("drive.0.weight", 2), ("outline.weight", 1)):
        shape = (weights[name].shape[0], count * 5 * model.FOLD**2, 3, 3)
        weights[name] = rng.normal(0.0, 0.1, shape).astype(np.float32)
    network = openvino_step.Compiled(model.Model(settings, weights), "f32")
    logits, _ = network(rng.random((32, 48, 5), np.float32), network.initial_state(32, 48))
    assert logits.shape == (len(Label), 32, 48) and logits.std() > 0.0


def test_weights_that_are_not_their_card_s_are_refused():
    network = prednet.stored(PredNet(SMALL))
    with pytest.raises(ValueError, match=r"expected weights of Settings\(channels=\(4, 4, 16\).*, got others"):
        openvino_step.Compiled(model.Model(Settings((4, 4, 16), SMALL.kernels, SMALL.decoder_channels), network.weights), "f32")


def test_at_a_coarse_scale_the_network_sees_the_means_of_pixels():
    image = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    seen = inference.cut(image, Window(8, 16, 16, 8, 4))
    wanted = image[16:48, 8:72].reshape(8, 4, 16, 4, 3).mean(axis=(1, 3)) / 255.0
    np.testing.assert_allclose(seen, wanted, atol=1e-6)  # single precision


@pytest.mark.parametrize("isa", ["AVX512_CORE", "AVX2"])
def test_where_the_processor_has_no_bfloat16_the_masks_are_computed_in_single_precision(isa):
    """oneDNN, which OpenVINO computes with, is told to do without; the process finds that out, and the masks are the same."""
    code = (
        "import sys, numpy as np; from penumbra.services.segmentation import inference;"
        "from penumbra.shared.perception.lookout import Window;"
        "from penumbra.tests.support.network import scene; images = scene();"
        "segmenter = inference.load_segmenter(); window = Window(0, 0, 96, 96);"
        "masks = [segmenter(image, window, (t + 1) * 50_000_000) for t, image in enumerate(images)];"
        "sys.stdout.buffer.write(b'masks:' + np.stack(masks).tobytes())"
    )
    script = f"from penumbra.shared.native import processor; assert not processor.has_bfloat16(); {code}"
    environment = {**os.environ, "ONEDNN_MAX_CPU_ISA": isa}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, env=environment)
    assert done.returncode == 0, done.stderr.decode()
    written = done.stdout.partition(b"masks:")[2]  # after what libraries print
    masks = np.frombuffer(written, np.uint8).reshape(-1, 96, 96)
    ours, window = inference.load_segmenter(precision="f32"), Window(0, 0, 96, 96)
    for t, (mask, image) in enumerate(zip(masks, scene(), strict=True)):
        # sums in another order: only pixels whose two best classes are equally likely change
        assert (mask != ours(image, window, (t + 1) * 50_000_000)).mean() < 1e-3


def test_bfloat16_is_for_processors_that_are_faster_with_it(monkeypatch, tmp_path):
    monkeypatch.setattr(processor, "CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    assert not processor.has_bfloat16(), "no such file"

    def has(vendor: str, flags: str, isa: str = "DEFAULT") -> bool:
        processor.CPUINFO.write_text(f"vendor_id\t: {vendor}\nflags\t\t: {flags}\n")
        monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", isa)
        return processor.has_bfloat16()

    assert has("GenuineIntel", "avx512_bf16 amx_bf16")
    assert has("GenuineIntel", "avx512_bf16 amx_bf16", "AVX512_CORE_AMX")
    assert not has("GenuineIntel", "avx512_bf16 amx_bf16", "AVX512_CORE")
    assert not has("GenuineIntel", "avx2 avx512_bf16")
    assert has("AuthenticAMD", "avx2 avx512_bf16")
    assert has("AuthenticAMD", "avx2 avx512_bf16", "AVX512_CORE_BF16")
    assert not has("AuthenticAMD", "avx2 avx512_bf16", "AVX512_CORE")
    assert not has("AuthenticAMD", "avx2")


def test_two_cameras_share_what_is_compiled_and_not_what_they_remember():
    first, second, window = scene(3), scene(3)[:, ::-1].copy(), Window(0, 0, 96, 96)
    stamps = [(t + 1) * 50_000_000 for t in range(3)]
    alone = inference.load_segmenter()
    wanted = [alone(image, window, stamp) for image, stamp in zip(first, stamps, strict=True)]
    one, other = inference.load_segmenter(), inference.load_segmenter()
    for mask, a, b, stamp in zip(wanted, first, second, stamps, strict=True):
        other(b, window, stamp)
        np.testing.assert_array_equal(one(a, window, stamp), mask)


def test_sizes_made_ready_in_the_background_or_thrown_out_give_the_same_masks(monkeypatch):
    images, windows = scene(4), (Window(0, 0, 96, 96), Window(0, 0, 96, 64))
    plain, prepared = inference.load_segmenter(), inference.load_segmenter()
    wanted = [plain(image, windows[t % 2], (t + 1) * 50_000_000) for t, image in enumerate(images)]
    monkeypatch.setattr(openvino_step, "MOST", 1)
    for t, image in enumerate(images):
        prepared.prepare(windows[t % 2])
        np.testing.assert_array_equal(prepared(image, windows[t % 2], (t + 1) * 50_000_000), wanted[t])


class Waiting(ReplayNode):
    """A replica whose cameras are another one's."""

    def owns(self, stream: str) -> bool:
        return False


def test_a_replica_that_waits_has_compiled_for_the_window_of_now():
    cell = cells.load("table")
    replay, segmenter = Replay(cell, services=()), inference.load_segmenter()  # which has what the service's own have
    node = Waiting(replay, "segmentation")
    service.start(node, SimpleNamespace(camera=None, weights=inference.WEIGHTS, pixels=MAX_PIXELS))
    assert not node.is_warm(), "nobody has said where to look"
    poses = [nodes.pose(stamp_ns, x=0.2) for stamp_ns in range(1_000_000_000, 2_000_000_000, 100_000_000)]
    replay.run((topics.FUSED, {"target": "forearm"}, pose) for pose in poses)
    lookout = Lookout(cell, "front")
    lookout.add(poses[-1])
    wait_for(lambda: segmenter.is_prepared(lookout.look(poses[-1].stamp_ns)), 60, "the network compiled ahead")
    assert node.is_warm()


def test_a_machine_gets_as_large_windows_as_it_has_time_for_within_bounds():
    segmenter = inference.load_segmenter()
    windows = [inference.affordable(segmenter, Window(0, 0, 64, 96), step_s) for step_s in (1e-9, 1e9)]
    assert windows == [inference.FEWEST_PIXELS, MAX_PIXELS]
