"""Streams and films that only GStreamer makes, in the system's Python, which has its bindings; imports nothing of Penumbra.

`/usr/bin/python3 gstreamer.py serve PORT RATE_HZ` is a real RTSP server at rtsp://127.0.0.1:PORT/camera whose pictures (JPEG over
RTP) show their time of creation [ms since the epoch]; it prints a line when it listens. `gstreamer.py film FILE MS...`
writes a film (Matroska) without an even rate, whose pictures show their numbers, at these times.
"""

from __future__ import annotations

import sys
import threading
import time

WIDTH, HEIGHT, BLOCK = 128, 96, 16
"""Size of a picture, and of the square that shows one bit of its number [px]: 48 bits hold milliseconds since the epoch."""
COLUMNS, ROWS = WIDTH // BLOCK, HEIGHT // BLOCK
DARK, LIGHT = 40, 215


def luma(number: int) -> bytes:
    """The brightness of a picture that shows a number: HEIGHT x WIDTH bytes, a light square for each bit that is set, the lowest
    first."""
    rows = []
    for row in range(ROWS):
        bits = [(number >> (row * COLUMNS + column)) & 1 for column in range(COLUMNS)]
        rows.append(b"".join(bytes([LIGHT if bit else DARK]) * BLOCK for bit in bits) * BLOCK)
    return b"".join(rows)


GREY = bytes([128]) * (WIDTH * HEIGHT // 2)
"""The colours of a picture in I420."""


def caps(rate_hz: int) -> str:
    return f"video/x-raw,format=I420,width={WIDTH},height={HEIGHT},framerate={rate_hz}/1"


def serve(port: str, rate_hz: int) -> None:
    """Serves the pictures of a clock until it is killed."""
    import gi

    gi.require_version("Gst", "1.0")
    gi.require_version("GstRtspServer", "1.0")
    from gi.repository import GLib, Gst, GstRtspServer

    Gst.init(None)

    def push(source: Gst.Element) -> None:
        """Pushes a picture each period, for as long as there is a client."""
        due = time.monotonic()
        while True:
            picture = Gst.Buffer.new_wrapped(luma(time.time_ns() // 1_000_000) + GREY)
            if source.emit("push-buffer", picture) != Gst.FlowReturn.OK:
                return
            due += 1 / rate_hz
            time.sleep(max(0.0, due - time.monotonic()))

    def begin(factory: GstRtspServer.RTSPMediaFactory, media: GstRtspServer.RTSPMedia) -> None:
        source = media.get_element().get_by_name("source")
        threading.Thread(target=push, args=(source,), daemon=True).start()

    factory = GstRtspServer.RTSPMediaFactory()
    factory.set_launch(
        f"( appsrc name=source is-live=true do-timestamp=true format=time max-buffers=1 leaky-type=downstream "
        f"caps={caps(rate_hz)}"
        " ! jpegenc quality=90 ! rtpjpegpay name=pay0 pt=26 )"
    )
    factory.set_shared(True)
    factory.connect("media-configure", begin)
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(port)
    server.get_mount_points().add_factory("/camera", factory)
    server.attach(None)
    print("listening", flush=True)
    GLib.MainLoop().run()


def film(path: str, times_ms: list[int]) -> None:
    """Writes a film with a picture at each of these times."""
    import gi

    gi.require_version("Gst", "1.0")
    from gi.repository import Gst

    Gst.init(None)
    pipeline = Gst.parse_launch(
        f"appsrc name=source format=time caps={caps(0)} ! jpegenc ! matroskamux ! filesink location={path}"
    )
    source = pipeline.get_by_name("source")
    pipeline.set_state(Gst.State.PLAYING)
    for number, at_ms in enumerate(times_ms):
        picture = Gst.Buffer.new_wrapped(luma(number) + GREY)
        picture.pts = at_ms * Gst.MSECOND
        source.emit("push-buffer", picture)
    source.emit("end-of-stream")
    pipeline.get_bus().timed_pop_filtered(10 * Gst.SECOND, Gst.MessageType.EOS | Gst.MessageType.ERROR)
    pipeline.set_state(Gst.State.NULL)


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(sys.argv[2], int(sys.argv[3]))
    else:
        film(sys.argv[2], [int(word) for word in sys.argv[3:]])
