"""Pictures of cameras, films and folders come in, frames with the time of their exposure go out, as the emulator's would.

`feed.py` defines a source of pictures; `live.py` has USB cameras (V4L2) and RTSP, `files.py` films and folders, `adapter.py` a
user's class for any SDK. `stamps.py` finds the time of exposure. `reader.py` drains a feed in its own thread, keeps the newest
picture, drops old ones, and reopens a lost camera.
"""
