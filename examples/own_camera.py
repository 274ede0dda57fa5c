"""Publishes the images of a camera, or of a video file again and again, as a camera of the cell.
They must have the size that the cell file gives: see docs/own-camera.md.

    penumbra up --cell mycell.yaml               # in another terminal; a cell file without `sim` starts no emulator
    python examples/own_camera.py 0              # /dev/video0
    python examples/own_camera.py video.mp4 --camera front
"""

import argparse
import contextlib
import sys
import time

import cv2

import penumbra


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="number of a device, or a video file")
    parser.add_argument("--camera", help="of the cell (default: its first)")
    options = parser.parse_args()
    is_device = options.source.isdecimal()
    video = cv2.VideoCapture(int(options.source) if is_device else options.source)
    with penumbra.connect() as cell:
        camera = cell.camera(options.camera or cell.cameras[0])
        while True:
            has_image, image = video.read()  # of a device: waits for the next image
            stamp_ns = time.time_ns()
            if has_image:
                camera.publish(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), stamp_ns)
            elif is_device or not video.set(cv2.CAP_PROP_POS_FRAMES, 0):
                sys.exit(f"expected images from {options.source}, got none; give a device number or a video file")
            if not is_device:
                time.sleep(1 / camera.rate_hz)


if __name__ == "__main__":
    try:
        with contextlib.suppress(KeyboardInterrupt):
            main()
    except (penumbra.BusError, LookupError, ValueError) as error:  # no router; no such camera; images of another size
        print(error, file=sys.stderr)
        sys.exit(2)
