"""How much memory an inspection needs is known before it takes any."""

import subprocess
import sys

import pytest

import mdf_core as mdf
from mdf_core.errors import MemoryBudgetError
from mdf_core.memory import predicted_memory
from mdf_core.virtual_cell import ScannerSettings, build_part, scan_part

MEASURE = """
import resource
import mdf_core as mdf
from mdf_core.virtual_cell import ScannerSettings, Warp, build_part, scan_part
design = build_part("bracket")
deformed = design.vertices + Warp(design, 1.0, {length})(design.vertices)
scan = scan_part(deformed, design.faces, ScannerSettings(points={points})).scan
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
mdf.inspect(design, scan, mdf.Settings().replace({{"pose.initial": (0, 0, 0, 0, 0, 0, 1)}}))
print(1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))
"""


@pytest.fixture(scope="module")
def design():
    return build_part("bracket")


def test_an_inspection_beyond_the_budget_is_refused_with_the_sizes_and_what_to_do(design):
    scan = scan_part(design.vertices, design.faces, ScannerSettings(points=30_000)).scan
    with pytest.raises(MemoryBudgetError) as caught:
        mdf.inspect(design, scan, mdf.Settings().replace({"memory_mib": 50}))
    needs = predicted_memory(30_000, design, mdf.Settings())
    scan, triangles, motion = (f"{needs[part] / 2**20:,.0f} MiB" for part in ("scan", "design", "motion"))
    assert caught.value.what == (
        f"the inspection needs about {sum(needs.values()) / 2**20:,.0f} MiB, memory_mib allows 50 "
        f"(30,000 scan points {scan}, {len(design.faces):,} design triangles {triangles}, "
        f"the motion of 25,000 points {motion})"
    )
    assert "thinning.target_points" in caught.value.remedy


def test_the_budget_is_checked_before_the_work_starts(design):
    scan = scan_part(design.vertices, design.faces, ScannerSettings(points=30_000)).scan
    heard = []
    with pytest.raises(MemoryBudgetError):
        mdf.inspect(design, scan, mdf.Settings().replace({"memory_mib": 50}), heard.append)
    assert heard == []


def test_two_million_points_fit_into_a_gibibyte(design):
    assert sum(predicted_memory(2_000_000, design, mdf.Settings()).values()) < 2**30


@pytest.mark.parametrize("method", ["surface", "mdf"])
def test_more_points_need_more(design, method):
    settings = mdf.Settings().replace({"method": method})
    few, many = (sum(predicted_memory(count, design, settings).values()) for count in (1_000, 1_000_000))
    assert few < many


@pytest.mark.parametrize(("points", "length"), [(3_000, 50.0), (400_000, 50.0)])
def test_no_more_is_needed_than_was_predicted(design, points, length):
    code = MEASURE.format(points=points, length=length)
    used = int(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert used <= sum(predicted_memory(points, design, mdf.Settings()).values())
