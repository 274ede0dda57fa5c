"""Pictures of cameras, films and folders come in, frames with the time of their exposure go out, as the emulator's would.

`feed.py` says what delivers pictures; `live.py` has USB cameras (V4L2) and RTSP, `files.py` films and folders, `adapter.py` a
class of the user's for any SDK. `stamps.py` finds the time of exposure. `reader.py` drains a feed in a thread of its own, keeps
the newest picture, leaves out what is old, and opens again what was lost.
"""
