from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest

from mdf_core.errors import InvalidSettingError, UnknownMethodError
from mdf_core.settings import METHODS, PoseSettings, Settings, SurfaceSettings, ThinningSettings, leaves

CORNERS = (0.0, 0.0, 0.0, 40.0, 0.0, 0.0, 0.0, 30.0, 0.0)
NUMBERS = [(name, leaf) for name, leaf, value in leaves(Settings()) if isinstance(value, int | float)]


def test_every_setting_tells_what_it_is_and_its_default_is_allowed() -> None:
    for name, leaf, value in leaves(Settings()):
        assert leaf.metadata["description"], name
        if isinstance(value, str):
            assert value in leaf.metadata["choices"], name


def test_the_flat_form_lists_every_setting_and_leads_back() -> None:
    settings = Settings(seed=3, thinning=ThinningSettings(box_mm=2.0))
    flat = settings.flat()
    assert flat["seed"] == 3
    assert flat["thinning.box_mm"] == 2.0
    assert list(flat) == [name for name, _, _ in leaves(settings)]
    assert Settings().replace(flat) == settings


@pytest.mark.parametrize(("name", "leaf"), NUMBERS, ids=[name for name, _ in NUMBERS])
def test_every_number_is_held_within_its_range(name: str, leaf: dataclasses.Field[Any]) -> None:
    minimum, maximum = leaf.metadata["minimum"], leaf.metadata["maximum"]
    for value in (minimum, maximum):
        assert Settings().replace({name: value}).flat()[name] == value
    for value in (minimum - 1, maximum + 1):
        with pytest.raises(InvalidSettingError, match=rf"^setting {name}: .* is outside"):
            Settings().replace({name: value})


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("seed", "17", 17),
        ("surface.alpha", "1e4", 1e4),
        ("surface.beta", "1.5, 0.75", (1.5, 0.75)),
        ("pose.initial", "1,2,3,0,0,0,1", (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)),
        ("pose.initial", "", ()),
        ("method", "cpd", "cpd"),
        ("compensation.lookup", "material", "material"),
    ],
)
def test_text_becomes_the_type_of_the_setting(name: str, text: str, value: object) -> None:
    replaced = Settings().replace({name: text}).flat()
    assert replaced[name] == value
    assert type(replaced[name]) is type(value)
    assert replaced == Settings().flat() | {name: value}


def test_a_whole_number_will_do_for_a_decimal_one() -> None:
    assert Settings().replace({"surface.alpha": 10}).surface.alpha == 10.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", "1.5"),
        ("seed", 1.5),
        ("seed", True),
        ("seed", "many"),
        ("surface.alpha", "stiff"),
        ("surface.alpha", math.nan),
        ("surface.alpha", "nan"),
        ("surface.alpha", math.inf),
        ("surface.beta", "1.5, soft"),
        ("surface.beta", (1.5, math.nan)),
        ("surface.beta", (1.5, 0.0)),
        ("surface.beta", ()),
        ("surface.beta", 1.5),
        ("pose.initial", "1,2,3"),
        ("crop.box_mm", "0,0,0,1,1"),
        ("crop.box_mm", (0.0, 0.0, 5.0, 1.0, 1.0, 5.0)),
        ("outliers.method", "guess"),
        ("compensation.lookup", 1),
    ],
)
def test_a_bad_value_is_refused_by_the_name_of_its_setting(name: str, value: Any) -> None:
    with pytest.raises(InvalidSettingError, match=rf"^setting {name}: "):
        Settings().replace({name: value})


def test_a_bad_value_is_refused_at_construction_too() -> None:
    with pytest.raises(InvalidSettingError, match=r"^setting thinning\.target_points: 5 is outside 100"):
        Settings(thinning=ThinningSettings(target_points=5))
    with pytest.raises(InvalidSettingError, match=r"^setting thinning\.box_mm: True is not a number"):
        Settings(thinning=ThinningSettings(box_mm=True))
    with pytest.raises(InvalidSettingError, match=r"^setting surface\.beta: 2\.0 is not a tuple"):
        Settings(surface=SurfaceSettings(beta=2.0))  # type: ignore[arg-type]


def test_a_whole_number_is_as_good_as_the_same_number_with_a_point() -> None:
    whole, point = (Settings(thinning=ThinningSettings(box_mm=value)) for value in (5, 5.0))
    assert whole == point
    assert whole.sha256() == point.sha256()


