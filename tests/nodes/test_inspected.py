"""What compensation keeps at hand of the inspections that come by topic."""

from __future__ import annotations

import pytest
from builtin_interfaces.msg import Time
from mdf_interfaces.msg import Inspection
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from mdf_core.errors import NoInspectionError
from mdf_nodes.inspected import MOST_PAIRS, Pair, Pairing, RecentPairs

BYTES = 100


def pair(job_id: str, second: int = 0) -> Pair:
    header = Header(stamp=Time(sec=second))
    return Pair(Inspection(header=header, job_id=job_id), PointCloud2(header=header, data=bytes(BYTES)))


def test_what_belongs_together_is_joined_whichever_comes_first() -> None:
    pairing, first, second = Pairing(), pair("a", 1), pair("b", 2)
    assert pairing.add(first.inspection) is None and pairing.add(second.displacement) is None
    for joined, wanted in (
        (pairing.add(second.inspection), second),
        (pairing.add(first.displacement), first),
    ):
        assert joined is not None
        assert joined.inspection is wanted.inspection and joined.displacement is wanted.displacement


def test_the_newest_inspections_are_kept_and_the_last_one_always() -> None:
    recent = RecentPairs(2 * BYTES)
    for job_id in "abc":
        recent.add(pair(job_id))
    assert [each.job_id for each in recent.named(["c", "b"])] == ["c", "b"]
    with pytest.raises(NoInspectionError, match=r"no inspection a .* b, c"):
        recent.named(["a"])
    small = RecentPairs(1)
    small.add(pair("a"))
    small.add(pair("b"))
    assert [each.job_id for each in small.named([])] == ["b"]


def test_the_memory_of_many_small_inspections_does_not_grow() -> None:
    recent = RecentPairs(10_000 * BYTES)
    for number in range(MOST_PAIRS + 2):
        recent.add(pair(f"{number}"))
    assert len(recent.named([f"{number}" for number in range(2, MOST_PAIRS + 2)])) == MOST_PAIRS
    with pytest.raises(NoInspectionError, match="no inspection 1"):
        recent.named(["1"])


def test_an_inspection_that_comes_again_takes_the_place_of_the_first() -> None:
    recent, again = RecentPairs(2 * BYTES), pair("a")
    for each in (pair("a"), pair("b"), again):
        recent.add(each)
    assert recent.latest is again and len(recent.named(["a", "b"])) == 2


def test_nothing_is_left_after_clearing() -> None:
    recent = RecentPairs(BYTES)
    recent.add(pair("a"))
    recent.clear()
    assert recent.latest is None
    with pytest.raises(NoInspectionError, match="register a scan"):
        recent.named([])
