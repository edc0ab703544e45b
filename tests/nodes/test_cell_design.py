"""Which design a node works on: that of its parameters, or the one that was set by service while they were the same."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from rclpy.parameter import Parameter
from samples import write_design

from mdf_core.errors import DesignFileError, InvalidSettingError, NotActiveError
from mdf_core.geometry import Design
from mdf_nodes.cell_design import configured_choice, declare_design, load_configured_design
from mdf_nodes.journal import DesignChoice, Journal
from mdf_nodes.managed_node import ManagedNode
from mdf_nodes.parameters import declare_settings


@pytest.fixture
def design(tmp_path: Path) -> Design:
    return write_design(tmp_path)


@pytest.fixture
def node(domain: int) -> Iterator[ManagedNode]:
    node = ManagedNode("any")
    declare_design(node)
    declare_settings(node)
    yield node
    node.stop()


def set_text(node: ManagedNode, **values: object) -> None:
    assert all(each.successful for each in node.set_parameters([Parameter(k, value=str(v)) for k, v in values.items()]))


def test_without_a_path_there_is_none(node: ManagedNode) -> None:
    assert load_configured_design(node, Journal()) is None


def test_the_file_is_found_from_any_folder_and_names_the_part(
    node: ManagedNode, design: Design, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(Path(design.path).parent)
    set_text(node, design_path="design.stl", design_unit="cm")
    loaded = load_configured_design(node, Journal())
    assert loaded is not None
    assert (loaded.design.path, loaded.unit, loaded.part_id) == (design.path, "cm", "design")
    assert (loaded.design.vertices == 10.0 * design.vertices).all()


def test_what_is_wrong_with_design_or_regions_of_the_parameters_is_raised(
    node: ManagedNode, design: Design, tmp_path: Path
) -> None:
    set_text(node, design_path=tmp_path / "missing.stl")
    with pytest.raises(DesignFileError, match=r"missing\.stl"):
        load_configured_design(node, Journal())
    set_text(node, design_path=design.path, regions_path=tmp_path / "missing.yaml")
    with pytest.raises(InvalidSettingError, match=r"missing\.yaml"):
        load_configured_design(node, Journal())


def test_one_that_was_set_by_service_counts_and_one_that_is_gone_is_only_reported(
    node: ManagedNode, design: Design, tmp_path: Path
) -> None:
    set_text(node, design_path=tmp_path / "missing.stl")
    journal = Journal()
    journal.set_design(configured_choice(node), DesignChoice(design.path, "mm", "flange"))
    loaded = load_configured_design(node, journal)
    assert loaded is not None and loaded.part_id == "flange"
    Path(design.path).unlink()
    assert load_configured_design(node, journal) is None


def test_what_is_not_open_yet_says_that_the_node_is_not_configured(node: ManagedNode) -> None:
    with pytest.raises(NotActiveError, match="not configured"):
        node.require_configured(None)
    journal = Journal()
    assert node.require_configured(journal) is journal
