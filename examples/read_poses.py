"""Prints the pose of the cell's first target, ten times a second.

penumbra up                        # in another terminal
python examples/read_poses.py
"""

import contextlib
import sys
import time

import penumbra


def main() -> None:
    with penumbra.connect() as cell:
        print(f"cell {cell.name} tracks {', '.join(cell.targets)} in frame {cell.frame}")
        for pose in cell.poses():  # each is the newest: the loop may be as slow as it likes
            x, y, z = 100 * pose.position
            seen_by = ", ".join(f"{name} {source.weight:.0%}" for name, source in pose.sources.items())
            print(
                f"{pose.state:8} x {x:7.2f}  y {y:7.2f}  z {z:7.2f} cm  +- {100 * pose.sigma[:3].max():.2f} cm  {seen_by}",
                flush=True,
            )
            time.sleep(0.1)


if __name__ == "__main__":
    try:
        with contextlib.suppress(KeyboardInterrupt):
            main()
    except penumbra.BusError as error:  # no router, no cell
        sys.exit(str(error))
