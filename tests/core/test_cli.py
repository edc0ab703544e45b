"""The command mdf, as an engineer at a prompt and a script meet it."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mcap_ros2.writer import Writer

import mdf_core
from mdf_core import cli
from mdf_core.distortion import fraction_unrecovered
from mdf_core.errors import RegistrationFailedError
from mdf_core.mesh_io import load_design, stl_bytes
from mdf_core.point_cloud2 import columns_of_scan, pack_cloud
from mdf_core.settings import METHODS, Settings
from mdf_core.virtual_cell import Printer, ScannerSettings, Warp, build_part, scan_part

RESULTS = {"inspection.npz", "report.json", "deviation.png"}
# The scans below lie where the design lies, and one kernel width is enough for the warp; how pose and width are found
# has tests of its own.
QUICK = ("--set", "pose.initial=0,0,0,0,0,0,1", "--set", "surface.beta=1.4", "--set", "surface.rank=150")
POINT_CLOUD2 = """std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
"""


class Case:
    """A part with its warped prints, as files."""

    def __init__(self, folder, name="bracket"):
        part = build_part(name)
        self.design = folder / f"{name}.stl"
        self.design.write_bytes(stl_bytes(part.vertices, part.faces))
        self.warp = Warp(part, 1.2, seed=4)
        printed = Printer(self.warp).print_part(part.vertices)
        self.clouds = [scan_part(printed, part.faces, ScannerSettings(points=4_000), seed).scan for seed in (0, 1)]
        self.scans = []
        for number, cloud in enumerate(self.clouds):
            self.scans.append(folder / f"scan{number}.npy")
            np.save(self.scans[-1], np.hstack([cloud.points, cloud.normals]))


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return Case(tmp_path_factory.mktemp("case"))


@pytest.fixture(scope="module")
def bag(case, tmp_path_factory):
    """A folder with design.stl and a bag of the two scans on /points, one per second."""
    folder = tmp_path_factory.mktemp("bag")
    (folder / "design.stl").write_bytes(case.design.read_bytes())
    write_bag(folder / "scans.mcap", case.clouds)
    return folder


def write_bag(path, clouds, topic="/points"):
    with path.open("wb") as stream, Writer(stream, chunk_size=1) as writer:
        schema = writer.register_msgdef("sensor_msgs/msg/PointCloud2", POINT_CLOUD2)
        for second, cloud in enumerate(clouds):
            packed = pack_cloud(columns_of_scan(cloud))
            names = ("name", "offset", "datatype", "count")
            message = {
                "header": {"stamp": {"sec": second, "nanosec": 0}, "frame_id": "scanner"},
                "height": 1,
                "width": packed.width,
                "fields": [dict(zip(names, field, strict=True)) for field in packed.fields],
                "is_bigendian": False,
                "point_step": packed.point_step,
                "row_step": packed.width * packed.point_step,
                "data": packed.data.tobytes(),
                "is_dense": True,
            }
            writer.write_message(topic, schema, message, log_time=second * 10**9, publish_time=second * 10**9)


@pytest.fixture
def mdf(capsys):
    """``mdf("inspect", ...)``: exit status, stdout, stderr."""

    def run(*arguments):
        capsys.readouterr()
        try:
            status = cli.main([str(argument) for argument in arguments])
        except SystemExit as exit_:
            status = exit_.code
        return status, *capsys.readouterr()

    return run


def refused(outcome, *fragments):
    """Exit status 2, one line on stderr that has all fragments, nothing on stdout."""
    status, out, err = outcome
    assert (status, out) == (2, ""), err
    assert err.startswith("error: ") and err.endswith("\n") and err.count("\n") == 1
    for fragment in fragments:
        assert str(fragment) in err


def names_in(folder):
    return {path.name for path in folder.iterdir()}


# Results


def test_inspect_measures_the_warp(mdf, case, tmp_path):
    out = tmp_path / "deep/er"
    status, text, err = mdf("inspect", case.design, case.scans[0], "--out", out, *QUICK)
    assert (status, err) == (0, "")
    assert names_in(out) == RESULTS
    assert "NO DECISION" in text and str(out) in text
    design = load_design(case.design)
    with np.load(out / "inspection.npz") as fields:
        np.testing.assert_array_equal(fields["vertices"], design.vertices)
        np.testing.assert_array_equal(fields["faces"], design.faces)
        truth = case.warp(design.vertices)
        assert fraction_unrecovered(design, truth, fields["displacement"], fields["supported"]) < 0.05
    entries = json.loads((out / "report.json").read_text())
    assert entries["scan_path"] == str(case.scans[0])
    assert "redesign" not in entries


def test_settings_and_units_reach_the_inspection(mdf, case, tmp_path):
    inches = tmp_path / "scan.npy"
    np.save(inches, case.clouds[0].points / 25.4)
    changes = ("--set", "surface.rank=80", "--set", "verdict.tolerance_mm = 2")
    status, _, err = mdf("inspect", case.design, inches, "--scan-unit", "inch", *QUICK, *changes, "--out", tmp_path)
    assert status == 0, err
    entries = json.loads((tmp_path / "report.json").read_text())
    assert entries["settings"]["surface.rank"] == 80
    assert entries["settings"]["verdict.tolerance_mm"] == 2.0
    assert entries["settings"]["pose.initial"] == [0, 0, 0, 0, 0, 0, 1]
    assert entries["max_displacement_mm"] == pytest.approx(case.warp.amplitude_mm, rel=0.1)


@pytest.mark.parametrize("method", METHODS)
def test_the_method_reaches_the_inspection(mdf, case, tmp_path, monkeypatch, method):
    asked = []

    def inspect(design, scan, settings, progress, regions):
        asked.append(settings)
        raise RegistrationFailedError("enough for this test")

    monkeypatch.setattr("mdf_core.pipeline.inspect", inspect)
    refused(mdf("inspect", case.design, case.scans[0], "--method", method, "--out", tmp_path), "enough")
    assert asked == [Settings().replace({"method": method})]


def test_compensate_writes_a_redesign_with_the_faces_and_vertex_order_of_the_design(mdf, case, tmp_path):
    status, _, err = mdf("compensate", case.design, *case.scans, "--out", tmp_path, *QUICK)
    assert (status, err) == (0, "")
    assert names_in(tmp_path) == RESULTS | {"redesigned.stl", "record.json", "scan_2"}
    assert names_in(tmp_path / "scan_2") == RESULTS
    design, redesign = load_design(case.design), load_design(tmp_path / "redesigned.stl")
    np.testing.assert_array_equal(redesign.faces, design.faces)
    reprinted = redesign.vertices + case.warp(redesign.vertices)
    assert fraction_unrecovered(design, case.warp(design.vertices), reprinted - design.vertices) > 0.9
    entries = json.loads((tmp_path / "report.json").read_text())
    assert entries["redesign"]["sha256"] == redesign.file_sha256
    assert len(set(entries["redesign_scan_sha256"])) == 2


def test_two_runs_give_the_same_bytes(mdf, tmp_path):
    case, outcomes = Case(tmp_path, "plate"), []  # whose pose is soon found
    for run in ("first", "second"):
        status, _, err = mdf("compensate", case.design, case.scans[0], "--out", tmp_path / run)
        assert (status, err) == (0, "")
        entries = json.loads((tmp_path / run / "report.json").read_text())
        del entries["stage_seconds"]
        files = [(tmp_path / run / name).read_bytes() for name in ("redesigned.stl", "inspection.npz", "deviation.png")]
        outcomes.append((entries, *files))
    assert outcomes[0] == outcomes[1]


def test_replay_inspects_the_last_scan_of_the_bag(mdf, bag, case, tmp_path):
    status, _, err = mdf("replay", bag, "--out", tmp_path, *QUICK)
    assert (status, err) == (0, "")
    assert names_in(tmp_path) == RESULTS | {"redesigned.stl"}
    source = json.loads((tmp_path / "report.json").read_text())["source"]
    assert source == {"bag": str(bag), "topic": "/points", "log_time_ns": 10**9, "truncated": False}
    design = load_design(case.design)
    with np.load(tmp_path / "inspection.npz") as fields:
        truth = case.warp(design.vertices)
        assert fraction_unrecovered(design, truth, fields["displacement"], fields["supported"]) < 0.05


def test_replay_of_a_single_file_takes_the_scan_and_the_design_it_is_told(mdf, bag, case, tmp_path):
    status, _, err = mdf(
        "replay", bag / "scans.mcap", "--topic", "points", "--scan-index", 0, "--design", case.design,
        "--out", tmp_path, *QUICK,
    )  # fmt: skip
    assert (status, err) == (0, "")
    entries = json.loads((tmp_path / "report.json").read_text())
    assert entries["source"]["log_time_ns"] == 0
    assert entries["design"]["path"] == str(case.design)


def test_replay_of_a_truncated_bag_reads_up_to_the_cut_and_says_so(mdf, bag, case, tmp_path):
    whole = (bag / "scans.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(0.8 * len(whole))])
    status, _, err = mdf("replay", cut, "--design", case.design, "--out", tmp_path / "out", *QUICK)
    assert status == 0
    assert err.startswith("warning: ") and str(cut) in err and "cut" in err and err.count("\n") == 1
    source = json.loads((tmp_path / "out/report.json").read_text())["source"]
    assert source["truncated"] is True
    assert source["log_time_ns"] == 0, "the second scan lies beyond the cut"


def test_a_replay_whose_redesign_fails_a_check_leaves_the_inspection_and_no_redesign_of_before(mdf, bag, tmp_path):
    assert mdf("replay", bag, "--out", tmp_path, *QUICK)[0] == 0
    refused(mdf("replay", bag, "--out", tmp_path, *QUICK, "--set", "release.max_move_mm=0.1"), "largest_move")
    assert names_in(tmp_path) == RESULTS
    entries = json.loads((tmp_path / "report.json").read_text())
    assert entries["settings"]["release.max_move_mm"] == 0.1 and "redesign" not in entries


def test_a_replay_of_a_scan_of_much_else_leaves_the_inspection(mdf, case, tmp_path):
    design = load_design(case.design)
    printed = Printer(case.warp).print_part(design.vertices)
    many = scan_part(printed, design.faces, ScannerSettings(points=4_000, outlier_share=0.15), 0).scan
    write_bag(tmp_path / "scans.mcap", [many])
    bag, out = tmp_path / "scans.mcap", tmp_path / "out"
    out.mkdir()
    (out / "redesigned.stl").touch()  # of another scan
    refused(mdf("replay", bag, "--design", case.design, "--out", out, *QUICK), bag, "do not lie on the part")
    assert names_in(out) == RESULTS


def test_a_replay_does_not_write_over_the_design_it_is_given(mdf, bag, case, tmp_path):
    design = tmp_path / "redesigned.stl"
    design.write_bytes(case.design.read_bytes())
    refused(mdf("replay", bag, "--design", design, "--out", tmp_path, *QUICK), "redesigned.stl, which is needed")
    assert design.read_bytes() == case.design.read_bytes()


def test_demo_prints_scans_redesigns_and_prints_again(mdf, tmp_path):
    (tmp_path / "redesigned_before.ply").touch()  # of an earlier run
    status, text, err = mdf("demo", "--out", tmp_path)
    assert (status, err) == (0, "")
    assert names_in(tmp_path) == RESULTS | {"redesigned.stl"}
    assert json.loads((tmp_path / "report.json").read_text())["simulated"] is True
    rms = {line.split("│")[1].strip(): float(line.split("│")[2]) for line in text.splitlines() if line.startswith("│")}
    assert rms["true, print of the redesign"] < 0.05 * rms["true, first print"]
    assert rms["measured on the scan"] == pytest.approx(rms["true, first print"], rel=0.05)


def test_an_ambiguous_pose_is_warned_of(mdf, tmp_path):
    box = trimesh.creation.box((60.0, 40.0, 20.0)).subdivide_to_size(4.0)
    design = tmp_path / "box.stl"
    box.export(design)
    points, _ = trimesh.sample.sample_surface(box, 3_000, seed=0)
    np.save(tmp_path / "scan.npy", points)
    status, text, err = mdf("inspect", design, tmp_path / "scan.npy", "--out", tmp_path / "out")
    assert status == 0
    assert err.startswith("warning: ") and "pose" in err and err.count("\n") == 1
    assert "NO DECISION" in text
    assert json.loads((tmp_path / "out/report.json").read_text())["pose_ambiguous"] is True


# Refusals


def content_of(kind, case):
    return {"missing": None, "empty": b"", "corrupt": case.design.read_bytes()[:-7], "text": b"hello"}[kind]


@pytest.mark.parametrize("kind", ["missing", "empty", "corrupt", "text"])
def test_a_design_that_cannot_be_read_is_refused(mdf, case, tmp_path, kind):
    design = tmp_path / "design.stl"
    if (content := content_of(kind, case)) is not None:
        design.write_bytes(content)
    refused(mdf("inspect", design, case.scans[0], "--out", tmp_path / "out"), design)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["missing", "empty", "corrupt", "text"])
def test_a_scan_that_cannot_be_read_is_refused(mdf, case, tmp_path, kind):
    scan = tmp_path / "scan.stl"
    if (content := content_of(kind, case)) is not None:
        scan.write_bytes(content)
    refused(mdf("compensate", case.design, case.scans[0], scan, "--out", tmp_path / "out"), scan)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("unit", "factor"), [("m", "1000"), ("inch", "25.4"), ("cm", "10")])
def test_a_wrong_unit_is_refused_and_the_factor_named(mdf, case, tmp_path, unit, factor):
    refused(mdf("inspect", case.design, case.scans[0], "--scan-unit", unit, "--out", tmp_path, *QUICK), factor)


def test_an_unknown_method_is_refused_and_the_known_ones_listed(mdf, case, tmp_path):
    refused(mdf("inspect", case.design, case.scans[0], "--method", "icp", "--out", tmp_path), "icp", *METHODS)


@pytest.mark.parametrize(
    ("setting", "fragments"),
    [
        ("surface.rank", ("surface.rank", "key=value")),
        ("surface.rnak=9", ("surface.rnak", "surface.rank")),
        ("surface.rank=many", ("surface.rank", "many")),
        ("surface.rank=-1", ("surface.rank", "-1")),
    ],
)
def test_a_wrong_setting_is_refused(mdf, case, tmp_path, setting, fragments):
    refused(mdf("inspect", case.design, case.scans[0], "--set", setting, "--out", tmp_path), *fragments)


@pytest.mark.parametrize("command", ["inspect", "compensate", "replay", "demo"])
def test_an_output_folder_that_cannot_be_written_is_refused_before_the_work(mdf, case, bag, tmp_path, command):
    (tmp_path / "file").touch()
    out = tmp_path / "file/below"
    inputs = {"inspect": (case.design, case.scans[0]), "compensate": (case.design, case.scans[0]), "replay": (bag,)}
    began = time.monotonic()
    refused(mdf(command, *inputs.get(command, ()), "--out", out), out)
    assert time.monotonic() - began < 1.0


@pytest.mark.parametrize("command", ["compensate", "replay", "demo"])
@pytest.mark.parametrize(
    ("content", "told"),
    [
        ('{"record": "of another program"}', "is no record of a redesign"),
        ("[1, ", "cannot be read"),
        ('{"kind": "mdf redesign record", "version": 1}', "does not hold what a record holds: KeyError('redesigns')"),
        ('{"kind": "mdf redesign record", "version": 1, "redesigns": [1]}', "does not hold what a record holds"),
    ],
)
def test_a_folder_with_the_record_of_something_else_is_refused_before_the_work(
    mdf, case, bag, tmp_path, command, content, told
):
    record = tmp_path / "record.json"
    record.write_text(content)
    inputs = {"compensate": (case.design, case.scans[0]), "replay": (bag,)}
    refused(mdf(command, *inputs.get(command, ()), "--out", tmp_path), record, told, "choose another folder for --out")
    assert names_in(tmp_path) == {"record.json"} and record.read_text() == content


def test_a_bag_without_the_topic_is_refused_and_its_topics_listed(mdf, bag, tmp_path):
    refused(mdf("replay", bag, "--topic", "cloud", "--out", tmp_path), bag, "cloud", "/points")


@pytest.mark.parametrize("index", [2, -3])
def test_a_scan_the_bag_does_not_have_is_refused(mdf, bag, tmp_path, index):
    refused(mdf("replay", bag, "--scan-index", index, "--out", tmp_path), "/points", "2 scans", "-2 to 1")


def test_a_bag_cut_before_its_first_scan_is_refused(mdf, bag, case, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((bag / "scans.mcap").read_bytes()[:3_000])
    status, out, err = mdf("replay", cut, "--design", case.design, "--out", tmp_path)
    assert (status, out) == (2, "")
    assert str(cut) in err.splitlines()[-1] and err.splitlines()[-1].startswith("error: ")


@pytest.mark.parametrize("kind", ["missing", "empty", "no bag"])
def test_a_bag_that_cannot_be_read_is_refused(mdf, tmp_path, kind):
    path = tmp_path / "bag.mcap"
    if kind != "missing":
        path.write_bytes(b"" if kind == "empty" else b"no MCAP at all")
    refused(mdf("replay", path, "--out", tmp_path), path)


def test_a_bag_without_a_design_beside_it_is_refused(mdf, bag, tmp_path):
    (tmp_path / "scans.mcap").write_bytes((bag / "scans.mcap").read_bytes())
    refused(mdf("replay", tmp_path, "--out", tmp_path / "out"), tmp_path / "design.stl")


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        ((), "COMMAND"),
        (("explode",), "explode"),
        (("inspect", "design.stl"), "SCAN"),
        (("inspect", "design.stl", "scan.ply"), "--out"),
        (("inspect", "design.stl", "scan.ply", "--out", "out", "--scan-unit", "furlong"), "furlong"),
        (("replay", "bag", "--out", "out", "--scan-index", "last"), "last"),
    ],
)
def test_a_wrong_command_line_is_refused_in_one_line(mdf, arguments, fragment):
    refused(mdf(*arguments), fragment, "--help")


def test_an_unknown_part_is_refused_and_the_parts_listed(mdf, tmp_path):
    refused(mdf("demo", "--part", "teapot", "--out", tmp_path), "teapot", "bracket")


def test_a_fault_of_ours_has_a_trace_and_its_own_status(mdf, case, tmp_path, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr("mdf_core.pipeline.inspect", broken)
    status, _, err = mdf("inspect", case.design, case.scans[0], "--out", tmp_path)
    assert status == 1
    assert "Traceback" in err and "ZeroDivisionError: a fault" in err


def test_version_and_help(mdf):
    assert mdf("--version") == (0, f"mdf {mdf_core.__version__}\n", "")
    status, text, _ = mdf("--help")
    assert status == 0
    for command in ("inspect", "compensate", "replay", "demo"):
        assert command in text
    assert Settings().method in mdf("inspect", "--help")[1]


def test_help_does_not_wait_for_pictures_and_progress_bars():
    code = (
        "import sys; from mdf_core.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print(*sorted({'matplotlib', 'rich'} & set(sys.modules)), file=sys.stderr)"
    )
    root = Path(__file__).resolve().parents[2]
    outcome = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert outcome.stderr == "\n"
