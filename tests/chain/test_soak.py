"""A minute of a busy day: what must not grow does not. Half an hour of it is `penumbra bench soak`."""

import numpy as np
import pytest

from penumbra.tests.bench import soak
from penumbra.tests.bench.soak import Sample


def samples(values, **fixed):
    same = {"memory_mb": 100.0, "threads": 20, "handles": 30, "mapped": 5} | fixed
    return [Sample(5.0 * k, **(same | value)) for k, value in enumerate(values)]


def test_a_leak_is_seen_through_noise_and_steps_and_none_is_seen_where_there_is_none():
    rng = np.random.default_rng(1)
    leak = rng.normal(0.0, 0.2, 60) + 100.0 + 36.0 * 5.0 * np.arange(60) / 3600.0
    flat = rng.normal(0.0, 0.2, 60) + np.where(np.arange(60) < 5, 90.0, 100.0)  # one step, long ago
    assert soak.row_of("leaky", [samples([{"memory_mb": mb} for mb in leak])]).mb_per_hour == pytest.approx(36.0, rel=0.2)
    assert soak.row_of("fine", [samples([{"memory_mb": mb} for mb in flat])]).mb_per_hour == pytest.approx(0.0, abs=5.0)
    restarted = [samples([{"memory_mb": mb} for mb in leak[k : k + 20]]) for k in (0, 20, 40)]
    assert soak.row_of("restarted", restarted).mb_per_hour == pytest.approx(36.0, rel=0.5), "within each process, not between"


def test_threads_and_handles_that_pile_up_are_counted_and_those_that_come_and_go_are_not():
    piling = soak.row_of("piling", [samples([{"threads": 20 + k} for k in range(12)])])
    passing = soak.row_of("passing", [samples([{"handles": 30 + 9 * (k % 4 == 3)} for k in range(12)])])
    assert piling.threads == 8 and piling.handles == 0
    assert passing.handles == 0


@pytest.mark.slow
def test_after_a_minute_of_everything_that_happens_on_a_day_nothing_has_piled_up():
    result = soak.soak("table", seed=1, minutes=1.0, speed=96.0)
    assert {"client", "viewer", "occlusion", "absence", "nonsense", "kill", "router loss"} <= result["events"].keys()
    assert result["tracking_at_end"]
    rows = {row["service"]: row for row in result["rows"]}
    assert rows["launcher"]["processes"] == 1
    lived = [row for row in rows.values() if row["processes"]]
    assert len(lived) >= 4, "most services lived through it"
    for row in lived:  # a leak of an event leaves one for each of the dozens that there were
        assert row["threads"] <= 6, row
        assert row["handles"] <= 12, row
        assert row["mapped"] <= 12, row
    # Zenoh's readers keep the pool, 18 MB, of a process that was killed for as long as they live: bounded by the kills
    killed = 1 + result["events"]["kill"] + result["events"]["router loss"]
    assert result["shm_mb"]["last"] - result["shm_mb"]["first"] <= 40.0 * killed