@pytest.mark.parametrize("name", ["surface", "surface.Beta", "beta", ""])
def test_an_unknown_setting_is_refused_with_the_list_of_all(name: str) -> None:
    with pytest.raises(InvalidSettingError) as caught:
        Settings().replace({name: "1"})
    assert caught.value.where == f"setting {name}"
    assert all(known in caught.value.remedy for known in Settings().flat())


def test_an_unknown_method_is_refused_with_the_list_of_methods() -> None:
    with pytest.raises(UnknownMethodError) as caught:
        Settings(method="icp")
    assert all(method in caught.value.remedy for method in METHODS)


def test_equal_settings_have_equal_hashes_and_every_change_changes_the_hash() -> None:
    settings = Settings()
    assert settings.sha256() == Settings().sha256()
    assert settings.replace({"surface.alpha": 5}).sha256() == settings.replace({"surface.alpha": "5.0"}).sha256()
    changes: dict[str, Any] = {
        name: next(choice for choice in leaf.metadata["choices"] if choice != value)
        for name, leaf, value in leaves(settings)
        if isinstance(value, str)
    }
    changes |= {name: leaf.metadata["maximum"] for name, leaf in NUMBERS}
    changes |= {"crop.box_mm": (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)}
    changes |= {"surface.beta": (2.0,), "pose.initial": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}
    points = CORNERS
    changes |= {"pose.datum_design": points, "pose.datum_scan": points}
    assert changes.keys() == settings.flat().keys()
    together = {name: value for name, value in changes.items() if "datum" in name}
    changed = [together if name in together else {name: value} for name, value in changes.items()]
    hashes = {settings.replace(change).sha256() for change in changed}
    assert len(hashes | {settings.sha256()}) == len(changes) - len(together) + 2


@pytest.mark.parametrize(
    "changes",
    [
        {"pose.datum_design": (1.0,) * 9},
        {"pose.datum_design": (1.0,) * 6, "pose.datum_scan": (1.0,) * 6},
        {"pose.datum_design": (1.0,) * 10, "pose.datum_scan": (1.0,) * 10},
        {"pose.datum_design": CORNERS, "pose.datum_scan": CORNERS, "pose.initial": (0.0,) * 6 + (1.0,)},
    ],
)
def test_datum_points_come_in_pairs_of_three_or_more_and_instead_of_a_pose(changes: dict[str, Any]) -> None:
    with pytest.raises(InvalidSettingError, match=r"^settings pose\."):
        Settings().replace(changes)


@pytest.mark.parametrize("quaternion", [(0.0,) * 4, (0.0, 0.0, 0.0, 1e-200), (0.0, 0.0, 0.0, 1e200)])
def test_a_quaternion_that_is_no_rotation_is_refused(quaternion: tuple[float, ...]) -> None:
    with pytest.raises(InvalidSettingError, match=r"^setting pose\.initial: .* is no rotation; .*0 0 0 1") as caught:
        Settings(pose=PoseSettings(initial=(1.0, 2.0, 3.0, *quaternion)))
    assert f"length {quaternion[3]:g}" in caught.value.what


@pytest.mark.parametrize("length", [1e-6, 0.1, 1.0, 1e6])
def test_a_quaternion_may_have_any_other_length(length: float) -> None:
    assert Settings(pose=PoseSettings(initial=(0.0, 0.0, 0.0, 0.0, length, 0.0, 0.0)))


LINE = (500.0, 100.0, 0.0, 540.0, 120.0, 0.0, 580.0, 140.0, 0.0)


@pytest.mark.parametrize("flat", [LINE, (*LINE, 600.0, 150.0, 0.01), (3.3, -1e4, 7.1) * 3, (0.0,) * 12])
@pytest.mark.parametrize("name", ["datum_design", "datum_scan"])
def test_datum_points_in_a_row_or_on_a_spot_are_refused(name: str, flat: tuple[float, ...]) -> None:
    good = (*CORNERS, 40.0, 30.0, 0.0)[: len(flat)]
    points = {"pose.datum_design": good, "pose.datum_scan": good} | {f"pose.{name}": flat}
    with pytest.raises(InvalidSettingError, match=rf"^setting pose\.{name}: .* one line or one spot"):
        Settings().replace(points)


def test_datum_points_just_beside_a_row_are_enough() -> None:
    beside = (0.0, 0.0, 1e4, 100.0, 1.0, 1e4, 200.0, 0.0, 1e4)
    assert Settings().replace({"pose.datum_design": beside, "pose.datum_scan": beside}).pose.datum_scan == beside


def test_settings_cannot_be_changed_in_place() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Settings().seed = 1  # type: ignore[misc]
