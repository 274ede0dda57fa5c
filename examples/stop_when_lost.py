"""Stops a robot while the pose is lost, or older than 100 ms, or none arrives for as long.

    penumbra up                        # in another terminal
    python examples/stop_when_lost.py

Put the calls of your robot into `stop` and `go`. This is no safety function: no computer here guarantees when it runs.
"""

import contextlib

import penumbra

OLDEST_S = 0.1


def stop(why: str) -> None:
    print(f"stop: {why}", flush=True)


def go() -> None:
    print("go", flush=True)


def main() -> None:
    with penumbra.connect() as cell:
        poses, is_stopped = cell.poses(timeout=OLDEST_S), True
        while True:
            try:
                pose = next(poses)
                late = f"the pose is {1e3 * pose.age_s:.0f} ms old" if pose.age_s > OLDEST_S else ""
                why = "the target is lost" if pose.state == "lost" else late
            except TimeoutError as error:
                why = str(error)
            if why and not is_stopped:
                stop(why)
            elif not why and is_stopped:
                go()
            is_stopped = bool(why)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
