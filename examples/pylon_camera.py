"""An adapter for cameras of Basler (`pip install pypylon`): `penumbra camera` publishes what this class reads.

    penumbra camera --source adapter:pylon_camera:Basler     # in the folder of this file; or in the cell file, with `source:`
    python examples/pylon_camera.py                          # one picture, without a cell
    PYLON_CAMEMU=1 python examples/pylon_camera.py           # the same without a camera, which pylon emulates then

Cameras of other makers need the same three functions: see docs/own-camera.md.
"""

from types import SimpleNamespace

from pypylon import pylon


class Basler:
    def __init__(self, name, camera):
        self.device = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateFirstDevice())
        self.device.Open()
        self.device.Width.Value, self.device.Height.Value = camera.width, camera.height
        self.device.AcquisitionFrameRateEnable.Value = True
        self.device.AcquisitionFrameRateAbs.Value = camera.rate_hz  # of USB cameras: AcquisitionFrameRate
        self.converter = pylon.ImageFormatConverter()
        self.converter.OutputPixelFormat = pylon.PixelType_RGB8packed
        self.device.StartGrabbing(pylon.GrabStrategy_LatestImageOnly)

    def read(self):
        with self.device.RetrieveResult(2000, pylon.TimeoutHandling_ThrowException) as result:
            return self.converter.Convert(result).GetArray(), None  # None: result.TimeStamp is by the camera's own clock

    def close(self):
        self.device.Close()


if __name__ == "__main__":
    basler = Basler("front", SimpleNamespace(width=640, height=480, rate_hz=20.0))
    image, _ = basler.read()
    print(f"a picture of {image.shape[1]} x {image.shape[0]} px")
    basler.close()
