"""The health check of a container: fails where its service is cut off from the router, or wrote nothing for five seconds.

With `--ready` it also fails while the service starts. Prints the status with its reasons. A service writes the file every second
where PENUMBRA_HEARTBEAT names it. Run by `python -S`, which starts in milliseconds.
"""

import os
import sys
import time

SILENT_S = 5.0

path = os.environ["PENUMBRA_HEARTBEAT"]
bad = ("down", "starting") if "--ready" in sys.argv else ("down",)
try:
    with open(path, encoding="utf-8") as file:
        status = file.read()
    silent_s = time.time() - os.stat(path).st_mtime
except FileNotFoundError:
    sys.exit("no heartbeat yet")
print(status, f"written {silent_s:.1f} s ago")
sys.exit(silent_s > SILENT_S or status.startswith(bad))
